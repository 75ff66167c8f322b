"""Record states of the robots for the physics tests: `python tests/record_states.py` writes tests/data/ENVIRONMENT_states.npz.

Robots act with more or less noise. Out of the states before any violation, half of those kept have three contacts or more.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from fleetjax import supervisors
from fleetjax.envs import Env, allegro_hand, anymal, humanoid
from fleetjax.physics.base import Physics, PhysicsState, make_physics
from fleetjax.types import EnvState

DATA = Path(__file__).parent / "data"
NUM_ROBOTS, NUM_STEPS, NUM_KEPT = 64, 150, 128


class Robot(NamedTuple):
    """What the physics tests must know of an environment.

    Attributes:
        module: where it is.
        control: `(EnvState[K], actions [K, A], model) -> controls`, what the environment makes of actions.
        body: `EnvState.physics -> PhysicsState`.
        noise: largest standard deviation of the noise on actions.
        under_expert: noise on the expert's actions; else noise alone, so that servos wander.
    """

    module: Any
    control: Callable[[EnvState, jax.Array, mujoco.MjModel], jax.Array]
    body: Callable[[Any], PhysicsState]
    noise: float
    under_expert: bool = True


def hold(state: EnvState, action: jax.Array, model: mujoco.MjModel) -> jax.Array:
    """Return the angles [K, 16] that the hand's servos are told to hold."""
    target = jnp.clip(state.physics.target + allegro_hand.LARGEST_CHANGE * action, -1.0, 1.0)
    return allegro_hand.angles(target, *jnp.float32(model.jnt_range[:16].T))


ROBOTS = {
    "humanoid": Robot(humanoid, lambda state, action, model: action, lambda physics: physics, 1.0),
    "anymal": Robot(anymal, lambda state, action, model: anymal.targets(action), lambda physics: physics.body, 3.0),
    "allegro_hand": Robot(allegro_hand, hold, lambda physics: physics.body, 1.0, under_expert=False),
}


def make_policy(name: str, env: Env, num_robots: int):
    """Return `(states, key) -> actions`; the first robot's have no noise, the last robot's most."""
    supervisor = supervisors.make(name, env) if ROBOTS[name].under_expert else None
    scale = jnp.linspace(0.0, ROBOTS[name].noise, num_robots)[:, None]

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        key_act, key_noise = jax.random.split(key)
        if supervisor:
            action = jax.vmap(supervisor.act)(state, jax.random.split(key_act, num_robots))
        else:
            action = jnp.zeros((num_robots, env.spec.action_size))
        return jnp.clip(action + scale * jax.random.normal(key_noise, action.shape), -1.0, 1.0)

    return act


def wander(name: str, key: jax.Array):
    """Return states and controls [K] of robots that are not in violation."""
    env = ROBOTS[name].module.make_env(backend="native")
    act = make_policy(name, env, NUM_ROBOTS)
    key_reset, key_steps = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_ROBOTS), jnp.arange(NUM_ROBOTS))

    def step(state, key):
        key_act, key_env = jax.random.split(key)
        action = act(state, key_act)
        after = jax.vmap(env.step)(state, action, ~state.violation, jax.random.split(key_env, NUM_ROBOTS))
        return after._replace(violation=after.violation | state.violation), (state, action)

    states, actions = jax.jit(lambda s, k: jax.lax.scan(step, s, k)[1])(start, jax.random.split(key_steps, NUM_STEPS))
    moving = ~np.asarray(states.violation)
    states, actions = jax.tree.map(lambda x: np.asarray(x)[moving], (states, actions))
    return ROBOTS[name].body(states.physics), np.asarray(ROBOTS[name].control(states, actions, physics_of(name).model))


def physics_of(name: str, backend: str = "native") -> Physics:
    """Return the physics of an environment."""
    return make_physics(f"{name}.xml", substeps=ROBOTS[name].module.SUBSTEPS, backend=backend)


def count_contacts(model, qpos):
    """Return i64[K], how many contacts MuJoCo finds in each configuration f32[K, nq]."""
    data = mujoco.MjData(model)

    def count(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return data.ncon

    return np.array([count(q) for q in qpos])


def record(name: str):
    """Write the file of an environment."""
    bodies, control = wander(name, jax.random.key(0))
    contacts = count_contacts(physics_of(name).model, bodies.qpos)
    rng = np.random.default_rng(0)
    many, few = (rng.permutation(np.flatnonzero(x))[: NUM_KEPT // 2] for x in (contacts >= 3, contacts < 3))
    kept = np.concatenate([many, few])
    fields = {field: getattr(bodies, field)[kept] for field in bodies._fields}
    np.savez_compressed(DATA / f"{name}_states.npz", control=control[kept], **fields)


if __name__ == "__main__":
    for environment in ROBOTS:
        record(environment)

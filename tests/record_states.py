"""Record humanoid states for the physics tests: `python tests/record_states.py` writes tests/data/humanoid_states.npz.

Humanoids walk under the shipped expert with more or less noise on its actions. Out of the states before any fall, half of
those kept have three contacts or more.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from fleetjax import envs, supervisors
from fleetjax.physics.base import make_physics

FILE = Path(__file__).parent / "data" / "humanoid_states.npz"
NUM_ROBOTS, NUM_STEPS, NUM_KEPT = 64, 150, 128


def walk(key):
    """Return states and actions [T * N] of robots that have not fallen."""
    env = envs.make("humanoid", "native")
    supervisor = supervisors.make("humanoid", env)
    noise = jnp.linspace(0.0, 1.0, NUM_ROBOTS)[:, None]
    key_reset, key_steps = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_ROBOTS), jnp.arange(NUM_ROBOTS))

    def step(state, key):
        key_act, key_noise, key_env = jax.random.split(key, 3)
        action = jax.vmap(supervisor.act)(state, jax.random.split(key_act, NUM_ROBOTS))
        action = jnp.clip(action + noise * jax.random.normal(key_noise, action.shape), -1.0, 1.0)
        after = jax.vmap(env.step)(state, action, ~state.violation, jax.random.split(key_env, NUM_ROBOTS))
        after = after._replace(violation=after.violation | state.violation)
        return after, (state, action)

    states, actions = jax.jit(lambda s, k: jax.lax.scan(step, s, k)[1])(start, jax.random.split(key_steps, NUM_STEPS))
    upright = ~np.asarray(states.violation)
    return jax.tree.map(lambda x: np.asarray(x)[upright], (states.physics, actions))


def count_contacts(model, qpos):
    """Return i64[K], how many contacts MuJoCo finds in each configuration f32[K, nq]."""
    data = mujoco.MjData(model)

    def count(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return data.ncon

    return np.array([count(q) for q in qpos])


def main():
    physics, actions = walk(jax.random.key(0))
    contacts = count_contacts(make_physics("humanoid.xml", substeps=3, backend="native").model, physics.qpos)
    rng = np.random.default_rng(0)
    many, few = (rng.permutation(np.flatnonzero(x))[: NUM_KEPT // 2] for x in (contacts >= 3, contacts < 3))
    kept = np.concatenate([many, few])
    fields = {name: getattr(physics, name)[kept] for name in physics._fields}
    np.savez_compressed(FILE, action=actions[kept], **fields)


if __name__ == "__main__":
    main()

"""Environments of brax and MuJoCo Playground behind the contract."""

import functools
import sys
import types

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registering
from compiling import compiled

import fleetjax
from fleetjax import envs

HORIZON = 60
NUM_ROBOTS = 3
FEEDBACK = jnp.array([0.3, 3.0, 0.4, 0.6])  # cart position and pole angle, then their velocities


@pytest.fixture(scope="module", autouse=True)
def balance():
    """Register an analytic supervisor for as long as this module runs."""
    with registering.only_here():
        feedback = fleetjax.Supervisor(lambda state, key: jnp.clip(state.obs @ FEEDBACK, -1.0, 1.0)[None])
        fleetjax.register_supervisor("balance", lambda env: feedback)
        yield feedback


@pytest.fixture(scope="module")
def pendulum() -> envs.Env:
    return envs.from_brax("inverted_pendulum", supervisor="balance", horizon=HORIZON, success_return=HORIZON - 0.5)


@pytest.fixture(scope="module")
def step(pendulum):
    vmapped = jax.vmap(pendulum.step, in_axes=(0, 0, None, None))
    return compiled(lambda state, action: vmapped(state, action, True, jax.random.key(0)))


@pytest.fixture(scope="module")
def start(pendulum):
    keys = jax.random.split(jax.random.key(0), NUM_ROBOTS)
    return compiled(jax.vmap(pendulum.reset))(keys, jnp.arange(NUM_ROBOTS))


def test_brax_spec(pendulum):
    assert pendulum.spec == envs.EnvSpec(
        "brax/inverted_pendulum", 4, 1, HORIZON, pytest.approx(0.04), supervisor="balance", success_return=59.5
    )


def test_brax_episodes(balance, start, step):
    """Robot 0 is balanced and succeeds at the horizon; the others are pushed over, and nothing resets them."""
    states = [start]
    for _ in range(HORIZON):
        action = balance.act(jax.tree.map(lambda x: x[0], states[-1]), jax.random.key(0))
        states.append(step(states[-1], jnp.array([action, [1.0], [-1.0]])))
        assert jax.tree.map(lambda x: (x.shape, x.dtype), states[-1]) == jax.tree.map(lambda x: (x.shape, x.dtype), start)
    angle = np.array([s.obs[:, 1] for s in states])
    violation, success, timeout = (np.array([getattr(s, n) for s in states]) for n in ("violation", "success", "timeout"))
    np.testing.assert_array_equal(violation[1:], np.abs(angle[1:]) > 0.2)
    assert not violation[:, 0].any()
    fallen = violation[:, 1:].argmax(axis=0)
    assert np.all((fallen > 1) & (fallen < 30))
    assert np.all(violation[fallen.max() : fallen.max() + 5, 1:])
    np.testing.assert_array_equal(np.flatnonzero(timeout[:, 0]), [HORIZON])
    np.testing.assert_array_equal(np.flatnonzero(success[:, 0]), [HORIZON])
    assert states[-1].episode_return[0] == HORIZON
    assert states[-1].episode_step[0] == HORIZON


def test_a_state_that_is_no_number_is_a_violation(start, step):
    after = step(start, jnp.array([[0.0], [jnp.nan], [0.0]]))
    np.testing.assert_array_equal(after.violation, [False, True, False])
    assert np.all(np.isfinite(after.obs))
    np.testing.assert_array_equal(after.obs[1], start.obs[1])
    healthy = step(start, jnp.zeros((NUM_ROBOTS, 1)))
    np.testing.assert_array_equal(after.obs[::2], healthy.obs[::2])


@pytest.mark.slow
def test_fleet_runs_on_brax(pendulum):
    config = fleetjax.make_config(pendulum, "expert", num_robots=4, num_steps=HORIZON + 5, hidden_sizes=(8,), batch_size=16)
    run = compiled(functools.partial(fleetjax.run, env=pendulum))
    metrics = run(config, jax.random.key(0)).metrics
    assert metrics.teleop_steps.tolist() == [4] * (HORIZON + 5)
    assert metrics.reward.tolist() == [4.0] * (HORIZON + 5)
    assert np.flatnonzero(metrics.successes).tolist() == [HORIZON - 1]
    assert metrics.successes.sum() == 4


def test_unknown_brax_environment():
    with pytest.raises(ValueError, match=r"brax environment = 'inverted' is unknown; choose one of .*inverted_pendulum"):
        envs.from_brax("inverted", supervisor="balance")


def test_playground_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(ImportError, match=r'run pip install "\.\[playground\]" in the source folder'):
        envs.from_playground("CartpoleBalance", supervisor="balance")


@flax.struct.dataclass
class State:
    """Like Playground's, with what its locomotion tasks observe."""

    data: jax.Array
    obs: dict
    reward: jax.Array
    done: jax.Array
    info: dict


class Slide:
    """A stand-in for a Playground environment: a bead on a rail, done beyond its end."""

    action_size, dt = 1, 0.02

    def __init__(self, config, config_overrides):
        self.config = config | config_overrides
        self.unwrapped = self

    def _observe(self, x):
        return {"state": jnp.stack([x, 1.0]), "privileged_state": jnp.zeros(7)}

    def reset(self, rng):
        rng, key = jax.random.split(rng)
        x = 0.1 * jax.random.normal(key)
        return State(x, self._observe(x), jnp.zeros(()), jnp.zeros(()), {"rng": rng})

    def step(self, state, action):
        x = state.data + self.config["speed"] * action[0]
        done = jnp.abs(x) > 1  # a bool where reset gave a float
        return state.replace(data=x, obs=self._observe(x), reward=1.0, done=done)


def test_playground(monkeypatch):
    """The dictionary's "state" is observed, `done` violates, MJX's JAX backend is chosen, overrides arrive."""
    made = []

    class Config(dict):
        def __setattr__(self, name, value):
            self[name] = value

    def load(name, config, config_overrides):
        made.append(Slide(config, config_overrides))
        return made[-1]

    playground = types.ModuleType("mujoco_playground")
    playground.registry = types.SimpleNamespace(
        ALL_ENVS=("Slide",), load=load, get_default_config=lambda name: Config(impl="warp", speed=0.1)
    )
    monkeypatch.setitem(sys.modules, "mujoco_playground", playground)
    env = envs.from_playground("Slide", supervisor="balance", horizon=9, success_return=5.0, speed=0.25)
    assert made[0].config == {"impl": "jax", "speed": 0.25}
    assert env.spec == envs.EnvSpec("playground/Slide", 2, 1, 9, 0.02, supervisor="balance", success_return=5.0)

    def episode(key, push):
        step = lambda state, _: (env.step(state, push, True, key),) * 2  # noqa: E731
        return jax.lax.scan(step, env.reset(key, 0), length=9)[1]

    states = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0)), jnp.array([[0.0], [1.0]]))
    np.testing.assert_array_equal(states.violation[1], np.abs(states.obs[1, :, 0]) > 1)
    assert states.violation[1, -1]
    assert not states.violation[0].any()
    assert states.success[:, -1].tolist() == [True, False]
    with pytest.raises(ValueError, match="playground environment = 'Side' is unknown; choose one of Slide"):
        envs.from_playground("Side", supervisor="balance")


def test_an_environment_that_is_made_in_64_bits_computes_in_32():
    with jax.enable_x64(True):
        env = envs.from_brax("inverted_pendulum", supervisor="balance", horizon=HORIZON, success_return=HORIZON - 0.5)
        config = fleetjax.make_config(env, "expert", num_robots=2, num_humans=2, num_steps=3)
        result = jax.eval_shape(functools.partial(fleetjax.run, env=env), config, jax.random.key(0))
    for leaf in jax.tree.leaves(result):
        assert leaf.dtype.itemsize <= 4 or jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)

"""What can only be seen on a GPU: `pytest -n 0 -m "" tests/test_gpu.py` where JAX has one. Skipped elsewhere.

Start it in a process of its own: tests of sweeps keep theirs on the CPU.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import assert_agree_with_native
from record_states import ROBOTS

import fleetjax
from fleetjax import envs

pytestmark = pytest.mark.slow
each_robot = pytest.mark.parametrize("name", ROBOTS)
SMALL = {
    "num_robots": 16,
    "num_humans": 4,
    "num_demonstrations": 256,
    "pretraining_steps": 20,
    "critic_pretraining_steps": 20,
    "num_critic_transitions": 256,
    "critic_capacity": 1000,
    "initial_period": 0,
}


@pytest.fixture(autouse=True)
def gpu():
    """Skip where there is none."""
    if jax.default_backend() != "gpu":
        pytest.skip("needs a GPU; JAX finds none here")


@each_robot
def test_mjx_agrees_with_native(name):
    assert_agree_with_native(name, "mjx")


@each_robot
def test_warp_agrees_with_native(name):
    pytest.importorskip("warp", reason='needs pip install ".[cuda12,warp]"')
    assert_agree_with_native(name, "warp")


def test_navigation_agrees_with_a_cpu():
    env, n = envs.make("navigation"), 32
    keys = jax.random.split(jax.random.key(0), (21, n))
    actions = jax.random.uniform(jax.random.key(1), (20, n, env.spec.action_size), minval=-1.0, maxval=1.0)

    def act(keys, actions):
        start = jax.vmap(env.reset)(keys[0], jnp.arange(n))

        def step(state, given):
            state = jax.vmap(env.step)(state, given[1], jnp.ones(n, bool), given[0])
            return state, state.obs

        return jax.lax.scan(step, start, (keys[1:], actions))[1]

    found = jax.jit(act)(keys, actions)
    with jax.default_device(jax.devices("cpu")[0]):
        expected = jax.jit(act)(*jax.device_put((keys, actions), jax.devices("cpu")[0]))
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("environment", ["navigation", "humanoid"])
def test_a_run_in_two_halves_is_the_whole_run_to_the_bit(environment):
    """Also two whole runs: where XLA adds up in any order, they differ first."""
    config = fleetjax.make_config(environment, "cur", backend="mjx", num_steps=40, **SMALL)
    key, half = jax.random.key(0), config.replace(num_steps=20)
    start = jax.jit(fleetjax.prepare)(config, key)
    run = jax.jit(fleetjax.run)
    whole, again = run(config, key, start), run(config, key, start)
    first = run(half, key, start)
    second = run(half, key, first.state)
    joined = jax.tree.map(lambda *x: np.concatenate(x), first.metrics, second.metrics)
    for one, other in ((whole, again), (whole, fleetjax.Result(joined, second.state))):
        jax.tree.map(np.testing.assert_array_equal, one.metrics, other.metrics)
        jax.tree.map(np.testing.assert_array_equal, one.state, other.state)

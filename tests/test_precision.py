"""A fleet computes in 32 bits, also where JAX's default is 64."""

import jax
import numpy as np
import pytest
from compiling import compiled

import fleetjax
from fleetjax import envs

SMALL = {
    "num_robots": 6,
    "num_humans": 2,
    "num_steps": 20,
    "ensemble_size": 2,
    "hidden_sizes": (8,),
    "batch_size": 8,
    "critic_capacity": 100,
    "num_demonstrations": 30,
    "pretraining_steps": 5,
    "critic_pretraining_steps": 5,
    "num_critic_transitions": 50,
    "uncertainty_threshold": 0.01,
    "hard_reset_time": 2,
    "initial_period": 10,
}


def run_navigation():
    """Make everything anew, as a process does that has the setting from its beginning."""
    envs._make.cache_clear()
    config = fleetjax.make_config("navigation", "cur", **SMALL)
    result = compiled(fleetjax.run)(config, jax.random.key(0))
    frozen = compiled(fleetjax.evaluate)(config, jax.random.key(1), result.state.policy)
    return jax.device_get((result.metrics, frozen.metrics))


@pytest.mark.slow
def test_a_run_in_64_bits_is_that_in_32():
    narrow = run_navigation()
    with jax.enable_x64(True):
        wide = run_navigation()
    for found, expected in zip(jax.tree.leaves(wide), jax.tree.leaves(narrow), strict=True):
        assert found.dtype == expected.dtype
        if found.dtype == np.int32:
            np.testing.assert_array_equal(found, expected)
        else:  # compilers may round the same program in two ways
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
    assert narrow[0].teleop_steps.sum() > 0


@pytest.mark.slow
def test_robots_and_derivatives_trace_in_64_bits():
    """Every environment, both ways to run, and reverse mode."""
    with jax.enable_x64(True):
        for name in fleetjax.list_envs():
            config = fleetjax.make_config(name, "cur", num_robots=4, num_humans=2, num_steps=3)
            result, log = jax.eval_shape(fleetjax.run_logged, config, jax.random.key(0))
            for leaf in jax.tree.leaves((result, log)):
                assert leaf.dtype.itemsize <= 4 or jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        config = fleetjax.make_config("navigation", "cur", **SMALL).replace(num_steps=2)
        start = jax.eval_shape(fleetjax.prepare, config, jax.random.key(0))

        def loss(rate, state):
            return fleetjax.run(config.replace(learning_rate=rate), jax.random.key(0), state).metrics.policy_loss.sum()

        slope = jax.jit(jax.grad(loss)).trace(config.learning_rate, start).lower()
        assert slope.out_info.dtype == np.float32

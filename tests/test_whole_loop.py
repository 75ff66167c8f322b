"""The whole loop: compiled or not, one seed or several, one program for all settings, and on MJX."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled

import fleetjax
from fleetjax import envs
from fleetjax.config import FIELDS
from fleetjax.physics.base import PhysicsState

TINY = {
    "num_robots": 8,
    "num_humans": 3,
    "num_steps": 40,
    "ensemble_size": 2,
    "hidden_sizes": (8,),
    "batch_size": 16,
    "human_capacity": 500,
    "critic_capacity": 200,
    "num_demonstrations": 200,
    "pretraining_steps": 20,
    "critic_pretraining_steps": 20,
    "num_critic_transitions": 100,
    "uncertainty_threshold": 0.01,
    "hard_reset_time": 3,
}
COUNTS = [name for name in fleetjax.Metrics._fields if name not in ("reward", "uncertainty", "policy_loss")]


def assert_same(tree, other):
    jax.tree.map(np.testing.assert_array_equal, tree, other)


def counts(metrics) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(metrics, name)) for name in COUNTS}


@pytest.fixture(scope="module")
def tiny():
    return fleetjax.make_config("navigation", "cur", **TINY)


@pytest.fixture(scope="module")
def run():
    return compiled(lambda config, key: fleetjax.run(config, key))  # of its own: programs of one function share their cache


def test_no_traced_field_recompiles(tiny, run):
    """Every traced field gets another value, and the compiled program serves both."""
    before = run(tiny, jax.random.key(0))
    traced = [name for name, field in FIELDS.items() if field.traced]
    assert len(traced) >= 17
    changed = {}
    for name in traced:
        value = np.asarray(getattr(tiny, name))
        if value.dtype == bool:
            changed[name] = not value
        elif value.dtype == np.int32:
            changed[name] = int(value) - 10 if value > 20 else int(value) + 1
        else:
            changed[name] = 0.7 * float(value) + 0.01
    after = run(tiny.replace(**changed), jax.random.key(0))
    assert run._cache_size() == 1
    assert np.any(np.asarray(before.metrics.reward) != np.asarray(after.metrics.reward))
    assert int(after.state.human_data.pairs.added) != int(before.state.human_data.pairs.added)


@pytest.fixture(scope="module")
def sweep(tiny) -> tuple[list[tuple[fleetjax.Config, jax.Array]], fleetjax.Config, jax.Array]:
    """Settings and seeds one by one, and the same stacked."""
    thresholds, keys = jnp.array([0.001, 0.3, 0.01]), jax.random.split(jax.random.key(1), 3)
    each = [(tiny.replace(uncertainty_threshold=u), key) for u, key in zip(thresholds, keys, strict=True)]
    return each, jax.vmap(lambda u: tiny.replace(uncertainty_threshold=u))(thresholds), keys


@pytest.mark.slow
def test_a_map_over_seeds_and_settings_is_a_loop_bit_for_bit(sweep):
    each, configs, keys = sweep
    together = jax.jit(lambda configs, keys: jax.lax.map(lambda x: fleetjax.run(*x), (configs, keys)))(configs, keys)
    assert len(np.unique(np.asarray(together.metrics.switches), axis=0)) == 3
    alone = jax.jit(fleetjax.run)
    for i, (config, key) in enumerate(each):
        assert_same(jax.tree.map(lambda x, i=i: x[i], together), alone(config, key))


@pytest.mark.slow
def test_a_vmap_over_seeds_and_settings_is_a_loop_but_for_roundings(tiny, sweep):
    """Over a few timesteps; after many, a last bit may have decided who is helped."""
    each, configs, keys = sweep
    short = {"num_steps": 6, "human_capacity": tiny.human_capacity}
    together = compiled(jax.vmap(fleetjax.run))(configs.replace(**short), keys)
    alone = compiled(fleetjax.run)
    for i, (config, key) in enumerate(each):
        expected = alone(config.replace(**short), key)
        found = jax.tree.map(lambda x, i=i: x[i], together)
        assert_same(counts(found.metrics), counts(expected.metrics))
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3), found, expected)
    assert together.metrics.teleop_steps.sum() > 0


@pytest.mark.slow
def test_a_run_has_forward_derivatives(tiny):
    """Of the imitation loss by the learning rate, against a difference of two runs."""
    config = tiny.replace(num_steps=4)
    loss = jax.jit(
        lambda rate: jnp.sum(fleetjax.run(config.replace(learning_rate=rate), jax.random.key(0)).metrics.policy_loss)
    )
    rate, width = jnp.float32(1e-3), 2e-5
    _, slope = compiled(lambda: jax.jvp(loss, (rate,), (jnp.float32(1.0),)))()
    difference = (loss(rate + width) - loss(rate - width)) / (2 * width)
    np.testing.assert_allclose(slope, difference, rtol=0.1)
    assert abs(float(slope)) > 1e-3


@pytest.mark.slow
def test_loop_jitted_is_not_jitted(tiny, run):
    """A timestep by `plan` and `advance`, operation by operation, has the counts and the state of the compiled one."""
    state, key = run(tiny, jax.random.key(2)).state, jax.random.key(3)
    step = fleetjax.make_fleet(tiny, envs.make("navigation")).step
    (after, metrics), (expected, expected_metrics) = step(state, key), compiled(step)(state, key)
    assert_same(counts(metrics), counts(expected_metrics))
    assert_same(after.humans, expected.humans)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), after, expected)


def is_mujoco_robot(name: str) -> bool:
    state = jax.eval_shape(envs.make(name).reset, jax.random.key(0), jnp.int32(0))
    return isinstance(state.physics, PhysicsState)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in fleetjax.list_envs() if is_mujoco_robot(name)])
def test_loop_runs_on_mjx(name):
    """Demonstrations, pre-training and a few timesteps; a demonstration is cut short, since MJX takes its time on a CPU."""
    env = envs.make(name, "mjx")
    short = env._replace(step=jax.jit(env.step), spec=env.spec._replace(horizon=12))
    config = fleetjax.make_config(name, "uc", **TINY | {"num_steps": 6, "num_demonstrations": 40, "backend": "mjx"})
    result = compiled(functools.partial(fleetjax.run, env=short))(config, jax.random.key(0))
    metrics = result.metrics
    assert np.all(metrics.moving + metrics.idle == TINY["num_robots"])
    assert metrics.teleop_steps.sum() > 0
    assert int(result.state.human_data.pairs.size) == 40 + int(metrics.teleop_steps.sum())
    assert np.all(np.isfinite(metrics.reward))
    assert np.all(np.isfinite(metrics.policy_loss))
    assert np.all(np.isfinite(result.state.env.obs))
    assert not np.any(result.state.env.physics.diverged)
    elapsed = np.asarray(result.state.env.episode_step) * env.spec.control_step
    np.testing.assert_allclose(result.state.env.physics.time, elapsed, rtol=1e-4)

"""Derivatives of a run from a given state: every way to ask JAX for them works, and they are finite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled

import fleetjax
from fleetjax.config import all_fields, get_value

SMALL = {
    "num_robots": 4,
    "num_humans": 2,
    "num_steps": 5,
    "ensemble_size": 2,
    "hidden_sizes": (6,),
    "batch_size": 8,
    "gradient_steps": 1,
    "critic_capacity": 100,
    "num_demonstrations": 40,
    "pretraining_steps": 3,
    "critic_pretraining_steps": 3,
    "num_critic_transitions": 40,
    "uncertainty_threshold": 0.0,
    "initial_period": 0,
}
# Not read once a state is given: it was prepared with them.
OFFLINE = {"critic_noise"}
FLOATS = sorted(
    name for name, field in all_fields("thrifty_dagger").items() if field.traced and field.kind is float and name not in OFFLINE
)
KEY = jax.random.key(1)


def kill_a_unit(tree):
    """Return parameters whose first hidden unit never fires: all its gradients are exactly 0."""

    def kill(path, x):
        first = "layers_0" in jax.tree_util.keystr(path) and "bias" in jax.tree_util.keystr(path)
        return x.at[..., 0].set(-1e6) if first else x

    return jax.tree_util.tree_map_with_path(kill, tree)


@pytest.fixture(scope="module")
def fleet():
    """A configuration with all that floats do in a fleet, and a state with dead units and untouched optimizers."""
    everything = dataclasses.replace(fleetjax.priority.get_algorithm("thrifty_dagger"), estimators=("safety", "goal"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(fleetjax.priority.ALGORITHMS.entries, "everything", everything)
        config = fleetjax.make_config("navigation", "everything", **SMALL)
        state = compiled(fleetjax.prepare)(config, jax.random.key(0))
        policy = state.policy._replace(params=kill_a_unit(state.policy.params))
        critics = {kind: store._replace(params=kill_a_unit(store.params)) for kind, store in state.estimators.items()}
        yield config, state._replace(policy=policy, estimators=critics)


@pytest.fixture(scope="module")
def objective(fleet):
    """A number that depends on all that a run gives, as a function of its float fields."""
    config, state = fleet

    def worth(values: dict[str, jax.Array]) -> jax.Array:
        metrics, last = fleetjax.run(config.replace(**values), KEY, state)
        learnt = [last.policy.params, [store.params for store in last.estimators.values()], last.priority]
        learnt += [store.target for store in last.estimators.values()]
        return sum(map(jnp.sum, jax.tree.leaves(learnt)), jnp.sum(metrics.reward) + jnp.sum(metrics.policy_loss))

    return worth, {name: get_value(config, name) for name in FLOATS}


@pytest.mark.slow
def test_derivatives_by_every_float_field_are_finite_forwards_and_in_reverse(objective):
    worth, values = objective
    reverse, forward = compiled(jax.grad(worth))(values), compiled(jax.jacfwd(worth))(values)
    for name in FLOATS:
        assert np.isfinite(reverse[name]), name
        np.testing.assert_allclose(forward[name], reverse[name], rtol=1e-2, atol=1e-3, err_msg=name)
    for name in ("learning_rate", "risk_discount", "goal_discount", "target_rate"):
        assert reverse[name] != 0, name


@pytest.fixture(scope="module")
def loss():
    """The imitation loss as a function of the learning rate."""
    config = fleetjax.make_config("navigation", "uc", **SMALL)
    state = compiled(fleetjax.prepare)(config, jax.random.key(0))
    return lambda rate: jnp.sum(fleetjax.run(config.replace(learning_rate=rate), KEY, state).metrics.policy_loss)


@pytest.mark.slow
def test_a_derivative_in_reverse_is_that_of_a_difference(loss):
    rate, width = jnp.float32(1e-3), 1e-4
    (above, below), slope = compiled(lambda: ([loss(rate + width), loss(rate - width)], jax.grad(loss)(rate)))()
    np.testing.assert_allclose(slope, (above - below) / (2 * width), rtol=0.05)


@pytest.mark.slow
def test_every_way_to_a_derivative_gives_the_same(loss):
    @compiled
    def derivatives(rate):
        one = jnp.ones_like(rate)
        _, pushed = jax.linearize(loss, rate)
        _, pulled = jax.vjp(loss, rate)
        return {
            "grad": jax.grad(loss)(rate),
            "vjp": pulled(one)[0],
            "linearize": pushed(one),
            "jacfwd": jax.jacfwd(loss)(rate),
            "checkpoint": jax.grad(jax.checkpoint(loss))(rate),
        }

    found = derivatives(jnp.float32(1e-3))
    for way, slope in found.items():
        np.testing.assert_allclose(slope, found["jacfwd"], rtol=1e-3, err_msg=way)

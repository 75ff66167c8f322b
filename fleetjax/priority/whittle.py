"""Help as a restless bandit: each robot is a chain of three states, and its index is what help is worth there."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import sharding
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, PerRobot, Priority
from fleetjax.priority.gates import helped

OK, RISKY, VIOLATED = range(3)
WORTH = (1.0, 1.0, 0.0)  # of a timestep in each state: the robot moves, or lies
POLICIES = np.array(list(itertools.product((0, 1), repeat=3)))  # [8, 3] whether each helps in each state
PRIOR = 1.0  # transitions of each kind that are taken as seen
BISECTIONS = 30


def indices(passive: jax.Array, active: jax.Array, discount: jax.Array) -> jax.Array:
    """Return f32[3], the Whittle index of each state: the price of help at which it does not matter whether one helps there.

    Args:
        passive: f32[3, 3] probabilities of transitions without help, from row to column.
        active: f32[3, 3] the same with help.
        discount: f32[] of the next timestep.

    A policy's value is linear in the price, so that the best of the eight policies is found for every price at once. Rounding
    to 32 bits moves an index by up to 0.002 at a discount of 0.99, and by much more above.
    """
    worth, helps = jnp.array(WORTH), jnp.asarray(POLICIES, jnp.float32)
    chains = jnp.where(helps[:, :, None] > 0, active, passive)
    inverse = jnp.linalg.inv(jnp.eye(3) - discount * chains)
    gain, help_time = inverse @ worth, jnp.einsum("pij,pj->pi", inverse, helps)

    def advantage(price: jax.Array) -> jax.Array:
        """f32[3], what help adds in each state at the price f32[3] of that state."""
        value = jnp.max(gain[None] - price[:, None, None] * help_time[None], axis=1)
        return discount * jnp.einsum("ij,ij->i", active - passive, value) - price

    def halve(bounds: tuple[jax.Array, jax.Array], _):
        low, high = bounds
        middle = (low + high) / 2
        worthwhile = advantage(middle) > 0
        return (jnp.where(worthwhile, middle, low), jnp.where(worthwhile, high, middle)), None

    most = jnp.full(3, 1.0 / (1.0 - discount))
    low, high = jax.lax.scan(halve, (-most, most), length=BISECTIONS)[0]
    return (low + high) / 2


class Chain(NamedTuple):
    """What `whittle` remembers: transitions f32[2, 3, 3] so far, without and with help, and i32[N] the robots' last states."""

    transitions: jax.Array
    states: PerRobot


def whittle(config) -> Priority:
    """The Whittle index of the robot's state, where it is above `whittle_threshold`.

    A robot is ok, risky (U or R above its threshold) or violated, and its state changes as a Markov chain, with help and
    without. Transitions are counted over the whole fleet as they happen, from one of each kind; without help a violation
    stays. A timestep is worth 1 unless the robot is violated, the next counts `whittle_discount` of it.

    Reference: restless bandits for robot fleets (arXiv 2111.06437); reimplemented from the text, with a chain of our own.
    """
    own = config.parameters

    def init():
        prior = jnp.full((2, 3, 3), PRIOR, jnp.float32).at[0, VIOLATED].set(jnp.array([0.0, 0.0, 1.0]))
        return Chain(prior, PerRobot(jnp.full(config.num_robots, -1, jnp.int32)))

    def score(signals, past, key):
        del key
        in_danger = (signals.uncertainty > config.uncertainty_threshold) | (signals.risk > config.risk_threshold)
        state = jnp.where(signals.violation, VIOLATED, jnp.where(in_danger, RISKY, OK)).astype(jnp.int32)
        before = past.states.values
        cell = jnp.where(before < 0, -1, 9 * helped(signals).astype(jnp.int32) + 3 * before + state)
        seen = sharding.total((cell[:, None] == jnp.arange(18)).astype(jnp.float32)).reshape(2, 3, 3)
        counts = past.transitions + seen
        passive, active = counts / jnp.sum(counts, axis=2, keepdims=True)
        index = indices(passive, active, own["whittle_discount"])[state]
        return jnp.where(index > own["whittle_threshold"], index, 0.0), Chain(counts, PerRobot(state))

    return Priority(init, score)


WHITTLE: dict[str, Algorithm] = {
    "whittle": Algorithm(whittle, estimators=("safety",), parameters=PARAMETERS["whittle"]),
}

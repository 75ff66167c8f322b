"""Fleet-EnsembleDAgger and Fleet-ThriftyDAgger: single-robot rules by uncertainty, as the paper runs them on fleets."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.ranks import above, lexicographic


def ensemble_dagger(config) -> Priority:
    """U.C.: uncertainty above its threshold, then violations (paper, Section 4.2, Fleet-EnsembleDAgger)."""

    def score(signals, key):
        del key
        return lexicographic(above(signals.uncertainty, config.uncertainty_threshold), signals.violation)

    return stateless(score)


class Moments(NamedTuple):
    """Running moments of two quantities: number f32[], mean f32[2], sum of squared deviations f32[2]."""

    number: jax.Array
    mean: jax.Array
    squares: jax.Array


def update_moments(moments: Moments, values: jax.Array) -> Moments:
    """Return the moments with `values` f32[N, 2] added (Chan's parallel formula)."""
    added = jnp.float32(values.shape[0])
    number = moments.number + added
    mean = sharding.total(values) / added
    shift = mean - moments.mean
    squares = moments.squares + sharding.total((values - mean) ** 2) + shift**2 * moments.number * added / number
    return Moments(number, moments.mean + shift * added / number, squares)


def thrifty_dagger(config) -> Priority:
    """U.G.C.: normalised uncertainty and chance of failure above a threshold, then violations.

    The sum is (1 - w) z(U) + w z(1 - Q_G) with w = `thrifty_weight`; z by running moments over all robot-steps so far.

    Reference: paper, Section 4.2, Fleet-ThriftyDAgger.
    """
    weight, threshold = config.parameters["thrifty_weight"], config.parameters["thrifty_threshold"]

    def init():
        return Moments(jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))

    def score(signals, moments, key):
        del key
        values = jnp.stack([signals.uncertainty, 1.0 - signals.goal], axis=1)
        moments = update_moments(moments, values)
        variance = jnp.maximum(moments.squares / moments.number, 1e-16)  # below the root: a root's slope at 0 is infinite
        z = (values - moments.mean) / jnp.sqrt(variance)
        combined = (1 - weight) * z[:, 0] + weight * z[:, 1]
        excess = jnp.maximum(combined - threshold, 0.0)
        return lexicographic(excess, signals.violation), moments

    return Priority(init, score)


DAGGERS: dict[str, Algorithm] = {
    "ensemble_dagger": Algorithm(ensemble_dagger),
    "thrifty_dagger": Algorithm(thrifty_dagger, estimators=("goal",), parameters=PARAMETERS["thrifty_dagger"]),
}

"""A weighted sum of violation, uncertainty, risk and chance of failure: C.U.R. as a sum, which has derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.ranks import above, softly_above

SMALLEST = 1e-6  # threshold that values are divided by
_THRESHOLDS = ("uncertainty_threshold", "risk_threshold")


def weighted(config) -> Priority:
    """Weighted sum: w_C C + w_U U/u + w_R R/r + w_G (1 - G), with the thresholds u and r.

    U and R count as 0 below their thresholds, and robots in violation score 0 in the initial period. C.U.R. is the limit for
    w_C / w_U and w_U / w_R to infinity, U.C. that for w_U / w_C to infinity and w_R = 0. With `allocation = "soft"`, U and R
    rise over their thresholds as sigmoids, whose width is the temperature, in units of scores.

    Reference: paper, Section 4.2, whose order of criteria it relaxes to weights.
    """
    own = config.parameters
    soft = config.allocation == "soft"

    def part(weight: jax.Array, values: jax.Array, threshold: jax.Array) -> jax.Array:
        threshold = jnp.maximum(threshold, SMALLEST)  # one that is traced may be 0
        if soft:
            return softly_above(weight * values / threshold, weight, config.temperature)
        return weight * above(values, threshold) / threshold

    def score(signals, key):
        del key
        total = (
            own["violation_weight"] * signals.violation.astype(signals.uncertainty.dtype)
            + part(own["uncertainty_weight"], signals.uncertainty, config.uncertainty_threshold)
            + part(own["risk_weight"], signals.risk, config.risk_threshold)
        )
        if "goal" in (signals.estimates or {}):
            total += own["goal_weight"] * (1.0 - signals.goal)
        return jnp.where(signals.violation & (signals.timestep < config.initial_period), 0.0, total)

    return stateless(score)


def check(config, spec) -> None:
    """Check that the thresholds, which are divided by, are positive, and that failures are weighed only where there are goals.

    Raises:
        ValueError: if that is not so.
    """
    for name in _THRESHOLDS:
        value = getattr(config, name)
        if not isinstance(value, Tracer) and np.any(np.asarray(value) <= 0):
            raise ValueError(f"{name} = {value} must be positive for algorithm = 'weighted', which divides by it")
    weight = config.parameters["goal_weight"]
    if not spec.has_goal and not isinstance(weight, Tracer) and np.any(np.asarray(weight) != 0):
        raise ValueError(f"goal_weight = {weight} must be 0, since environment = {spec.name!r} has no goals")


WEIGHTED: dict[str, Algorithm] = {
    "weighted": Algorithm(
        weighted,
        estimators=("safety", "goal"),
        optional=("goal",),
        parameters=PARAMETERS["weighted"],
        check=check,
        differentiable=True,
    )
}

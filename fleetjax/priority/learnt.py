"""Gates by a learnt number: distance to what humans have seen, an adaptive interval, a critic of interventions, energies."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from fleetjax import sharding
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, PerRobot, Priority, stateless
from fleetjax.priority.gates import gated, known, teleoperated
from fleetjax.priority.quantiles import add, empty, on_their_own, quantile
from fleetjax.priority.ranks import above
from fleetjax.types import Signals

MEMORY = 1000.0  # timesteps within which quantiles forget
NEIGHBOURS = 5  # K of CRSAIL
NARROWEST = 1e-3  # spread of an ensemble that agrees


def crsail(config) -> Priority:
    """Ask if d_K / r >= `crsail_threshold`, for the distance d_K to the K-th nearest state in which humans acted.

    The radius r is the quantile at level 1 - `crsail_rate` of the same distance among the demonstrated states, calibrated
    once, before the fleet starts. See the estimator `"novelty"`. The original takes the quantile over states that the
    policy visits, so its level sets the rate of queries. Here `crsail_threshold` does.

    Reference: CRSAIL, 2025 (arXiv 2512.00453: K = 5); reimplemented from the text.
    """
    threshold = config.parameters["crsail_threshold"]
    return stateless(lambda signals, key: gated(signals, above(known(signals.estimates["novelty"]), threshold)))


class Interval(NamedTuple):
    """What `conformal` remembers: the interval's half width f32[] in units of the spread, and the last spread of each robot."""

    half: jax.Array
    spread: PerRobot


def conformal(config) -> Priority:
    """Ask if the interval of the human's action is wider than `conformal_threshold`: 2 q s, with the ensemble's spread s.

    s = sqrt(U) + 0.001, and q is 1 at first. Only labels move q. After a timestep in which humans taught robots, q is
    multiplied by exp(`conformal_gain` (e - `conformal_rate`)), where e is the share of these robots whose residual, the root
    mean squared difference of the two actions, was beyond q s. Robots that are then in violation do not count.

    Reference: ConformalDAgger with intermittent quantile tracking, 2024 (arXiv 2410.08852); reimplemented from the text. The
    original has one robot, and weighs a label by 1 / p, for its probability p. Here labels come from robots that are helped,
    their weights are equal, s differs between robots, and q changes by a factor. Where actions are discrete, U is an entropy.
    """
    own = config.parameters

    def init():
        return Interval(jnp.ones(()), PerRobot(jnp.ones(config.num_robots)))

    def score(signals, past, key):
        del key
        taught = teleoperated(signals)
        missed = taught & (jnp.sqrt(signals.correction) > past.half * past.spread.values)
        number, misses = (sharding.total(flags.astype(jnp.float32)) for flags in (taught, missed))
        change = jnp.where(number > 0, misses / jnp.maximum(number, 1.0) - own["conformal_rate"], 0.0)
        half = jnp.clip(past.half * jnp.exp(own["conformal_gain"] * change), 1e-6, 1e6)
        spread = jnp.sqrt(known(signals.uncertainty)) + NARROWEST
        score = gated(signals, above(2.0 * half * spread, own["conformal_threshold"]))
        return score, Interval(half, PerRobot(spread))

    return Priority(init, score)


def aim(config) -> Priority:
    """Ask if the proxy value of the robot's action is above its running quantile at level 1 - `aim_rate`.

    The value is learnt to be -1 for humans' actions and +1 for those of robots that humans would correct, and spreads to
    the states before by temporal differences. See the estimator `"intervention"`. The quantile forgets within 1,000 timesteps.

    Reference: Cai, Peng and Zhou, Adaptive Intervention Mechanism (AIM), 2025 (arXiv 2506.09176); reimplemented from the text
    (delta = 0.05).
    """
    shift = 1.0  # values lie about [-1, 1], and quantiles are of numbers above 0
    return _at_a_rate(lambda signals: jnp.maximum(known(signals.estimates["intervention"]) + shift, 0.0), config, "aim_rate")


def iifl(config) -> Priority:
    """Ask if the Jeffreys divergence of two energy models is above its running quantile at level 1 - `iifl_rate`.

    Only this uncertainty comes from energy models (the estimator `"divergence"`); the robots still act by the regression
    ensemble. The quantile forgets within 1,000 timesteps, and is over robots that move on their own.

    Reference: Datta et al., IIFL, 2023 (Section 4, and the published code, where the threshold is fixed, or, as an option, the
    99.9th percentile over all robots of the last 1,000 steps).
    """
    return _at_a_rate(lambda signals: known(signals.estimates["divergence"]), config, "iifl_rate")


def _at_a_rate(value_of: Callable[[Signals], jax.Array], config, rate: str) -> Priority:
    """Return the gate that asks where a value f32[N] is above its running quantile at level 1 - the parameter `rate`."""

    def score(signals, past, key):
        del key
        value = value_of(signals)
        past = add(past, value, on_their_own(signals), jnp.float32(MEMORY))
        return gated(signals, jnp.where(value > quantile(past, 1.0 - config.parameters[rate]), value, 0.0)), past

    return Priority(empty, score)


def _check_states(config, spec) -> None:
    """Check that demonstrations have enough states for a distance to the 5th nearest of the others."""
    del spec
    number = config.num_demonstrations
    if not isinstance(number, Tracer) and np.min(np.asarray(number)) <= NEIGHBOURS:
        raise ValueError(f"num_demonstrations = {number} must be more than {NEIGHBOURS} for algorithm = 'crsail'")


LEARNT: dict[str, Algorithm] = {
    "crsail": Algorithm(crsail, estimators=("novelty",), parameters=PARAMETERS["crsail"], check=_check_states),
    "conformal": Algorithm(conformal, parameters=PARAMETERS["conformal"]),
    "aim": Algorithm(aim, estimators=("intervention",), parameters=PARAMETERS["aim"]),
    "iifl": Algorithm(iifl, estimators=("divergence",), parameters=PARAMETERS["iifl"]),
}

"""Gates at a rate: ThriftyDAgger's own switching rule, and the ensemble's uncertainty above its running quantile."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority
from fleetjax.priority.gates import gated, known, teleoperated
from fleetjax.priority.quantiles import Histogram, add, empty, on_their_own, quantile


def quantile_ensemble(config) -> Priority:
    """U > q, the running quantile of U at level 1 - `quantile_rate`, over robots that move on their own.

    The quantile forgets within `quantile_memory` timesteps. With `quantile_calibration` = t > 0 it stays as it is from
    timestep t on; with 0 it is always refitted.

    Reference: EnsembleDAgger (Menda et al. 2019) thresholds the variance, and the difference from the human's action, which a
    fleet does not know before it asks. Reimplemented from the text, with ThriftyDAgger's quantile in place of the threshold.
    """
    own = config.parameters

    def score(signals, past, key):
        del key
        values = known(signals.uncertainty)
        fitted = add(past, values, on_their_own(signals), own["quantile_memory"])
        until = own["quantile_calibration"]
        frozen = (until > 0) & (signals.timestep.astype(jnp.float32) >= until)
        past = jax.tree.map(lambda old, new: jnp.where(frozen, old, new), past, fitted)
        bound = quantile(past, 1.0 - own["quantile_rate"])
        return gated(signals, jnp.where(values > bound, values, 0.0)), past

    return Priority(empty, score)


class Past(NamedTuple):
    """What `thrifty_quantile` remembers.

    Attributes:
        doubt: Histogram of uncertainties.
        odds: Histogram of the roots of the odds of success.
    """

    doubt: Histogram
    odds: Histogram


def root_odds(chance: jax.Array) -> jax.Array:
    """Return sqrt(G / (1 - G)): bins on a logarithmic scale are as narrow near G = 1 as near 0."""
    return jnp.sqrt(chance / jnp.maximum(1.0 - chance, 1e-12))


def thrifty_quantile(config) -> Priority:
    """Ask if U > q_U(1 - a) or G < q_G(a), with a = `thrifty_rate`; hand back if |a_r - a_h|^2 < its mean and G > q_G(1/2).

    q are running quantiles over robots that move on their own. They forget within `thrifty_memory` timesteps, where the
    original refits them after each episode. The mean is the current policy's mean squared difference from the
    human actions, over a batch of all human data (the estimator `"mean_discrepancy"`); the original computes it once, after
    cloning, over all demonstrations. G is the goal critic's chance of success, with the discount `goal_discount`, 0.999 (in
    the original 0.9999); where the environment has no goals, it is 1 - R. Robots that ask are ordered by max(U / q_U, q_G / G).
    A robot that still asks when its human would hand back keeps that human; in the original it may ask again a timestep later.

    Reference: Hoque et al., ThriftyDAgger, 2021 (Section 4, and the published code: a = 0.01). Its start values 0.48 and
    0.495 are not used: the first timestep gives the first quantiles.
    """
    rate, memory = config.parameters["thrifty_rate"], config.parameters["thrifty_memory"]

    def init():
        return Past(empty(), empty())

    def score(signals, past, key):
        del key
        has_goal = "goal" in signals.estimates
        doubt, chance = known(signals.uncertainty), known(signals.goal if has_goal else 1.0 - signals.risk)
        alone, taught = on_their_own(signals), teleoperated(signals)
        odds = root_odds(chance)
        past = Past(add(past.doubt, doubt, alone, memory), add(past.odds, odds, alone, memory))
        most, least = quantile(past.doubt, 1.0 - rate), quantile(past.odds, rate)
        asks = (doubt > most) | (odds < least)
        least_chance = least**2 / (1.0 + least**2)
        urgency = jnp.maximum(doubt / jnp.maximum(most, 1e-6), least_chance / jnp.maximum(chance, 1e-6))
        agrees = signals.correction < signals.estimates["mean_discrepancy"]
        keeps = taught & ~(agrees & (odds > quantile(past.odds, 0.5)))
        return gated(signals, jnp.where(asks, urgency, 0.0), keeps), past

    return Priority(init, score)


QUANTILES: dict[str, Algorithm] = {
    "quantile_ensemble": Algorithm(quantile_ensemble, parameters=PARAMETERS["quantile_ensemble"]),
    "thrifty_quantile": Algorithm(
        thrifty_quantile,
        estimators=("safety", "goal", "mean_discrepancy"),
        optional=("goal",),
        parameters=PARAMETERS["thrifty_quantile"],
    ),
}

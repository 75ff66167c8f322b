"""Gates by how far the robot's action is from the human's: predicted by a classifier, by the ensemble, or known."""

from typing import Any

import jax
import jax.numpy as jnp

from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.gates import gated, known, teleoperated
from fleetjax.priority.ranks import above

SAMPLES = 32  # of each robot's action


def distance(signals) -> jax.Array:
    """Return f32[N], the mean squared difference between robot's and human's action, per dimension."""
    return jnp.mean((signals.robot_action - signals.human_action) ** 2, axis=-1)


def safe_dagger(config) -> Priority:
    """Ask if P(d > tau) >= `safe_threshold`, for the difference d = mean (a_r - a_h)^2 of actions and tau = `discrepancy_tau`.

    P is the `"discrepancy"` classifier's. It learns from all human data, as the policy does, so it sees smaller differences
    than on new states; LazyDAgger's published code keeps a part of the data from the policy.

    The default tau is 0.0025 per dimension. The original compares the squared norm, a sum over dimensions, with 0.0025, which
    is stricter.

    Reference: Zhang and Cho, SafeDAgger, 2017; reimplemented from the text.
    """
    threshold = config.parameters["safe_threshold"]
    return stateless(lambda signals, key: gated(signals, above(known(signals.estimates["discrepancy"]), threshold)))


def lazy_dagger(config) -> Priority:
    """Ask if P(d > tau) >= `lazy_threshold`, as `safe_dagger`; hand back if the human's d < `lazy_handback` tau.

    A robot that still asks then keeps its human; in the original the human hands back, and the robot may ask again a timestep
    later. Two thresholds make fewer and longer interventions. The original's tau, 0.008 of the sum of the actions' squared
    ranges, is 0.032 per dimension of [-1, 1]. The original may also execute the human's action with noise, and records the
    action without it. That option is not here: with `action_noise`, which models people, the noisy action is recorded.

    Reference: Hoque et al., LazyDAgger, 2021 (Algorithm 1, and the published code: the hand-back's factor is 0.25).
    """
    own = config.parameters

    def score(signals, key):
        del key
        asking = above(known(signals.estimates["discrepancy"]), own["lazy_threshold"])
        agrees = signals.correction < own["lazy_handback"] * own["discrepancy_tau"]
        return gated(signals, asking, teleoperated(signals) & ~agrees)

    return stateless(score)


def dropout_dagger(config) -> Priority:
    """Ask if p < `dropout_share`, for the share p of sampled actions a with mean (a - a_h)^2 <= `dropout_threshold`.

    As in the original, the rule needs the human's action before it asks, so it cannot be used on real fleets. Samples come from
    a normal distribution with the ensemble's mean and, in every dimension, its mean variance U; the original samples networks
    with dropout. Where actions are discrete, U is an entropy, and the noise on one-hot actions is only a rough stand-in.

    Reference: Menda et al., DropoutDAgger, 2017; reimplemented from the text.
    """
    own = config.parameters

    def score(signals, key):
        spread = jnp.sqrt(known(signals.uncertainty))[:, None]
        draws = jax.random.normal(key, (SAMPLES, *signals.robot_action.shape))
        apart = jnp.mean((signals.robot_action + spread * draws - signals.human_action) ** 2, axis=-1)
        share = jnp.mean(apart <= own["dropout_threshold"], axis=0, dtype=jnp.float32)
        return gated(signals, jnp.where(share < own["dropout_share"], 1.0 - share, 0.0))

    return stateless(score)


def oracle_discrepancy(config) -> Priority:
    """Ask if mean (a_r - a_h)^2 of actions >= `oracle_threshold`: the ceiling for rules that predict this difference.

    It sees what the human would do on every robot, so it is no rule for real fleets. It has no published source.
    """
    threshold = config.parameters["oracle_threshold"]
    return stateless(lambda signals, key: gated(signals, above(known(distance(signals)), threshold)))


def _algorithm(name: str, make_priority, **others: Any) -> Algorithm:
    return Algorithm(make_priority, parameters=PARAMETERS[name], **others)


DISCREPANCIES: dict[str, Algorithm] = {
    "safe_dagger": _algorithm("safe_dagger", safe_dagger, estimators=("discrepancy",)),
    "lazy_dagger": _algorithm("lazy_dagger", lazy_dagger, estimators=("discrepancy",)),
    "dropout_dagger": _algorithm("dropout_dagger", dropout_dagger, sees_supervisor=True),
    "oracle_discrepancy": _algorithm("oracle_discrepancy", oracle_discrepancy, sees_supervisor=True),
}

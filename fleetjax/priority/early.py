"""Help early: what the policy learns from an action helps until the end of the run."""

import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority
from fleetjax.priority.ranks import lexicographic


def teach_first(config) -> Priority:
    """Help random moving robots until humans have acted for `teaching_time` timesteps in all; after that, only reset robots.

    Violations come last in the first half of that time: a robot would soon fall again under a policy that has yet to learn. In
    the second half they come first.

    Reference: fleetjax's own rule; docs/beat_cur.md compares it with others.
    """

    def score(signals, taught, key):
        taught += sharding.total(signals.given.astype(jnp.float32))
        share = taught / config.parameters["teaching_time"]
        chance = jnp.where(signals.violation | (share >= 1), 0.0, jax.random.uniform(key, signals.violation.shape))
        waits = signals.violation & (share < 0.5)
        return lexicographic(signals.violation & ~waits, chance, waits), taught

    return Priority(init=lambda: jnp.zeros(()), score=score)


EARLY: dict[str, Algorithm] = {"teach_first": Algorithm(teach_first, parameters=PARAMETERS["teach_first"])}

"""Help early: what the policy learns from an action pays for the rest of the run."""

import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority
from fleetjax.priority.ranks import lexicographic


def teach_first(config) -> Priority:
    """Moving robots at random until humans have acted `teaching_time` times in all, then robots in violation only.

    While they teach, humans reset robots only when no moving robot is left to help. So early violations wait, as in C.U.R.'s
    initial period: a robot would soon fall again under a policy that has yet to learn.

    Reference: fleetjax's own rule; docs/beat_cur.md has what was tried, and figures.
    """

    def score(signals, taught, key):
        taught += sharding.total(signals.given.astype(jnp.float32))
        teaches = ~signals.violation & (taught < config.parameters["teaching_time"])
        chance = jax.random.uniform(key, signals.violation.shape)
        return lexicographic(jnp.where(teaches, chance, 0.0), signals.violation), taught

    return Priority(init=lambda: jnp.zeros(()), score=score)


EARLY: dict[str, Algorithm] = {"teach_first": Algorithm(teach_first, parameters=PARAMETERS["teach_first"])}

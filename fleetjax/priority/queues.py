"""What operators do without any estimate: one robot after the other, or violations first come, first served."""

import jax.numpy as jnp

from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, PerRobot, Priority
from fleetjax.priority.gates import helped


def round_robin(config) -> Priority:
    """Help the robot that has been without help longest, but none within `round_robin_threshold` timesteps of its last help.

    At its first score, robot i (from 0) counts as having waited N + 1 - i timesteps.
    Operators do so out of habit; the rule has no published source.
    """
    threshold = config.parameters["round_robin_threshold"]

    def init():
        return PerRobot(jnp.arange(config.num_robots, 0, -1, dtype=jnp.float32))

    def score(signals, without, key):
        del key
        without = jnp.where(helped(signals), 0.0, without.values + 1.0)
        return jnp.where(without > threshold, without, 0.0), PerRobot(without)

    return Priority(init, score)


def longest_waiting(config) -> Priority:
    """Violations, first come, first served: C by the number of timesteps for which a robot has been in violation.

    Operators serve a queue of alarms in this way; the rule has no published source.
    """

    def init():
        return PerRobot(jnp.zeros(config.num_robots))

    def score(signals, waited, key):
        del key
        waited = jnp.where(signals.violation, waited.values + 1.0, 0.0)
        return waited, PerRobot(waited)

    return Priority(init, score)


QUEUES: dict[str, Algorithm] = {
    "round_robin": Algorithm(round_robin, parameters=PARAMETERS["round_robin"]),
    "longest_waiting": Algorithm(longest_waiting),
}

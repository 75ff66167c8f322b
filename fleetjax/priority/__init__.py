"""Rules for who gets help: from signals of the robots to scores (paper, Section 4.2). One file per family.

A rule is a `Priority`: two pure functions. A new one is about ten lines:

    def make_least_certain(config):
        def score(signals, aux, key):
            return jnp.where(signals.violation, 1.0, signals.uncertainty), aux

        return Priority(init=lambda: (), score=score)

    fleetjax.register_priority("least_certain", make_least_certain)
"""

from fleetjax.priority.base import (
    ALGORITHMS,
    Algorithm,
    PerRobot,
    Priority,
    estimators_of,
    get_algorithm,
    list_algorithms,
    register_algorithm,
    register_priority,
    stateless,
)
from fleetjax.priority.baselines import BASELINES
from fleetjax.priority.coverage import COVERAGE
from fleetjax.priority.dagger import DAGGERS
from fleetjax.priority.discrepancy import DISCREPANCIES
from fleetjax.priority.early import EARLY
from fleetjax.priority.learnt import LEARNT
from fleetjax.priority.orders import RULES
from fleetjax.priority.quantile import QUANTILES
from fleetjax.priority.queues import QUEUES
from fleetjax.priority.ranks import above, lexicographic, softly_above
from fleetjax.priority.weighted import WEIGHTED
from fleetjax.priority.whittle import WHITTLE

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "PerRobot",
    "Priority",
    "above",
    "estimators_of",
    "get_algorithm",
    "lexicographic",
    "list_algorithms",
    "register_algorithm",
    "register_priority",
    "softly_above",
    "stateless",
]

_GATES = {**QUANTILES, **DISCREPANCIES, **LEARNT, **QUEUES, **WHITTLE, **COVERAGE, **EARLY}
for _name, _algorithm in {**BASELINES, **DAGGERS, **_GATES, **WEIGHTED, **RULES}.items():
    register_algorithm(_name, _algorithm)

"""Rules by the letters C, U and R in any order, such as C.U.R.: violations, then uncertainty, then risk."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from fleetjax.field import ORDERS, PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.ranks import above, lexicographic


def in_order(letters: str) -> Callable[[Any], Priority]:
    """Return the maker of a priority by the letters C, U and R in any order, such as C.U.R.

    C is violation, U uncertainty above its threshold, R risk above its threshold. Orders that contain C give violating
    robots priority 0 in the initial period. With `idle_humans_teleoperate`, moving robots that nobody is needed for compete at
    random in that period, behind all others.

    Reference: paper, Section 4.2 (C.U.R.) and Appendix (ablations); idle humans: the authors' published code.
    """

    def make(config) -> Priority:
        def score(signals, key):
            columns = {
                "c": signals.violation,
                "u": above(signals.uncertainty, config.uncertainty_threshold),
                "r": above(signals.risk, config.risk_threshold),
            }
            early = ("c" in letters) & (signals.timestep < config.initial_period)
            waits = early & signals.violation
            ranks = lexicographic(*(jnp.where(waits, 0.0, columns[letter].astype(jnp.float32)) for letter in letters))
            if "c" not in letters:
                return ranks
            idle = early & config.parameters["idle_humans_teleoperate"] & ~waits & (ranks == 0)
            chance = jax.random.uniform(key, ranks.shape)  # below every rank but 0
            return jnp.where(idle, chance, ranks)

        return stateless(score)

    return make


RULES: dict[str, Algorithm] = {
    letters: Algorithm(
        in_order(letters), estimators=("safety",) if "r" in letters else (), parameters=PARAMETERS.get(letters, {})
    )
    for letters in ORDERS
}

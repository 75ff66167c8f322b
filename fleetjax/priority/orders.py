"""Rules by the letters C, U and R in any order, such as C.U.R.: violations, then uncertainty, then risk."""

import itertools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.ranks import above, lexicographic


def in_order(letters: str) -> Callable[[Any], Priority]:
    """Return the maker of a priority by the letters C, U and R in any order, such as C.U.R.

    C is violation, U uncertainty above its threshold, R risk above its threshold. Orders that contain C give violating
    robots priority 0 in the initial period.

    Reference: paper, Section 4.2 (C.U.R.) and Appendix (ablations).
    """

    def make(config) -> Priority:
        def score(signals, key):
            del key
            columns = {
                "c": signals.violation,
                "u": above(signals.uncertainty, config.uncertainty_threshold),
                "r": above(signals.risk, config.risk_threshold),
            }
            ranks = lexicographic(*(columns[letter] for letter in letters))
            if "c" not in letters:
                return ranks
            postponed = signals.violation & (signals.timestep < config.initial_period)
            return jnp.where(postponed, 0.0, ranks)

        return stateless(score)

    return make


ORDERS: dict[str, Algorithm] = {
    letters: Algorithm(in_order(letters), estimators=("safety",) if "r" in letters else ())
    for size in (3, 2, 1)
    for letters in map("".join, itertools.permutations("cur", size))
}

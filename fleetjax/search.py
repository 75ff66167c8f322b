"""Find where a number that is slow to measure takes a given value: a few measurements, no derivative, no monotony assumed."""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

FIRST_STEP = math.log(3)  # in the scaled parameter
LIMIT = 16.0  # of the scaled parameter: from about 1e-7 to 1e7, or so near to 0 and 1


class Scale(NamedTuple):
    """How a parameter is searched: by its logarithm, or by its log-odds where 1 is its largest value.

    Attributes:
        bounded: whether it lies between 0 and 1.
        least: smallest value that is allowed.
        most: largest value that is allowed.
        rises: whether what is measured mostly rises with the value; it falls with a threshold.
    """

    bounded: bool
    least: float = 0.0
    most: float = math.inf
    rises: bool = False

    def inward(self, value: float) -> float:
        """Return the scaled parameter."""
        value = max(value, math.exp(-LIMIT))
        return math.log(value) - (math.log(max(1 - value, math.exp(-LIMIT))) if self.bounded else 0.0)

    def outward(self, scaled: float) -> float:
        """Return the parameter.

        >>> scale = Scale(bounded=True)
        >>> round(scale.outward(scale.inward(0.998)), 6)
        0.998
        """
        value = 1 / (1 + math.exp(-scaled)) if self.bounded else math.exp(scaled)
        return min(max(value, self.least), self.most)


def solve(
    measure: Callable[[float], float],
    wanted: float,
    start: float,
    scale: Scale,
    *,
    tolerance: float,
    most: int,
    step: float = FIRST_STEP,
) -> list[tuple[float, float]]:
    """Measure at one value after another, until one gives what is wanted or no measurement is left.

    From `start` the search takes growing steps both ways, first to where the number should be nearer, until two neighbours lie
    on both sides of what is wanted. Between them it interpolates.

    Args:
        measure: `value -> number`, at least 0.
        wanted: the number that is wanted, more than 0.
        start: the first value.
        scale: of the values.
        tolerance: relative difference that is near enough.
        most: measurements at most.
        step: first step, in the scaled parameter.

    Returns:
        Values and what was measured there, in order; the nearest need not be the last.

    >>> found = solve(lambda value: 100 / value, 40.0, 1.0, Scale(bounded=False), tolerance=0.01, most=8)
    >>> round(found[-1][0], 2), len(found) <= 5
    (2.5, True)
    """
    tried: dict[float, float] = {}
    scaled = scale.inward(start)
    while len(tried) < most:
        tried[scaled] = measure(scale.outward(scaled))
        if abs(tried[scaled] - wanted) <= tolerance * wanted:
            break
        following = _between(tried, wanted)
        if following is None:
            following = _beyond(tried, wanted, scale, step)
        if following is None:
            break
        scaled = following
    return [(scale.outward(scaled), number) for scaled, number in tried.items()]


def _between(tried: dict[float, float], wanted: float) -> float | None:
    """Return where to measure between two neighbours that lie on both sides; the narrowest such pair is taken."""
    places = sorted(tried)
    pairs = [(a, b) for a, b in itertools.pairwise(places) if (tried[a] > wanted) != (tried[b] > wanted)]
    if not pairs:
        return None
    a, b = min(pairs, key=lambda pair: pair[1] - pair[0])
    if b - a < 1e-4:
        return None
    high, low, goal = (math.log1p(x) for x in (tried[a], tried[b], wanted))
    share = (goal - high) / (low - high)
    return a + (b - a) * min(max(share, 0.15), 0.85)  # else one end could stay for ever


def _beyond(tried: dict[float, float], wanted: float, scale: Scale, step: float) -> float | None:
    """Return where to measure outside of all values so far, now on one side, now on the other; None if both are exhausted."""
    places = sorted(tried)
    step *= 1.5 ** (len(places) - 1)
    up, down = places[-1] + step, places[0] - step
    upward = (tried[places[-1 if scale.rises else 0]] > wanted) != scale.rises
    if len(places) >= 3 and abs(tried[places[0 if upward else -1]] - wanted) < abs(tried[places[-1 if upward else 0]] - wanted):
        upward = not upward  # the other end is nearer
    order = (up, down) if upward else (down, up)
    return next((place for place in order if abs(place) <= LIMIT), None)

"""The model of imperfect humans that fits what people did in a console session."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy import stats

from fleetjax.console.engine import PERSON
from fleetjax.field import FIELDS

FEWEST = 5  # first actions that a fit needs
WIDEST = 2.0  # deviation of times, as a share of their mean, that a lognormal fit may have


class Takeover(NamedTuple):
    """How long a person took for its first action on a robot.

    Attributes:
        time: timesteps from the assignment to the first action or hard reset, or to the end of help without one.
        acted: whether there was one.
        switched: whether the person came straight from another robot.
    """

    time: int
    acted: bool
    switched: bool


class Fit(NamedTuple):
    """The parameters of `Config` for people like those of a session; times are in timesteps.

    Attributes:
        takeover_time: mean time to the first action, for people who were free before; for all if there are too few of those.
        takeover_spread: its standard deviation, as a share of the mean.
        switching_lag: further time for those who come from another robot.
        absence: share of the time for which people were away, from their arrival to their last timestep.
        absence_time: mean time for which they were away; the default of `Config` if they never were.
    """

    takeover_time: float
    takeover_spread: float
    switching_lag: float
    absence: float
    absence_time: float


def takeovers(rows: np.ndarray, seat: int) -> list[Takeover]:
    """Return the takeovers of the people in a seat, in order.

    Args:
        rows: of a record, see `record.row_type`.
        seat: which seat.
    """
    there = rows["seat"][:, seat] == PERSON
    robots = np.where(there, rows["robot"][:, seat], -1)
    acts = there & ((rows["given"][:, seat] == 1) | (rows["confirmed"][:, seat] == 1))
    before = np.concatenate([[-1], robots[:-1]])
    begins = np.flatnonzero((robots >= 0) & (robots != before))
    found = []
    for begin in begins:
        changes = np.flatnonzero(robots[begin:] != robots[begin])
        end = begin + changes[0] if changes.size else len(robots)
        first = np.flatnonzero(acts[begin:end])
        if first.size or changes.size:  # else the session ended before the first action
            time = int(first[0]) if first.size else int(end - begin)
            found.append(Takeover(time, bool(first.size), bool(before[begin] >= 0)))
    return found


def absences(rows: np.ndarray, seat: int) -> tuple[int, list[int]]:
    """Return the timesteps from a seat's first person to its last, and the lengths of the gaps in between."""
    there = np.flatnonzero(rows["seat"][:, seat] == PERSON)
    if not there.size:
        return 0, []
    gaps = np.diff(there) - 1
    return int(there[-1] - there[0] + 1), [int(gap) for gap in gaps if gap > 0]


def fit(rows: np.ndarray, seats: Iterable[int], *, absence_time: float) -> Fit:
    """Return the model that fits the people in some seats.

    Times are lognormal, as in `fleetjax.humans.make_imperfect`. They are known to the timestep. If help ended before the
    first action, the takeover would have taken longer.

    Args:
        rows: of a record, see `record.row_type`.
        seats: whose people are taken together.
        absence_time: of people who were never away.

    Raises:
        ValueError: if there are fewer than `FEWEST` first actions.
    """
    seats = list(seats)
    times = [one for seat in seats for one in takeovers(rows, seat)]
    acted = sum(one.acted for one in times)
    if acted < FEWEST:
        raise ValueError(f"people took over robots {acted} times; at least {FEWEST} are needed to fit a model")
    groups = [[one for one in times if one.switched == switched] for switched in (False, True)]
    enough = [group for group in groups if sum(one.acted for one in group) >= FEWEST]
    mean, spread = _lognormal(groups[0] if groups[0] in enough else times)
    lag = max(_lognormal(groups[1])[0] - mean, 0.0) if len(enough) == 2 else 0.0
    spans, gaps = zip(*(absences(rows, seat) for seat in seats), strict=True)
    away = [gap for each in gaps for gap in each]
    share = min(sum(away) / max(sum(spans), 1), FIELDS["absence"].high or 1.0)
    return Fit(mean, spread, lag, share, sum(away) / len(away) if away else absence_time)


def _lognormal(times: list[Takeover]) -> tuple[float, float]:
    """Return mean and standard deviation, as a share of the mean, of the likeliest lognormal distribution.

    Where many act at once and some much later, no lognormal distribution fits; then these are the times' own, of which the
    deviation is at most `WIDEST`.
    """
    ends = [(max(one.time - 0.5, 0.0), one.time + 0.5) for one in times if one.acted]
    longer = [one.time - 0.5 for one in times if not one.acted]  # the last timestep of this help would be `time - 1`
    if max(high for _, high in ends) <= 0.5 and not longer:
        return 0.0, FIELDS["takeover_spread"].default  # all acted at once
    with np.errstate(divide="ignore"):  # the search may try a distribution that excludes a time
        shape, _, scale = stats.lognorm.fit(stats.CensoredData(interval=ends, right=longer), floc=0)
    if shape > math.sqrt(math.log1p(WIDEST**2)):
        mean = float(np.mean([one.time for one in times]))
        return mean, min(float(np.std([one.time for one in times])) / mean, WIDEST)
    return float(scale * math.exp(shape**2 / 2)), math.sqrt(math.expm1(shape**2))


def report(rows: np.ndarray, *, absence_time: float) -> Iterator[tuple[str, ...]]:
    """Return a table: a row for each seat that a person took, and one for all of them."""
    seats = people(rows)
    yield ("", "first actions", *(name.replace("_", " ") for name in Fit._fields))
    for name, chosen in [*((f"seat {seat + 1}", [seat]) for seat in seats), ("all", seats)]:
        acted = sum(one.acted for seat in chosen for one in takeovers(rows, seat))
        enough = acted >= FEWEST
        values = [f"{x:.3g}" for x in fit(rows, chosen, absence_time=absence_time)] if enough else ["-"] * len(Fit._fields)
        yield (name, str(acted), *values)


def people(rows: np.ndarray) -> list[int]:
    """Return the seats that people took."""
    return [seat for seat in range(rows["seat"].shape[1]) if np.any(rows["seat"][:, seat] == PERSON)]

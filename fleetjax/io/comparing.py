"""Compare groups of runs: `fleetjax.compare`."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax import statistics
from fleetjax.io import text
from fleetjax.io.comparison import Comparison, from_rows
from fleetjax.io.outcomes import Group, Outcome, group
from fleetjax.io.sources import Source, collect
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm

METRICS = ("successes", "violations", "idle", "rohe")  # that are compared unless others are asked for
KNOWN = (*Metrics._fields, "rohe", "rohe_with_demonstrations")
_NOTHING: dict[str, Any] = {
    "against": "",
    "pairs": 0,
    "difference": math.nan,
    "difference_low": math.nan,
    "difference_high": math.nan,
    "difference_bounds": "",
    "probability_higher": math.nan,
    "p_value": math.nan,
}


def compare(
    runs: str | Path | Iterable[Source],
    against: str | None = None,
    metrics: str | Sequence[str] = METRICS,
    *,
    allow_different: bool = False,
) -> Comparison:
    """Compare runs over their seeds. Runs that differ in nothing but their seed are one group.

    Args:
        runs: each is a run folder, a folder that holds run folders, a CSV file that `fleetjax compare --rows` wrote, or a
            configuration with a seed and its Metrics[T] or `Result`, or with S seeds and Metrics[S, T].
        against: the group to compare the others with, by its algorithm or its name in the table.
        metrics: fields of `Metrics`, of which the total counts; `rohe`, the return on human effort at the end; and
            `rohe_with_demonstrations`, for which the extra demonstrations of the constraint baselines count as human time.
        allow_different: compare runs of different length or fleet size all the same, and runs that were interrupted.

    Raises:
        ValueError: if there are no runs, one is damaged, they differ in length or size, or a metric or group is unknown.
    """
    found, names = collect(runs), [metrics] if isinstance(metrics, str) else list(metrics)
    for name in names:
        if name not in KNOWN:
            raise ValueError(f"metric = {name!r} is unknown; choose from {', '.join(KNOWN)}")
    if not allow_different:
        _check_alike(found)
    groups = group(found)
    references = _references(groups, against)
    return from_rows(
        _row(one, metric, references.get(place))
        for place in dict.fromkeys(one.config.environment for one in groups)
        for metric in names
        for one in groups
        if one.config.environment == place
    )


def _row(one: Group, metric: str, other: Group | None) -> dict[str, Any]:
    """Return a row of a comparison: statistics of a group, and how it differs from another."""
    by_seed = values_by_seed(one, metric)
    values = np.array(list(by_seed.values()))
    low, high = statistics.mean_bounds(values)
    row = {
        "environment": one.config.environment,
        "metric": metric,
        "group": one.label,
        "seeds": len(values),
        "mean": np.mean(values),
        "low": low,
        "high": high,
        "bounds": _kind(len(values)),
        "interquartile_mean": statistics.interquartile_mean(values),
        "human_time": np.mean(list(values_by_seed(one, "human_steps").values())),
    }
    if other is None or other is one:
        return row | _NOTHING
    return row | {"against": other.label} | _difference(by_seed, values_by_seed(other, metric))


def _difference(values: Mapping[int, float], others: Mapping[int, float]) -> dict[str, Any]:
    """Return how the values of a group differ from another's, both by seed; paired if they share two seeds or more."""
    x, y = np.array(list(values.values())), np.array(list(others.values()))
    shared = sorted(values.keys() & others.keys())
    if len(shared) < 2:
        pairs, seeds, difference, (low, high) = 0, min(len(x), len(y)), x.mean() - y.mean(), statistics.difference_bounds(x, y)
    else:
        differences = np.array([values[seed] - others[seed] for seed in shared])
        pairs = seeds = len(shared)
        difference, (low, high) = differences.mean(), statistics.mean_bounds(differences)
    probability, p_value = statistics.probability_higher(x, y)
    return {
        "pairs": pairs,
        "difference": difference,
        "difference_low": low,
        "difference_high": high,
        "difference_bounds": _kind(seeds),
        "probability_higher": probability,
        "p_value": p_value,
    }


def _kind(seeds: int) -> str:
    return "range" if seeds < statistics.MIN_SEEDS else "interval"


def interval(values: np.ndarray) -> str:
    """Return the mean of values f64[S] with its 95 % interval, or their range where there are few, as text; one value alone.

    >>> interval(np.array([3.0, 1.0, 2.0])), interval(np.array([3.0]))
    ('2 (1 to 3)', '3')
    """
    mean = text.number(float(values.mean()))
    if len(values) == 1:
        return mean
    low, high = statistics.mean_bounds(values)
    return f"{mean} ({text.number(float(low))} to {text.number(float(high))})"


def values(one: Group, metric: str) -> np.ndarray:
    """Return what the runs of a group achieved f64[S]."""
    return np.array(list(values_by_seed(one, metric).values()))


def values_by_seed(one: Group, metric: str) -> dict[int, float]:
    """Return what the runs of a group achieved, by seed."""
    return {seed: _value(run, metric) for seed, run in one.runs.items()}


def ratio(one: Group, other: Group, metric: str) -> float | None:
    """Return what a group achieved relative to another, over the seeds that both have; None if the other achieved nothing."""
    mine, others = _of_both(one, other, metric)
    return float(mine.sum() / others.sum()) if others.sum() else None


def ratio_interval(one: Group, other: Group, metric: str) -> str:
    """Return the same with its 95 % interval, or the range of the ratios of few seeds, as text; "" if there is none."""
    mine, others = _of_both(one, other, metric)
    if not others.sum():
        return ""
    number = f"{mine.sum() / others.sum():.2f}"
    if len(mine) == 1 or not np.all(others):
        return number
    low, high = statistics.ratio_bounds(mine, others)
    return f"{number} ({low:.2f} to {high:.2f})"


def _of_both(one: Group, other: Group, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return what two groups achieved f64[S], over the seeds that both have."""
    mine, others = (values_by_seed(each, metric) for each in (one, other))
    shared = sorted(mine.keys() & others.keys())
    return np.array([mine[seed] for seed in shared]), np.array([others[seed] for seed in shared])


def _value(run: Outcome, metric: str) -> float:
    """Return what a run achieved.

    Raises:
        ValueError: if it has no such metric.
    """
    total = text.add_up(run.metrics)
    if metric == "rohe_with_demonstrations":
        total["human_steps"] += float(run.config.extra_demonstrations)
    found = total[metric] if metric in total else text.rohe_of(total, run.config)
    if not math.isfinite(found):
        raise ValueError(f"{run.name} has no {metric}; choose another --metric")
    return found


def _references(groups: Sequence[Group], against: str | None) -> dict[str, Group]:
    """Return the group that is compared with, for each environment that has it.

    Raises:
        ValueError: if there is none, or an algorithm's name stands for several.
    """
    found: dict[str, Group] = {}
    for place in dict.fromkeys(one.config.environment for one in groups) if against else ():
        here = [one for one in groups if one.config.environment == place]
        named = [one for one in here if one.label == against] or [one for one in here if one.config.algorithm == against]
        if len(named) > 1:
            names = "; ".join(one.label for one in named)
            raise ValueError(f"against = {against!r} stands for several groups of {place}; choose one of: {names}")
        if named:
            found[place] = named[0]
    if against and not found:
        names = "; ".join(dict.fromkeys(one.label for one in groups))
        raise ValueError(f"against = {against!r} is not among the groups; choose an algorithm or one of: {names}")
    return found


def _check_alike(runs: Sequence[Outcome]) -> None:
    """Check that the runs of each environment can be compared.

    Raises:
        ValueError: if one was interrupted, or two differ in their length or size; an algorithm may set its own.
    """
    first: dict[tuple[str, str], Outcome] = {}
    for run in runs:
        steps, wanted = run.timesteps[-1], run.config.num_steps
        if steps != wanted:
            raise ValueError(f"{run.name} has {steps} of {wanted} timesteps; finish it, or compare with --allow-different")
        for name in ("num_steps", "num_robots", "num_humans"):
            if name in get_algorithm(run.config.algorithm).defaults(run.config):
                continue  # expert has a human for each robot
            other = first.setdefault((run.config.environment, name), run)
            mine, others = getattr(run.config, name), getattr(other.config, name)
            if mine != others:
                raise ValueError(
                    f"{name} = {others} in {other.name}, but {mine} in {run.name}; compare them anyway with --allow-different"
                )

"""The result of `fleetjax.compare`, as columns, as Markdown and as CSV."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fleetjax.io import text
from fleetjax.statistics import MIN_SEEDS

_NOTES = f"""\
mean: over seeds. 95 % interval: of the mean, BCa bootstrap over seeds. range: smallest to largest,
in place of an interval where there are fewer than {MIN_SEEDS} seeds. IQM: interquartile mean, the mean of
the middle half of the seeds. human time: mean number of human timesteps in a run."""
_NOTES_ON_DIFFERENCES = """\
pairs: seeds that both groups have. The difference is the mean over them; with 0 pairs, it is the
difference between the means. P(higher): probability that a run of the group has a higher value than
a run of the other, ties counting half: the probability of improvement where more is better.
p: of the two-sided Mann-Whitney test."""


class Comparison(NamedTuple):
    """Statistics over seeds as numpy columns [R], a row for each environment, metric and group; NaN or "" where there is none.

    Attributes:
        environment: where the group was run.
        metric: what is compared: a total over the run, or the return on human effort at its end.
        group: what tells the group from others of its environment: the algorithm, and the fields in which groups differ.
        seeds: number of runs.
        mean: mean over seeds.
        low: lower bound of the mean, or the smallest value.
        high: upper bound of the mean, or the largest value.
        bounds: "interval": 95 %, BCa bootstrap; "range" below five seeds.
        interquartile_mean: mean of the middle half of the seeds.
        human_time: mean human timesteps.
        against: the group that it is compared with.
        pairs: seeds that both groups have; 0 if they have fewer than two in common, and are not paired.
        difference: mean difference of the pairs, or difference between the means.
        difference_low: its lower bound, or the smallest difference.
        difference_high: its upper bound, or the largest difference.
        difference_bounds: "interval" or "range".
        probability_higher: probability that a run of the group has a higher value than one of the other, ties counting half.
        p_value: of the two-sided Mann-Whitney test.
    """

    environment: np.ndarray
    metric: np.ndarray
    group: np.ndarray
    seeds: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bounds: np.ndarray
    interquartile_mean: np.ndarray
    human_time: np.ndarray
    against: np.ndarray
    pairs: np.ndarray
    difference: np.ndarray
    difference_low: np.ndarray
    difference_high: np.ndarray
    difference_bounds: np.ndarray
    probability_higher: np.ndarray
    p_value: np.ndarray

    def csv(self) -> str:
        """Return the rows as comma-separated values, empty where there is none."""
        content = io.StringIO(newline="")
        table = csv.DictWriter(content, self._fields, lineterminator="\n")
        table.writeheader()
        table.writerows({name: "" if value != value else value for name, value in row.items()} for row in _rows(self))
        return content.getvalue()

    def markdown(self) -> str:
        """Return a section for each environment, with a table for each metric, and another if groups are compared with one."""
        parts, rows = [], _rows(self)
        for place in dict.fromkeys(row["environment"] for row in rows):
            parts.append(f"## {place}")
            for metric in dict.fromkeys(row["metric"] for row in rows):
                here = [row for row in rows if (row["environment"], row["metric"]) == (place, metric)]
                compared = [row for row in here if row["against"]]
                parts += [f"### {metric}", _means(here), *([_differences(compared)] if compared else [])]
        notes = [_NOTES, *([_NOTES_ON_DIFFERENCES] if np.any(self.against != "") else [])]
        return "\n\n".join([*parts, *notes]) + "\n"


def from_rows(rows: Iterable[Mapping[str, Any]]) -> Comparison:
    """Return the columns that rows have."""
    rows = list(rows)
    return Comparison(**{name: np.array([row[name] for row in rows]) for name in Comparison._fields})


def _rows(columns: Comparison) -> list[dict[str, Any]]:
    values = zip(*(column.tolist() for column in columns), strict=True)
    return [dict(zip(columns._fields, row, strict=True)) for row in values]


def _means(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a metric's means."""
    several = [row["bounds"] for row in rows if row["seeds"] > 1]
    cells = [("group", "seeds", "mean", _head(several), "IQM", "human time")]
    for row in rows:
        mean, low, high, middle = _numbers(row["mean"], row["low"], row["high"], row["interquartile_mean"])
        bounds = _bounds(low, high, row["bounds"], several) if row["seeds"] > 1 else "-"
        cells.append((row["group"], str(row["seeds"]), mean, bounds, middle, text.count(round(row["human_time"]))))
    return text.markdown_table(cells)


def _differences(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a metric's differences from one group."""
    kinds = [row["difference_bounds"] for row in rows]
    cells = [(f"against {rows[0]['against']}", "pairs", "difference", _head(kinds), "P(higher)", "p")]
    for row in rows:
        difference, low, high = _numbers(row["difference"], row["difference_low"], row["difference_high"])
        p = f"{row['p_value']:.3f}" if row["p_value"] >= 0.001 else "<0.001"
        bounds = _bounds(low, high, row["difference_bounds"], kinds)
        cells.append((row["group"], str(row["pairs"]), difference, bounds, f"{row['probability_higher']:.2f}", p))
    return text.markdown_table(cells)


def _head(kinds: Sequence[str]) -> str:
    """Return the name of a column that holds bounds of these kinds."""
    return "95 % interval" + " (range)" * ("range" in kinds) if "interval" in kinds else "range"


def _bounds(low: str, high: str, kind: str, kinds: Sequence[str]) -> str:
    """Return bounds; a range in parentheses if there are intervals in the same column."""
    return f"({low} to {high})" if kind == "range" and "interval" in kinds else f"{low} to {high}"


def _numbers(*values: float) -> list[str]:
    """Return the numbers of a row, all with as many decimals as its largest needs for three digits.

    >>> _numbers(0.5912, 0.4), _numbers(1756.4, -12.2)
    (['0.591', '0.400'], ['1,756', '-12'])
    """
    largest = max(map(abs, values))
    decimals = next((3 - i for i, bound in enumerate((1, 10, 100)) if 0 < largest < bound), 0)
    return [f"{round(value, decimals) + 0.0:,.{decimals}f}" for value in values]  # + 0.0: no negative zero

"""What runs came to, and the groups of those that differ in nothing but their seed."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fleetjax.config import Config
from fleetjax.io import text
from fleetjax.io.plain import to_plain
from fleetjax.metrics import Metrics

MAX_POINTS = 200  # of a thinned curve


class Outcome(NamedTuple):
    """What a run came to.

    Attributes:
        config: its configuration.
        seed: its seed.
        metrics: Metrics[K], as numpy arrays, each count summed over one of K blocks of timesteps.
        timesteps: i64[K] at which the blocks end; the last is the number of timesteps run.
        name: where it was found.
        versions: what it ran under; empty if it is not known.
        processor: what it ran on; empty if it is not known.
    """

    config: Config
    seed: int
    metrics: Metrics
    timesteps: np.ndarray
    name: str
    versions: Mapping[str, str] = {}
    processor: str = ""


class Group(NamedTuple):
    """Runs that differ in nothing but their seed.

    Attributes:
        label: what tells it from other groups of its environment.
        config: of all its runs.
        runs: by seed, in ascending order.
    """

    label: str
    config: Config
    runs: Mapping[int, Outcome]


def group(runs: Sequence[Outcome]) -> list[Group]:
    """Gather runs that differ in nothing but their seed, in order of appearance; of two with the same seed the later counts."""
    seeds: dict[str, dict[int, Outcome]] = {}
    for run in runs:
        seeds.setdefault(repr(to_plain(run.config)), {})[run.seed] = run
    configs = [next(iter(same.values())).config for same in seeds.values()]
    labels = _labels([to_plain(config) for config in configs])
    ordered = [dict(sorted(same.items())) for same in seeds.values()]  # a bootstrap depends on the order
    return [Group(*entry) for entry in zip(labels, configs, ordered, strict=True)]


def _labels(settings: Sequence[dict[str, Any]]) -> list[str]:
    """Return a name for each setting: the algorithm, and the fields in which settings differ that share it and the place."""
    names = []
    for fields in settings:
        alike = [other for other in settings if all(other[name] == fields[name] for name in ("algorithm", "environment"))]
        differing = [name for name in fields if any(other[name] != fields[name] for other in alike)]
        if len(differing) > 1 and "human_capacity" in differing:
            differing.remove("human_capacity")  # it follows from the others
        names.append(", ".join([text.label(fields["algorithm"]), *(f"{name} {fields[name]}" for name in differing)]))
    return names


def thinned(length: int) -> np.ndarray:
    """Return which points of a curve to keep: i64[K], at most `MAX_POINTS`, evenly spaced, the last one included.

    >>> thinned(3), thinned(1000)[[0, 1, -1]]
    (array([0, 1, 2]), array([  4,   9, 999]))
    """
    number = min(length, MAX_POINTS)
    return length * np.arange(1, number + 1) // number - 1

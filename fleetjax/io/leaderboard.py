"""Rules for help at equal human time: each is calibrated and run, and its rows are stored.

A rule's threshold is calibrated on seed 100, so that a run spends a budget of human timesteps; on three seeds where fleets are
so small that their human time differs much by chance. Then it runs with seeds 0, 1, ... A rule that asks by
`uncertainty_threshold` and by `risk_threshold`, such as C.U.R., has both tuned: the first is calibrated at each of several
values of the second. Of the pairs that spend the budget, we take the one with the most successes on the seeds of the
calibration; if no pair does, the nearest. On the robots, where a run takes minutes, only the first is calibrated. Other
parameters keep their defaults. The human time of a rule without a threshold is not controlled. The robots keep the paper's
initial period; elsewhere no rule has one. Extra demonstrations count as human time.
"""

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetjax.checks import check_run
from fleetjax.config import Config, get_value, make_config
from fleetjax.io import calibration, files, folder, resumable, rows, text
from fleetjax.io.errors import Diverged
from fleetjax.io.outcomes import Group, Outcome, group
from fleetjax.io.plain import to_plain
from fleetjax.io.progress import say
from fleetjax.io.sources import collect
from fleetjax.priority import get_algorithm

BUDGETS = {  # human timesteps
    "navigation": (5000, 10_000, 15_000),
    "block_push": (100, 200, 300),
    "humanoid": (10_000,),
    "anymal": (10_000,),
    "allegro_hand": (10_000,),
}


class Effort(NamedTuple):
    """How carefully a threshold is calibrated.

    Attributes:
        seeds: of its runs; the search takes the first.
        most: runs in which it searches.
        tolerance: relative difference from the budget that is near enough.
        risk_thresholds: that are tried, if the rule asks by risk; the first is the default.
    """

    seeds: tuple[int, ...] = (100,)
    most: int = 8
    tolerance: float = 0.05
    risk_thresholds: tuple[float, ...] = (0.5, 0.8, 0.95)


ROBOTS = ("humanoid", "anymal", "allegro_hand")
EFFORTS = {  # `Effort()` elsewhere
    "block_push": Effort(seeds=(100, 101, 102), most=5, tolerance=0.1),
    **dict.fromkeys(ROBOTS, Effort(most=4, tolerance=0.1, risk_thresholds=(0.5,))),
}


class Entry(NamedTuple):
    """A rule that is to be compared with the others.

    Attributes:
        environment: its name.
        algorithm: its name.
        budget: human timesteps.
        seeds: number of runs at the calibrated value.
        output: folder of all run folders.
    """

    environment: str
    algorithm: str
    budget: int
    seeds: int
    output: Path

    @property
    def config(self) -> Config:
        """The configuration before it is calibrated."""
        return _uncalibrated(self.environment, self.algorithm)

    @property
    def name(self) -> str:
        """What the user is told."""
        return f"{text.label(self.algorithm)} on {self.environment} at {self.budget:,} human timesteps"

    @property
    def folder(self) -> Path:
        """The folder of its run folders."""
        return self.output / self.environment / text.as_path(self.algorithm)

    @property
    def requests(self) -> dict[float | None, calibration.Request]:
        """What is to be calibrated, by risk threshold; None = the rule has a threshold of its own, or does not ask by risk."""
        field, effort = calibration.default_field(self.config), EFFORTS.get(self.environment, Effort())
        fixed = (field, self.budget, effort.seeds, effort.tolerance, effort.most)
        if field != "uncertainty_threshold" or "safety" not in get_algorithm(self.algorithm).estimators:
            return {None: calibration.Request(self.config, *fixed, self.folder)}
        return {
            risk: calibration.Request(
                self.config.replace(risk_threshold=risk), *fixed, self.folder / f"risk_threshold-{risk:g}"
            )
            for risk in effort.risk_thresholds
        }


def _uncalibrated(environment: str, algorithm: str) -> Config:
    early = {} if environment in ROBOTS else {"initial_period": 0}
    return make_config(environment, algorithm, **early)


class Place(NamedTuple):
    """The result of a calibration.

    Attributes:
        environment: its name.
        algorithm: its name.
        budget: human timesteps that were wanted.
        field: the parameter that was searched; "" = the algorithm has none.
        value: with which it spends the budget, or comes nearest.
        spent: human timesteps with it, the mean over the calibration's seeds; None = not recorded.
        solved: whether these are near enough to the budget (`Effort.tolerance`).
        risk_threshold: the rule's other threshold, if it was tuned too.
    """

    environment: str
    algorithm: str
    budget: int
    field: str
    value: float
    spent: float | None
    solved: bool
    risk_threshold: float | None = None

    @property
    def settings(self) -> dict[str, float]:
        """The fields that were tuned, and their values."""
        tuned = {self.field: self.value} if self.field else {}
        return tuned if self.risk_threshold is None else tuned | {"risk_threshold": self.risk_threshold}

    @property
    def config(self) -> Config:
        """The configuration of its runs."""
        return _uncalibrated(self.environment, self.algorithm).replace(**self.settings)


class Store:
    """The stored calibrations and rows.

    Args:
        results: their folder.

    Raises:
        ValueError: if one of the files is damaged.
    """

    def __init__(self, results: Path):
        self.table, self.rows = _files(results)
        self.places = _read_places(self.table)
        self.runs: list[Outcome] = rows.read(self.rows) if self.rows.exists() else []

    def find(self, environment: str, algorithm: str, budget: int) -> Place | None:
        """Return a stored calibration, or None."""
        wanted = (environment, algorithm, budget)
        return next((place for place in self.places if place[:3] == wanted), None)

    def add(self, place: Place, found: Sequence[Outcome] = ()) -> None:
        """Store a calibration in the place of the one that it replaces, and runs that were not stored."""
        known = {other[:3]: other for other in self.places}
        self.places = list((known | {place[:3]: place}).values())
        self.runs += found
        if self.runs:
            files.write(self.rows, rows.write(self.runs))
        _write_places(self.table, self.places)

    def group_of(self, place: Place) -> Group | None:
        """Return the runs at a calibrated value, as one group.

        If they differ in other settings, those with today's defaults count, or else the newest.
        """
        here = [run for run in self.runs if (run.config.environment, run.config.algorithm) == place[:2]]
        same = [
            run
            for run in here
            if all(np.float32(get_value(run.config, name)) == np.float32(value) for name, value in place.settings.items())
        ]
        if not same:
            return None
        groups, wanted = group(same), to_plain(place.config)
        return next((one for one in groups if to_plain(one.config) == wanted), groups[-1])


def _files(results: Path) -> tuple[Path, Path]:
    return results / "leaderboard.json", results / "leaderboard.csv"


def _read_places(table: Path) -> list[Place]:
    try:
        known = json.loads(table.read_text())["calibrations"] if table.exists() else []
        return [Place(**one) for one in known]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{table} cannot be used: {files.one_line(error)}; restore it") from None


def _write_places(table: Path, places: Sequence[Place]) -> None:
    files.write_json(table, {"calibrations": [one._asdict() for one in places]})


def is_stored(results: Path) -> bool:
    """Return whether a folder holds anything of a leaderboard."""
    return any(path.exists() for path in _files(results))


def remove(results: Path, algorithms: Sequence[str]) -> None:
    """Forget all that is stored of these rules; they need not be registered any more.

    Raises:
        ValueError: if nothing is stored of one of them, or one of the files is damaged.
    """
    table, runs = _files(results)
    places = _read_places(table)
    known = dict.fromkeys(place.algorithm for place in places)
    for algorithm in algorithms:
        if algorithm not in known:
            raise ValueError(f"nothing is stored of {algorithm!r}; there is {', '.join(known) or 'no rule'}")
    if runs.exists():
        rows.drop(runs, algorithms)
    _write_places(table, [place for place in places if place.algorithm not in algorithms])


def entries(
    algorithms: Sequence[str], environments: Sequence[str], budgets: Sequence[int], seeds: int, output: Path
) -> list[Entry]:
    """Return what is to be compared: every rule in every environment where it can run, at each budget.

    Args:
        algorithms: names.
        environments: names.
        budgets: human timesteps; empty = each environment's own.
        seeds: runs of each.
        output: folder of all run folders.

    Raises:
        ValueError: if a name is unknown, a number too small, or no rule can run in any of these environments.
    """
    for environment in environments:
        if environment not in BUDGETS:
            raise ValueError(f"environment = {environment!r} has no leaderboard; choose from {', '.join(BUDGETS)}")
    most = min(Effort().seeds)
    if not 1 <= seeds <= most:
        raise ValueError(f"seeds = {seeds} must be from 1 to {most}; the calibrations use seed {most} and those after it")
    found, obstacles = [], []
    for algorithm in algorithms:
        get_algorithm(algorithm)
        for environment in environments:
            obstacle = _obstacle(environment, algorithm)
            if obstacle:
                obstacles.append(f"{environment}: {obstacle}")
                continue
            found += [Entry(environment, algorithm, budget, seeds, output) for budget in budgets or BUDGETS[environment]]
    if not found:
        raise ValueError("; ".join(obstacles))
    for entry in found:
        for request in entry.requests.values():
            calibration.check(request)
    for obstacle in obstacles:
        say(f"left out: {obstacle}")
    return found


def _obstacle(environment: str, algorithm: str) -> str:
    """Return why a rule cannot run in an environment, such as that it needs goals; "" if it can."""
    try:
        check_run(Entry(environment, algorithm, 0, 1, Path()).config)
    except ValueError as error:
        return str(error)
    return ""


def compete(store: Store, asked: Sequence[Entry]) -> list[str]:
    """Calibrate rules and run them, one after the other, but for what is stored. If one fails, the others still run.

    Args:
        store: to which each run is added when it is finished.
        asked: what is to be compared.

    Returns:
        Names of those that failed.

    Raises:
        ValueError: before anything is computed, if what is stored of these environments was run with other settings.
    """
    _check_alike(store, {entry.environment for entry in asked})
    failed = []
    for entry in asked:
        try:
            _compete(store, entry)
        except (ValueError, Diverged) as error:
            say(f"{entry.name} failed: {error}")
            failed.append(entry.name)
    return failed


def _check_alike(store: Store, environments: Collection[str]) -> None:
    """Check that what is stored has the settings that new runs would have; else they could not be compared."""
    for place in store.places:
        found = store.group_of(place) if place.environment in environments else None
        if found is None:
            continue
        difference = folder.first_difference(folder.Run(Path(), place.config, 0), folder.Run(Path(), found.config, 0))
        if difference:
            raise ValueError(
                f"the stored runs of {place.algorithm} on {place.environment} have other settings ({difference}): "
                f"forget them with `fleetjax leaderboard remove {place.algorithm}`, or choose another --results"
            )


def _compete(store: Store, entry: Entry) -> None:
    place = store.find(*entry[:3]) or tune(entry)
    store.add(place)
    name = "-".join(f"{field}-{np.float32(value)!s}" for field, value in place.settings.items()) or "as-it-is"
    config = entry.config.replace(**place.settings)
    known = {folder.name_of(run) for run in store.runs}
    stored = sum(folder.name_of(folder.Run(Path(), config, seed)) in known for seed in range(entry.seeds))
    if stored:
        remedy = f"if the rule has changed, first `fleetjax leaderboard remove {entry.algorithm}`"
        say(f"{entry.name}: {text.plural(stored, 'run')} already stored, and not repeated ({remedy})")
    for seed in range(entry.seeds):
        run = folder.Run(entry.folder / f"{name}-seed{seed}", config, seed)
        if folder.name_of(run) not in known:
            resumable.complete(run, checkpoint_every=0)
            store.add(place, collect(run.folder))


def tune(entry: Entry) -> Place:
    """Return the thresholds at which a rule spends its budget with the most successes, or comes nearest to it."""
    if not calibration.has_effect(next(iter(entry.requests.values()))):
        return Place(*entry[:3], "", 0.0, None, solved=False)
    best, most = None, (False, -np.inf)
    for risk, request in entry.requests.items():
        request.output.mkdir(parents=True, exist_ok=True)
        found = calibration.calibrate(request)
        spent = float(np.mean(found.human_time))
        place = Place(*entry[:3], request.field, found.value, spent, found.solved, risk)
        runs = [collect(request.run(found.value, seed).folder)[0] for seed in request.seeds]
        successes = sum(float(run.metrics.successes.sum()) for run in runs)
        merit = successes if place.solved else -abs(spent - entry.budget)
        if (place.solved, merit) > most:
            best, most = place, (place.solved, merit)
    assert best is not None
    return best

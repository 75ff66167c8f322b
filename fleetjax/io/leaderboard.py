"""Rules for help at equal human time: each is calibrated, run, and compared with the others from stored rows.

A rule's threshold is calibrated on seed 100, so that a run spends a budget of human timesteps. Then it runs with seeds
0, 1, ... The human time of a rule without a threshold is not controlled. No rule has an initial period, and extra
demonstrations count as human time.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fleetjax.checks import check_run
from fleetjax.config import Config, get_value, make_config
from fleetjax.io import calibration, comparing, files, folder, resumable, rows, text
from fleetjax.io.outcomes import Group, Outcome, group
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
FIXED = ("constraint", "constraint_trained", "longest_waiting")  # rules without a threshold
CALIBRATED_ON = 100  # seed of calibrations
MOST = 8  # runs in a calibration
TOLERANCE = 0.05  # relative difference from the budget


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
        return make_config(self.environment, self.algorithm, initial_period=0)

    @property
    def folder(self) -> Path:
        """The folder of its run folders."""
        return self.output / self.environment / self.algorithm

    @property
    def request(self) -> calibration.Request:
        """What is to be calibrated."""
        field = calibration.default_field(self.config)
        return calibration.Request(self.config, field, self.budget, (CALIBRATED_ON,), TOLERANCE, MOST, self.folder)


class Place(NamedTuple):
    """The result of a calibration.

    Attributes:
        environment: its name.
        algorithm: its name.
        budget: human timesteps that were wanted.
        field: the parameter that was searched; "" = the algorithm has none.
        value: that spends nearest to the budget.
        spent: human timesteps with it on the calibration's seed.
        solved: whether these are within 5 % of the budget.
    """

    environment: str
    algorithm: str
    budget: int
    field: str
    value: float
    spent: float
    solved: bool


class Store:
    """The stored calibrations and rows.

    Args:
        results: their folder.
    """

    def __init__(self, results: Path):
        self.table, self.rows = results / "leaderboard.json", results / "leaderboard.csv"
        known = json.loads(self.table.read_text())["calibrations"] if self.table.exists() else []
        self.places = [Place(**one) for one in known]
        self.runs: list[Outcome] = rows.read(self.rows) if self.rows.exists() else []

    def find(self, environment: str, algorithm: str, budget: int) -> Place | None:
        """Return a stored calibration, or None."""
        wanted = (environment, algorithm, budget)
        return next((place for place in self.places if place[:3] == wanted), None)

    def add(self, place: Place, found: Sequence[Outcome] = ()) -> None:
        """Store a calibration, and runs that were not stored."""
        self.places = [*(other for other in self.places if other[:3] != place[:3]), place]
        self.runs += found
        self._write()

    def remove(self, algorithms: Sequence[str]) -> None:
        """Forget all that is stored of these rules."""
        self.places = [place for place in self.places if place.algorithm not in algorithms]
        self.runs = [run for run in self.runs if run.config.algorithm not in algorithms]
        self._write()

    def _write(self) -> None:
        if self.runs:
            files.write(self.rows, rows.write(self.runs))
        files.write_json(self.table, {"calibrations": [one._asdict() for one in self.places]})

    def group_of(self, place: Place) -> Group | None:
        """Return the runs at a calibrated value, as one group."""
        here = [run for run in self.runs if (run.config.environment, run.config.algorithm) == place[:2]]
        same = [
            run for run in here if not place.field or np.float32(get_value(run.config, place.field)) == np.float32(place.value)
        ]
        return group(same)[-1] if same else None  # of different settings, the newest


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
    if seeds < 1:
        raise ValueError(f"seeds = {seeds} must be at least 1")
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
        calibration.check(entry.request)
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


def compete(store: Store, entry: Entry) -> None:
    """Calibrate a rule and run it, but for what is stored; store each run when it is finished."""
    config, place = entry.config, store.find(*entry[:3])
    if entry.algorithm in FIXED:
        place = Place(*entry[:3], "", 0.0, 0.0, solved=False)
    elif place is None:
        request = entry.request
        request.output.mkdir(parents=True, exist_ok=True)
        found = calibration.calibrate(request)
        place = Place(*entry[:3], request.field, found.value, found.human_time[0], bool(found.solved))
    store.add(place)
    name = f"{place.field}-{place.value:.6g}" if place.field else "as-it-is"
    if place.field:
        config = config.replace(**{place.field: place.value})
    known = {folder.name_of(run) for run in store.runs}
    for seed in range(entry.seeds):
        run = folder.Run(entry.folder / f"{name}-seed{seed}", config, seed)
        if folder.name_of(run) not in known:
            resumable.complete(run, checkpoint_every=0)
            store.add(place, collect(run.folder))


def publish(store: Store) -> Path:
    """Write the table and the figure of all that is stored; return the table's path."""
    page = store.rows.with_suffix(".md")
    files.write(page, table(store).encode())
    files.write(page.with_suffix(".png"), draw(store))
    return page


def table(store: Store) -> str:
    """Return the table of every environment and budget, the most successes first."""
    parts = []
    for environment in dict.fromkeys(place.environment for place in store.places):
        for budget in sorted({place.budget for place in store.places if place.environment == environment}):
            here = [place for place in store.places if place.environment == environment and place.budget == budget]
            parts.append(f"## {environment}, {budget:,} human timesteps\n\n{_part(store, here)}")
    return "\n\n".join(parts) + "\n"


def _part(store: Store, places: list[Place]) -> str:
    found = [(place, one) for place in places if (one := store.group_of(place))]
    found.sort(key=lambda pair: -np.mean(_values(pair[1], "successes")))
    reference = next((one for place, one in found if place.algorithm == "cur"), None)
    lines: list[tuple[str, ...]] = [("", "seeds", "successes", "human time", "violations", "ROHE", "successes less C.U.R.'s")]
    for place, one in found:
        successes = _values(one, "successes")
        cells = [
            f"{text.label(place.algorithm)}{'' if place.solved else ' *'}",
            str(len(successes)),
            comparing.interval(successes),
        ]
        cells += [text.number(_human_time(one)), text.number(float(np.mean(_values(one, "violations"))))]
        cells += [f"{np.mean(_values(one, 'rohe_with_demonstrations')):.3g}", _difference(one, reference)]
        lines.append(tuple(cells))
    return text.markdown_table(lines)


def _difference(one: Group, reference: Group | None) -> str:
    """Return how many more successes a rule has than C.U.R., by seeds that both have."""
    if reference is None or one is reference:
        return ""
    mine, others = (comparing.values_by_seed(each, "successes") for each in (one, reference))
    shared = sorted(mine.keys() & others.keys())
    return comparing.interval(np.array([mine[seed] - others[seed] for seed in shared])) if shared else ""


def _human_time(one: Group) -> float:
    """Return the mean human time of a group, extra demonstrations included."""
    return float(np.mean(_values(one, "human_steps"))) + int(one.config.extra_demonstrations)


def _values(one: Group, metric: str) -> np.ndarray:
    return np.array(list(comparing.values_by_seed(one, metric).values()))


def draw(store: Store) -> bytes:
    """Return the figure: successes against human time, a panel for each environment, a line for each algorithm."""
    import matplotlib.pyplot as plt

    from fleetjax.io import figure  # imported on demand

    environments = list(dict.fromkeys(place.environment for place in store.places if store.group_of(place)))
    with figure.style():
        canvas, axes = plt.subplots(1, len(environments), figsize=(6.5 * len(environments), 5), squeeze=False)
        for ax, environment in zip(axes[0], environments, strict=True):
            _panel(ax, store, environment)
        canvas.tight_layout()
        return figure.render(canvas)


def _panel(ax: Any, store: Store, environment: str) -> None:
    """Draw an environment: C.U.R. and Random in colour, the others in grey, each named at its right end."""
    lines = {}
    for algorithm in dict.fromkeys(place.algorithm for place in store.places if place.environment == environment):
        places = sorted(place for place in store.places if place[:2] == (environment, algorithm))
        found = [one for place in places if (one := store.group_of(place))]
        if found:
            points = [
                [measure(one) for one in found] for measure in (_human_time, lambda one: np.mean(_values(one, "successes")))
            ]
            lines[algorithm] = sorted(zip(*points, strict=True))
    heights = sorted((points[-1][1], name) for name, points in lines.items())
    least = 0.035 * max(height for height, _ in heights)
    at = -np.inf
    right = max(points[-1][0] for points in lines.values())
    for height, name in heights:
        at = max(height, at + least)
        colour = {"cur": "#0072B2", "random": "#E69F00"}.get(name, "#999999")
        ax.plot(*zip(*lines[name], strict=True), color=colour, marker="o", markersize=3, linewidth=2 if name == "cur" else 1.2)
        ax.annotate(text.label(name), lines[name][-1], (1.06 * right, at), color=colour, va="center", fontsize=8)
    ax.set(title=environment, xlabel="human timesteps", ylabel="successes", xlim=(0, 1.35 * right))
    ax.set_ylim(bottom=0)

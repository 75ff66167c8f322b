"""Compare rules for help at equal human time: who has the most successes for what people spend?

    python experiments/leaderboard.py [ENV ...] [--algorithms cur,random] [--budgets 2500,5000] [--seeds 5]
    python experiments/leaderboard.py --rows-only          # table and figure from the stored rows; no simulation

For each environment, algorithm and budget, the algorithm's threshold is calibrated on seed 100, so that a run spends the
budget. Then it runs with seeds 0, 1, ... An algorithm without a threshold spends what it spends. No algorithm has an initial
period, and extra demonstrations count as human time. Rows go to `experiments/results/leaderboard.csv`, what was calibrated to
`leaderboard.json`, and the table and the figure beside them.

Repeat the command to resume: runs that are stored, or finished below --output, are not run again.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import paper

from fleetjax import list_algorithms, make_config, statistics
from fleetjax.config import get_value
from fleetjax.io import calibration, comparing, figure, files, folder, resumable, rows, scripts, text
from fleetjax.io.outcomes import Group, Outcome, group
from fleetjax.io.sources import collect

BUDGETS = {  # human timesteps
    "navigation": (2500, 5000, 10_000),
    "block_push": (100, 200, 300),
    "humanoid": (10_000,),
    "anymal": (10_000,),
    "allegro_hand": (10_000,),
}
ORDER = (  # in which they are run
    *("cur", "random", "ensemble_dagger", "round_robin", "lazy_dagger", "oracle_discrepancy", "quantile_ensemble"),
    *("thrifty_quantile", "conformal", "safe_dagger", "crsail", "aim", "dropout_dagger", "asa", "weighted", "whittle", "iifl"),
    *("constraint", "constraint_trained", "longest_waiting", "thrifty_dagger"),
)
FIXED = ("constraint", "constraint_trained", "longest_waiting")  # whose human time no threshold changes
CALIBRATED_ON = 100  # seed
MOST = 8  # runs of a search
TOLERANCE = 0.05


class Place(NamedTuple):
    """What was calibrated.

    Attributes:
        environment: its name.
        algorithm: its name.
        budget: human timesteps that were wanted.
        field: the parameter that was searched; "" = the algorithm has none.
        value: the nearest that was found.
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

    def add(self, place: Place, found: list[Outcome]) -> None:
        """Store a calibration, and runs that were not stored."""
        self.places = [*(other for other in self.places if other[:3] != place[:3]), place]
        self.runs += found
        files.write_json(self.table, {"calibrations": [one._asdict() for one in self.places]})
        if self.runs:
            files.write(self.rows, rows.write(self.runs))

    def group_of(self, place: Place) -> Group | None:
        """Return the runs at a calibrated value, as one group."""
        here = [run for run in self.runs if (run.config.environment, run.config.algorithm) == place[:2]]
        same = [
            run for run in here if not place.field or np.float32(get_value(run.config, place.field)) == np.float32(place.value)
        ]
        return group(same)[0] if same else None


def compete(store: Store, environment: str, algorithm: str, budget: int, args: argparse.Namespace) -> None:
    """Calibrate a rule and run it, as far as that is not stored."""
    config = make_config(environment, algorithm, initial_period=0)
    place, output = store.find(environment, algorithm, budget), args.output / environment / algorithm
    if algorithm in FIXED:
        place = Place(environment, algorithm, budget, "", 0.0, 0.0, solved=False)
    elif place is None:
        field = calibration.default_field(config)
        request = calibration.Request(config, field, budget, (CALIBRATED_ON,), TOLERANCE, MOST, output)
        calibration.check(request)
        output.mkdir(parents=True, exist_ok=True)
        found = calibration.calibrate(request)
        place = Place(environment, algorithm, budget, field, found.value, found.human_time[0], bool(found.solved))
    known, name = {paper.name_of(run) for run in store.runs}, "as-it-is"
    if place.field:
        config, name = config.replace(**{place.field: place.value}), f"{place.field}-{place.value:.6g}"
    done = []
    for seed in range(args.seeds):
        run = folder.Run(output / f"{name}-seed{seed}", config, seed)
        if paper.name_of(run) not in known:
            resumable.complete(run, checkpoint_every=0)
            done += collect(run.folder)
    store.add(place, done)


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
        cells = [f"{text.label(place.algorithm)}{'' if place.solved else ' *'}", str(len(successes)), _interval(successes)]
        cells += [text.count(_human_time(one)), text.count(float(np.mean(_values(one, "violations"))))]
        cells += [f"{np.mean(_values(one, 'rohe_with_demonstrations')):.3g}", _difference(one, reference)]
        lines.append(tuple(cells))
    return text.markdown_table(lines)


def _difference(one: Group, reference: Group | None) -> str:
    """Return how many more successes a rule has than C.U.R., by seeds that both have."""
    if reference is None or one is reference:
        return ""
    mine, others = (comparing.values_by_seed(each, "successes") for each in (one, reference))
    shared = sorted(mine.keys() & others.keys())
    return _interval(np.array([mine[seed] - others[seed] for seed in shared])) if shared else ""


def _human_time(one: Group) -> float:
    """Return the mean human time of a group, extra demonstrations included."""
    return float(np.mean(_values(one, "human_steps"))) + int(one.config.extra_demonstrations)


def _values(one: Group, metric: str) -> np.ndarray:
    return np.array(list(comparing.values_by_seed(one, metric).values()))


def _interval(values: np.ndarray) -> str:
    low, high = statistics.mean_bounds(values)
    return f"{text.count(float(values.mean()))} ({text.count(float(low))} to {text.count(float(high))})"


def draw(store: Store) -> bytes:
    """Return the figure: successes against human time, a panel for each environment, a line for each algorithm."""
    import matplotlib.pyplot as plt

    environments = list(dict.fromkeys(place.environment for place in store.places))
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


def main() -> None:
    """Run what is missing of what is asked for, then show all that is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", tuple(BUDGETS))
    parser.add_argument("--algorithms", type=lambda names: names.split(","), help="names, separated by commas [default: all]")
    parser.add_argument("--budgets", type=lambda numbers: [*map(int, numbers.split(","))], help="human timesteps")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds [default: 5]")
    parser.add_argument("--output", type=Path, default=Path("runs/leaderboard"), help="folder for the run folders")
    parser.add_argument("--results", type=Path, default=paper.HERE / "results", help="folder for rows, table and figure")
    parser.add_argument("--rows-only", action="store_true", help="no runs; only table and figure")
    args = parser.parse_args()
    unknown = set(args.algorithms or ()) - set(list_algorithms())
    if unknown:
        parser.error(f"unknown algorithms: {', '.join(sorted(unknown))}; choose from {', '.join(list_algorithms())}")
    args.results.mkdir(parents=True, exist_ok=True)
    store = Store(args.results)
    for environment in [] if args.rows_only else args.environments:
        for algorithm in args.algorithms or ORDER:
            for budget in args.budgets or BUDGETS[environment]:
                try:
                    compete(store, environment, algorithm, budget, args)
                except ValueError as error:  # a rule that needs goals, where there are none
                    print(f"{environment}, {algorithm}: {error}")
    if store.runs:
        files.write(args.results / "leaderboard.md", table(store).encode())
        files.write(args.results / "leaderboard.png", draw(store))
        print(args.results / "leaderboard.md")


if __name__ == "__main__":
    main()

"""Judge the claims of the paper by the stored rows of the study, and print a table of verdicts.

    python experiments/claims.py [--results experiments/results] [--output FILE.md]

A claim says that some means over seeds are higher than others. Of each pair, the differences are taken seed by seed, and the
95 % intervals of their means (BCa bootstrap) decide: the claim *holds* if all intervals lie above 0, *does not hold* if one
whole interval lies below, and is *undecided* otherwise; it is *incomplete* while pairs that could decide are missing, or share
one seed only. With fewer than five seeds, the range of the differences stands for the interval, in parentheses: such a verdict
is weak. One claim (8.8 times) needs one pair only. The table shows the difference that decides, or the closest one.
"""

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from fleetjax import statistics
from fleetjax.io import files, rows, text
from fleetjax.io.outcomes import Outcome
from fleetjax.io.plain import to_plain

HERE = Path(__file__).parent
ROBOTS = ("humanoid", "anymal", "allegro_hand")
BASELINES = ("constraint", "random", "ensemble_dagger")
NAMES = {
    "humanoid": "Humanoid",
    "anymal": "ANYmal",
    "allegro_hand": "Allegro hand",
    "block_push": "Block pushing",
    "num_humans": "M",
    "min_teleop_time": "t_T",
    "hard_reset_time": "t_R",
    "rise_of_return": "ROHE at the end - in the middle",
    "fall_of_idle": "idle robots: initial period - 10 x later",
    "missing_to_one": "1 - successes",
}

Setting = Mapping[str, Any]  # fields of a configuration, with their values
Measure = Callable[[Outcome], float]


class Claim(NamedTuple):
    """A claim of the paper: of each pair of settings, the first is higher than `factor` times the second.

    Attributes:
        place: environment.
        words: what it says.
        part: of the study.
        measure: what is compared.
        pairs: settings; the second may be None, for 0.
        factor: see above.
        of_any: whether one pair is enough.
    """

    place: str
    words: str
    part: str
    measure: Measure
    pairs: Sequence[tuple[Setting, Setting | None]]
    factor: float = 1.0
    of_any: bool = False


class Difference(NamedTuple):
    """How much higher one group of runs is than another.

    Attributes:
        name: of both.
        mean: over the seeds that both have.
        low: lower bound.
        high: upper bound.
        seeds: number of them.
    """

    name: str
    mean: float
    low: float
    high: float
    seeds: int


def total(metric: str) -> Measure:
    """Return what measures the total of a metric, or the return on human effort at the end."""

    def measure(run: Outcome) -> float:
        found = text.add_up(run.metrics)
        return found[metric] if metric in found else text.rohe_of(found, run.config)

    return measure


def rise_of_return(run: Outcome) -> float:
    """Return how much higher the return on human effort is at the end than in the middle."""
    half = len(run.timesteps) // 2
    middle = text.add_up(jax.tree.map(lambda x: x[:half], run.metrics))
    return total("rohe")(run) - text.rohe_of(middle, run.config)


def fall_of_idle(run: Outcome) -> float:
    """Return the mean number of idle robots in the initial period, less ten times that after it.

    If this is positive, the curve of idle time flattens out: there are at least ten times fewer idle robots.
    """
    within = run.timesteps <= run.config.initial_period
    idle, steps = np.asarray(run.metrics.idle, float), np.diff(run.timesteps, prepend=0)
    return idle[within].sum() / steps[within].sum() - 10 * idle[~within].sum() / steps[~within].sum()


def missing_to_one(run: Outcome) -> float:
    """Return how many successes are missing to the first."""
    return 1 - total("successes")(run)


def at(place: str, algorithm: str = "cur", **fields: Any) -> Setting:
    """Return a setting."""
    return {"environment": place, "algorithm": algorithm, **fields}


def baselines(place: str) -> tuple[str, ...]:
    """Return the algorithms that the paper compares C.U.R. with."""
    return BASELINES if place in ("humanoid", "anymal") else (*BASELINES, "thrifty_dagger")


def above(ours: Setting, others: Sequence[Setting]) -> list[tuple[Setting, Setting]]:
    """Return the pairs of a setting that is higher than the others."""
    return [(ours, other) for other in others]


def below(ours: Setting, others: Sequence[Setting]) -> list[tuple[Setting, Setting]]:
    """Return the pairs of a setting that is lower than the others."""
    return [(other, ours) for other in others]


def falling(settings: Sequence[Setting]) -> list[tuple[Setting, Setting]]:
    """Return the pairs of settings that are lower and lower."""
    return [*itertools.pairwise(settings)]


def of_main() -> list[Claim]:
    """Return the claims of Sections 5.2 and 5.3."""
    claims = []
    for place in (*ROBOTS, "block_push"):
        cur, others = at(place), [at(place, algorithm) for algorithm in baselines(place)]
        fewest = below(cur, others) if place != "allegro_hand" else above(cur, others)
        claims += [
            Claim(place, "C.U.R. has the most successes", "main", total("successes"), above(cur, others)),
            Claim(place, "C.U.R. has the highest return on human effort", "main", total("rohe"), above(cur, others)),
            Claim(
                place,
                f"C.U.R. has the {'most' if fewest[0][0] is cur else 'fewest'} violations",
                "main",
                total("violations"),
                fewest,
            ),
        ]
    trained = [(at(place), at(place, algorithm)) for place in ROBOTS for algorithm in baselines(place)[1:]]
    claims.append(Claim("", "the return of C.U.R. is up to 8.8 times a baseline's", "main", total("rohe"), trained, 8.8, True))
    for place in ROBOTS:
        claims += [
            Claim(place, "the return of C.U.R. rises over time", "main", rise_of_return, [(at(place), None)]),
            Claim(
                place,
                "idle time flattens out after the initial period",
                "main",
                fall_of_idle,
                [(at(place), None)],
            ),
        ]
    failed = [(at("humanoid", "constraint"), None)]
    claims.append(Claim("humanoid", "Constraint does not succeed once", "main", missing_to_one, failed))
    return claims


def of_appendix() -> list[Claim]:
    """Return the claims of the Appendix."""
    claims = []
    for place in ("humanoid", "anymal"):
        cur, others = at(place), [at(place, algorithm) for algorithm in baselines(place)]
        claims += [
            Claim(place, "the policy of C.U.R. has the most successes", "policies", total("successes"), above(cur, others)),
            Claim(place, "the policy of C.U.R. has the fewest violations", "policies", total("violations"), below(cur, others)),
        ]
    ranked = [at("allegro_hand", x) for x in ("random", "cur", "thrifty_dagger", "ensemble_dagger", "constraint")]
    words = "the policies rank Random, C.U.R., Fleet-TD, Fleet-ED, Constraint"
    claims.append(Claim("allegro_hand", words, "policies", total("successes"), falling(ranked)))

    for place, ablations in {"humanoid": ("cur", "cu", "cr", "ur", "c", "u", "r"), "allegro_hand": ("cur", "u")}.items():
        whole = at(place, initial_period=1000 if place == "humanoid" else 2500, idle_humans_teleoperate=False)
        parts = above(whole, [at(place, letters, initial_period=0) for letters in ablations])
        claims += [
            Claim(place, "C.U.R. has more successes than its ablations", "ablations", total("successes"), parts),
            Claim(place, "C.U.R. has a higher return than its ablations", "ablations", total("rohe"), parts),
        ]

    def group(**fields: Any) -> Setting:
        return at("humanoid", **fields)

    few = [group(num_humans=m) for m in (50, 25, 10, 5, 1)]
    teleop = [group(min_teleop_time=t, hard_reset_time=5) for t in (1, 5, 50, 500)]
    reset = [group(hard_reset_time=t, min_teleop_time=5) for t in (1, 5, 50, 500)]
    return [
        *claims,
        Claim("humanoid", "more humans, more successes", "humans", total("successes"), falling(few)),
        Claim("humanoid", "10 humans have the highest return", "humans", total("rohe"), above(few[2], few[:2] + few[3:])),
        Claim("humanoid", "t_T = 5 has the highest return", "times", total("rohe"), above(teleop[1], teleop[:1] + teleop[2:])),
        Claim("humanoid", "t_T = 500 has fewer successes than 5", "times", total("successes"), [(teleop[1], teleop[3])]),
        Claim("humanoid", "t_T = 500 has fewer violations than 5", "times", total("violations"), [(teleop[1], teleop[3])]),
        Claim("humanoid", "t_T = 500 has more idle time than 5", "times", total("idle"), [(teleop[3], teleop[1])]),
        Claim("humanoid", "the longer a hard reset, the lower the return", "times", total("rohe"), falling(reset)),
        Claim("humanoid", "the longer a hard reset, the fewer successes", "times", total("successes"), falling(reset)),
        Claim("humanoid", "the longer a hard reset, the fewer violations", "times", total("violations"), falling(reset)),
        Claim("humanoid", "the longer a hard reset, the more idle time", "times", total("idle"), falling(reset[::-1])),
    ]


class Study:
    """The stored rows.

    Args:
        folder: that holds a file for each part.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._runs: dict[str, list[tuple[dict[str, Any], Outcome]]] = {}

    def values(self, part: str, setting: Setting, measure: Measure) -> dict[int, float]:
        """Return a measure of the runs of a part that have a setting, by seed.

        Raises:
            ValueError: if two have the same seed.
        """
        if part not in self._runs:
            path = self._folder / f"{part}{rows.SUFFIX}"
            self._runs[part] = [(to_plain(run.config), run) for run in rows.read(path)] if path.exists() else []
        found = [run for fields, run in self._runs[part] if setting.items() <= fields.items()]
        files.expect(len({run.seed for run in found}) == len(found), f"{part} has a seed of {dict(setting)} twice")
        return {run.seed: measure(run) for run in found}

    def difference(self, claim: Claim, higher: Setting, lower: Setting | None) -> Difference | None:
        """Return how much higher one group is than another; None if they share fewer than two seeds, which show no spread."""
        ours = self.values(claim.part, higher, claim.measure)
        others = dict.fromkeys(ours, 0.0) if lower is None else self.values(claim.part, lower, claim.measure)
        pairs = np.array([ours[seed] - claim.factor * others[seed] for seed in sorted(ours.keys() & others.keys())])
        if len(pairs) < 2:
            return None
        times = f"{claim.factor} x " if claim.factor != 1 else ""
        name = f"{name_of(higher, lower)} - {times}{name_of(lower, higher)}" if lower else NAMES[claim.measure.__name__]
        low, high = statistics.mean_bounds(pairs)
        return Difference(name, float(pairs.mean()), float(low), float(high), len(pairs))


def name_of(setting: Setting, other: Setting | None) -> str:
    """Return what tells a setting from another."""
    told = [f"{NAMES.get(name, name)} = {x}" for name, x in setting.items() if other and other.get(name) != x and name in NAMES]
    same = other and setting["algorithm"] == other["algorithm"]
    name = text.label(setting["algorithm"])
    own = name if name != text.label("cur") or setting.get("initial_period", 1) else f"{name} without initial period"
    return ", ".join(told) if same and told else own


def judge(study: Study, claim: Claim) -> tuple[str, Difference | None]:
    """Return the verdict of a claim, and the difference that decides it or comes closest."""
    found = [difference for pair in claim.pairs if (difference := study.difference(claim, *pair))]
    if not found:
        return "not run yet", None
    complete = len(found) == len(claim.pairs)
    if claim.of_any:
        best = max(found, key=lambda d: d.low)
        refuted = complete and all(d.high < 0 for d in found)
        return "holds" if best.low > 0 else "does not hold" if refuted else "undecided" if complete else "incomplete", best
    if any(d.high < 0 for d in found):
        return "does not hold", min(found, key=lambda d: d.high)
    worst = min(found, key=lambda d: d.low)
    return "incomplete" if not complete else "holds" if worst.low > 0 else "undecided", worst


def cells(claim: Claim, verdict: str, difference: Difference | None) -> tuple[str, ...]:
    """Return a row of the table."""
    words = f"{NAMES[claim.place]}: {claim.words}" if claim.place else claim.words
    if difference is None:
        return words, verdict, "", "", ""
    bounds = f"{text.number(difference.low)} to {text.number(difference.high)}"
    shown = bounds if difference.seeds >= statistics.MIN_SEEDS else f"({bounds})"
    return words, verdict, difference.name, f"{text.number(difference.mean)}, {shown}", str(difference.seeds)


def verdicts(study: Study) -> str:
    """Return the table of all claims."""
    table = [cells(claim, *judge(study, claim)) for claim in (*of_main(), *of_appendix())]
    return text.markdown_table([("claim", "verdict", "decided by", "difference", "seeds"), *table])


def main() -> None:
    """Print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder of the rows")
    parser.add_argument("--output", type=Path, help="Markdown file [default: print]")
    args = parser.parse_args()
    content = verdicts(Study(args.results)) + "\n"
    if args.output:
        files.write(args.output, content.encode())
    else:
        print(content, end="")


if __name__ == "__main__":
    main()

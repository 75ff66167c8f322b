"""Numbers, names and tables as people read them."""

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fleetjax.config import Config
from fleetjax.metrics import Metrics, rohe
from fleetjax.priority import get_algorithm

# What papers call an algorithm, and what it does.
_KNOWN = {
    "constraint": (
        "Constraint",
        "the policy cloned at the start; humans only reset robots in violation (the paper's BC)",
    ),
    "constraint_trained": (
        "Constraint, trained longer",
        "as constraint, but with as many gradient steps before the start as the others take in total",
    ),
    "random": ("Random", "each robot draws a random score; those at or above random_threshold get help, highest first"),
    "ensemble_dagger": ("Fleet-EnsembleDAgger", "uncertain robots first, then robots in violation"),
    "thrifty_dagger": (
        "Fleet-ThriftyDAgger",
        "robots that are uncertain or unlikely to reach their goal first, then robots in violation",
    ),
    "thrifty_quantile": (
        "ThriftyDAgger",
        "robots whose uncertainty or chance of failure is above its running quantile; humans hand back once they agree",
    ),
    "quantile_ensemble": ("Quantile ensemble", "robots whose uncertainty is above its running quantile"),
    "safe_dagger": ("SafeDAgger", "robots where a classifier expects that a human would act otherwise"),
    "lazy_dagger": ("LazyDAgger", "as safe_dagger; humans hand back only once they agree with the robot"),
    "dropout_dagger": (
        "DropoutDAgger",
        "robots few of whose sampled actions are near the human's, which it sees first",
    ),
    "oracle_discrepancy": ("Oracle", "robots farthest from what the human would do, which it sees: a ceiling, not a rule"),
    "crsail": ("CRSAIL", "robots far from all states in which humans acted"),
    "conformal": ("ConformalDAgger", "robots with a wide conformal interval of the human's action"),
    "aim": ("AIM", "robots that a learnt proxy value says humans would correct"),
    "iifl": ("IIFL", "robots about whose action two energy models disagree"),
    "round_robin": ("Round robin", "one robot after the other"),
    "longest_waiting": ("Longest waiting", "robots in violation, first come, first served"),
    "whittle": ("Whittle", "robots in the states in which help is worth most, by the index of a three-state chain"),
    "asa": ("ASA", "robots in violation, uncertain or at risk that stand for many others like them: submodular allocation"),
    "teach_first": (
        "Teach First",
        "random moving robots until the teaching time is spent, then violations only: fleetjax's own",
    ),
    "expert": ("Expert", "every robot is teleoperated and nothing is learnt: an upper bound on successes"),
    "weighted": (
        "Weighted sum",
        "as cur, but by a weighted sum of violation, uncertainty and risk: whose weights can be differentiated",
    ),
    "cur": ("C.U.R.", "robots in violation first, then by uncertainty, then by risk: the paper's proposal"),
}
ORDERS = "any order of distinct letters from c (violation), u (uncertainty) and r (risk); uc: first uncertainty, then violation"


def is_order(algorithm: str) -> bool:
    """Return whether a name is an order of distinct letters out of C, U and R."""
    return bool(algorithm) and set(algorithm) <= set("cur") and len(set(algorithm)) == len(algorithm)


def label(algorithm: str) -> str:
    """Return the name that papers give an algorithm.

    >>> label("cur"), label("uc"), label("expert"), label("my_rule")
    ('C.U.R.', 'U.C.', 'Expert', 'my_rule')
    """
    if algorithm in _KNOWN:
        return _KNOWN[algorithm][0]
    return "".join(f"{letter.upper()}." for letter in algorithm) if is_order(algorithm) else algorithm


def as_path(name: str) -> str:
    """Return a name as it stands in the name of a file or folder.

    >>> as_path("navigation-my_rules:mine-num_humans=5")
    'navigation-my_rules.mine-num_humans=5'
    """
    return re.sub(r"[^\w.=+-]", "_", name.replace(":", "."))


def meaning(algorithm: str) -> str:
    """Return what an algorithm does, in one line; of one that users registered, the first line of its docstring."""
    if algorithm in _KNOWN:
        return _KNOWN[algorithm][1]
    lines = (get_algorithm(algorithm).make_priority.__doc__ or "").strip().splitlines()
    return lines[0] if lines else ""


def count(number: float) -> str:
    """Return a whole number with its thousands set apart.

    >>> count(18201)
    '18,201'
    """
    return f"{int(number):,}"


def number(value: float) -> str:
    """Return a number with three digits, or all of those before the point.

    >>> number(18201.6), number(7.5), number(-0.6)
    ('18,202', '7.5', '-0.6')
    """
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def plural(number: int, thing: str) -> str:
    """Return a number with the name of what is counted.

    >>> plural(1, "seed"), plural(3, "seed")
    ('1 seed', '3 seeds')
    """
    return f"{count(number)} {thing}{'' if number == 1 else 's'}"


def share(part: float, whole: float) -> str:
    """Return a percentage, or a dash where there is nothing to share.

    >>> share(1, 8), share(0, 0)
    ('12.5 %', '-')
    """
    return f"{100 * part / whole:.1f} %" if whole else "-"


def duration(seconds: float) -> str:
    """Return a time span with the unit that suits it.

    >>> duration(3.21), duration(94), duration(7322)
    ('3.2 s', '1:34 min', '2:02:02 h')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02} h" if hours else f"{minutes}:{rest:02} min"


def table(rows: Iterable[Sequence[str]], *, right: Sequence[int] = ()) -> str:
    """Return rows as aligned columns.

    Args:
        rows: cells; all rows have as many.
        right: columns that are aligned to the right.

    >>> print(table([("idle", "7", "steps"), ("moving", "1,193", "steps")], right=[1]))
    idle        7  steps
    moving  1,193  steps
    """
    rows = [tuple(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def line(row: Sequence[str]) -> str:
        cells = (cell.rjust(w) if i in right else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True)))
        return "  ".join(cells).rstrip()

    return "\n".join(map(line, rows))


def markdown_table(rows: Iterable[Sequence[str]]) -> str:
    """Return rows, the first of which is the head, as a Markdown table; all columns but the first are aligned to the right.

    >>> print(markdown_table([("group", "seeds"), ("C.U.R.", "5")]))
    | group  | seeds |
    |--------|------:|
    | C.U.R. |     5 |
    """
    rows = [tuple(row) for row in rows]
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines = [[row[0].ljust(first), *(cell.rjust(w) for cell, w in zip(row[1:], widths, strict=True))] for row in rows]
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    rule = "|".join(["-" * (first + 2), *("-" * (w + 1) + ":" for w in widths)])
    return "\n".join([head, f"|{rule}|", *body])


def headline(config: Config, seed: int) -> str:
    """Return what is run, in one line."""
    return (
        f"{label(config.algorithm)} on {config.environment}: {plural(config.num_robots, 'robot')}, "
        f"{plural(config.num_humans, 'human')}, {plural(config.num_steps, 'timestep')}, seed {seed}"
    )


def divergence(timestep: int, names: Sequence[str]) -> str:
    """Return what is no longer finite, since when, and what to try.

    >>> divergence(12, ["policy"])
    'the policy has NaN or infinite numbers from t = 12 on; try a smaller learning_rate'
    >>> divergence(12, ["policy", "another estimator"])
    'the policy and another estimator have NaN or infinite numbers from t = 12 on; try a smaller learning_rate'
    """
    what = " and ".join(name if name.startswith("another") else f"the {name}" for name in names)
    have = "has" if len(names) == 1 else "have"
    return f"{what} {have} NaN or infinite numbers from t = {timestep} on; try a smaller learning_rate"


def add_up(metrics: Metrics) -> dict[str, float]:
    """Return the totals of Metrics[T], by name."""
    return {name: np.sum(np.asarray(x), dtype=float).item() for name, x in metrics._asdict().items()}


def rohe_of(total: Mapping[str, float], config: Config) -> float:
    """Return the return on human effort that totals amount to."""
    return float(rohe(Metrics._make(np.array([x], np.float32) for x in total.values()), config)[-1])


def run_table(metrics: Metrics, config: Config) -> str:
    """Return the table that ends a run: the paper's four measures and how human time was spent."""
    total = add_up(metrics)
    steps = len(metrics.successes)
    robot_steps, human_steps = steps * config.num_robots, steps * config.num_humans
    rows = [
        ("successes", count(total["successes"]), ""),
        ("violations", count(total["violations"]), "the paper's hard resets"),
        ("hard resets", count(total["hard_resets"]), "completed by a human"),
        ("idle time", count(total["idle"]), f"robot timesteps, {share(total['idle'], robot_steps)} of all"),
        ("human time", count(total["human_steps"]), f"human timesteps, {share(total['human_steps'], human_steps)} of all"),
        ("teleoperation", count(total["teleop_steps"]), f"human timesteps, {share(total['teleop_steps'], human_steps)} of all"),
        ("switches", count(total["switches"]), "starts and ends of help"),
        ("decided by risk", share(total["risk_choices"], total["choices"]), f"of {count(total['choices'])} choices of a robot"),
        ("ROHE", f"{rohe_of(total, config):.3f}", "return on human effort, per 100 human timesteps"),
    ]
    return table(rows, right=[1])


def evaluation_table(metrics: Metrics, config: Config) -> str:
    """Return the row of the paper's table of trained policies, with its head."""
    total = add_up(metrics)
    head = ("policy", "successes", "violations", "idle time")
    row = (label(config.algorithm), count(total["successes"]), count(total["violations"]), count(total["idle"]))
    return table([head, row], right=[1, 2, 3])

"""How many successes does each rule for help keep when people are imperfect, or links fail?

    python experiments/people.py [navigation humanoid] [--seeds 5] [--workers 2] [--output runs/people]
    python experiments/people.py --rows-only                 # tables and figures from the stored rows; no simulation

The runs of an environment are those of `experiments/studies/people_ENV.toml`. Their rows go to
`experiments/results/people_ENV.csv`, and a table and a figure are written beside them. Repeat the command to resume: runs that
have a row, and finished runs, are not run again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import paper

from fleetjax import statistics
from fleetjax.config import Config, get_value
from fleetjax.field import FIELDS, OF_HUMANS, OF_LINKS
from fleetjax.io import comparing, figure, files, scripts, sweep, text
from fleetjax.io.outcomes import Group, group

ENVIRONMENTS = ("navigation", "humanoid")


class Circumstance(NamedTuple):
    """What is imperfect in a run.

    Attributes:
        name: of a parameter; "" = nothing.
        level: its value, as text.
    """

    name: str
    level: str


PERFECT = Circumstance("", "perfect people")


def circumstance(config: Config) -> Circumstance:
    """Return what is imperfect in a run."""
    changed = {
        name: f"{float(get_value(config, name)):g}"
        for name in (*OF_LINKS, *OF_HUMANS)
        if np.float32(get_value(config, name)) != np.float32(FIELDS[name].default)
    }
    if config.link_model != "perfect":
        changed = {"link_model": config.link_model} | changed
    if not changed:
        return PERFECT
    name = next((name for name in changed if name != "takeover_time"), "takeover_time")
    besides = "".join(f", {other} {value}" for other, value in changed.items() if other != name)
    return Circumstance(name, f"{changed[name]}{besides}")


def table(groups: Sequence[Group]) -> str:
    """Return the successes of each rule in each circumstance, and their share of those with perfect people."""
    rules = list(dict.fromkeys(one.config.algorithm for one in groups))
    places = dict.fromkeys(circumstance(one.config) for one in groups)
    rows: list[tuple[str, ...]] = [("", "level", *map(text.label, rules))]
    for place in places:
        cells = [_cell(groups, rule, place) for rule in rules]
        rows.append((place.name.replace("_", " "), place.level.replace("_", " "), *cells))
    note = (
        "Each cell: mean successes (95 % interval; with fewer than 5 seeds, smallest to largest), the percentage of what the "
        "same rule has with perfect people (over the seeds that both have), and mean human timesteps."
    )
    return f"{text.markdown_table(rows)}\n\n{note}\n"


def _find(groups: Sequence[Group], rule: str, place: Circumstance) -> Group | None:
    """Return the runs of a rule in a circumstance, or None. Older settings stand behind."""
    return next((one for one in groups if one.config.algorithm == rule and circumstance(one.config) == place), None)


def _cell(groups: Sequence[Group], rule: str, place: Circumstance) -> str:
    found, perfect = (_find(groups, rule, where) for where in (place, PERFECT))
    if found is None:
        return ""
    most = max(len(one.runs) for one in groups)
    seeds = f" ({text.plural(len(found.runs), 'seed')})" if len(found.runs) < most else ""
    ratio = comparing.ratio(found, perfect, "successes") if perfect and found is not perfect else None
    share = "" if ratio is None else f", {100 * ratio:.0f} %"
    spent = text.number(float(comparing.values(found, "human_steps").mean()))
    return f"{comparing.interval(comparing.values(found, 'successes'))}{seeds}{share}; {spent}"


def draw(groups: Sequence[Group]) -> bytes:
    """Return the figure: successes by the level of each imperfection, a panel for each, a line for each rule."""
    import matplotlib.pyplot as plt

    rules = list(dict.fromkeys(one.config.algorithm for one in groups))
    places = list(dict.fromkeys(circumstance(one.config) for one in groups))
    names = [name for name in dict.fromkeys(place.name for place in places) if name]
    with figure.style():
        columns = min(4, len(names))
        rows = -(-len(names) // columns)
        canvas, axes = plt.subplots(rows, columns, figsize=(4 * columns, 3.2 * rows), sharey=True, squeeze=False)
        for ax, name in zip(axes.flat, names, strict=False):
            here = [place for place in places if place.name == name]
            _panel(ax, groups, rules, [_without(here[0], places), *here])
            ax.set_title(name.replace("_", " "))
        for ax in axes.flat[len(names) :]:
            ax.set_visible(False)
        axes[0, 0].set_ylabel("successes")
        axes[0, 0].set_ylim(bottom=0)
        axes[0, 0].legend(frameon=False, fontsize=8)
        canvas.tight_layout()
        return figure.render(canvas)


def _without(place: Circumstance, places: Sequence[Circumstance]) -> Circumstance:
    """Return the circumstance that lacks only this imperfection: perfect people, or takeovers as long."""
    _, _, besides = place.level.partition(", takeover_time ")
    same = Circumstance("takeover_time", besides)
    return same if same in places else PERFECT


def _panel(ax: Any, groups: Sequence[Group], rules: Sequence[str], places: Sequence[Circumstance]) -> None:
    """Draw a panel: people without the imperfection at the left, then one level after the other."""
    for rule in rules:
        every = [(i, _find(groups, rule, place)) for i, place in enumerate(places)]
        found = [(i, comparing.values(one, "successes")) for i, one in every if one]
        if not found:
            continue
        middle = np.array([values.mean() for _, values in found])
        low, high = np.array([statistics.mean_bounds(values) for _, values in found]).T
        error = np.stack([middle - low, high - middle])
        ax.errorbar([i for i, _ in found], middle, error, label=text.label(rule), marker="o", markersize=3, capsize=2)
    ticks = [place.level.split(",")[0].replace("_", "\n") for place in places]
    ticks[0] = "none"
    ax.set_xticks(range(len(places)), ticks)


class Part(paper.Part):
    """The runs of an environment, as a part of a study."""

    def show(self) -> None:
        """Write the table and the figure of the stored rows."""
        groups = group(list(self.rows().values()))
        files.write(self.path.with_suffix(".md"), table(groups).encode())
        print(self.path.with_suffix(".md"))
        if any(circumstance(one.config) != PERFECT for one in groups):
            files.write(self.path.with_suffix(".png"), draw(groups))


def main() -> None:
    """Run what is missing, then show what is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", ENVIRONMENTS)
    paper.add_options(parser, output=Path("runs/people"))
    args = parser.parse_args()
    args.results.mkdir(parents=True, exist_ok=True)
    sweep.leave_gpus_to_workers()
    with files.lock(args.results):
        for part in [Part(f"people_{name}", args) for name in args.environments]:
            if not args.rows_only:
                part.run()
            if part.rows():
                part.show()


if __name__ == "__main__":
    main()

"""The leaderboard's table and figure, made from its stored rows."""

from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.io import comparing, files, text
from fleetjax.io.leaderboard import BUDGETS, Place, Store
from fleetjax.io.outcomes import Group
from fleetjax.statistics import mean_bounds

MISSED = 0.1  # relative difference of the mean human time from the budget above which a rule is marked
NOTE = "In parentheses: 95 % intervals (BCa bootstrap over seeds); with fewer than five seeds, the smallest and the largest."
COLOURS = ("#56B4E9", "#0072B2", "#D55E00")  # of budgets, from the smallest


def publish(store: Store) -> Path:
    """Write the table and the figure of all that is stored, or remove them if nothing is; return the table's path."""
    page, picture = store.rows.with_suffix(".md"), store.rows.with_suffix(".png")
    if store.runs:
        if not any(store.group_of(place) for place in store.places):
            raise ValueError(f"{store.rows} has runs, but {store.table} has no calibrations of theirs; restore that file")
        shown, drawn = table(store).encode(), draw(store)
        files.write(page, shown)
        files.write(picture, drawn)
    else:
        page.unlink(missing_ok=True)
        picture.unlink(missing_ok=True)
    return page


def table(store: Store) -> str:
    """Return the table of every environment and budget, the most successes first."""
    parts = []
    known = {place.environment for place in store.places}
    for environment in (name for name in BUDGETS if name in known):
        for budget in sorted({place.budget for place in store.places if place.environment == environment}):
            here = [place for place in store.places if place.environment == environment and place.budget == budget]
            parts.append(f"## {environment}, {budget:,} human timesteps\n\n{_part(store, here)}")
    return "\n\n".join([*parts, NOTE]) + "\n"


def _part(store: Store, places: list[Place]) -> str:
    found = [(place, one) for place in places if (one := store.group_of(place))]
    found.sort(key=lambda pair: -np.mean(comparing.values(pair[1], "successes")))
    reference = next((one for place, one in found if place.algorithm == "cur"), None)
    lines: list[tuple[str, ...]] = [("", "seeds", "successes", "human time", "violations", "ROHE", "successes minus C.U.R.'s")]
    for place, one in found:
        successes = comparing.values(one, "successes")
        cells = [
            f"{text.label(place.algorithm)}{' *' if _missed(place, one) else ''}",
            str(len(successes)),
            comparing.interval(successes),
        ]
        cells += [text.number(_human_time(one)), text.number(float(np.mean(comparing.values(one, "violations"))))]
        cells += [f"{np.mean(comparing.values(one, 'rohe_with_demonstrations')):.3g}", _difference(one, reference)]
        lines.append(tuple(cells))
    return text.markdown_table(lines)


def _difference(one: Group, reference: Group | None) -> str:
    """Return how many more successes a rule has than C.U.R., by seeds that both have."""
    if reference is None or one is reference:
        return ""
    mine, others = (comparing.values_by_seed(each, "successes") for each in (one, reference))
    shared = sorted(mine.keys() & others.keys())
    return comparing.interval(np.array([mine[seed] - others[seed] for seed in shared])) if len(shared) > 1 else ""


def _human_time(one: Group) -> float:
    """Return the mean human time of a group, extra demonstrations included."""
    return float(np.mean(comparing.values(one, "human_steps"))) + int(one.config.extra_demonstrations)


def _missed(place: Place, one: Group) -> bool:
    """Return whether the human time of the runs is not near the budget."""
    return abs(_human_time(one) - place.budget) > MISSED * place.budget


def draw(store: Store) -> bytes:
    """Return the figure: a panel for each environment, a row for each rule, its successes at each budget.

    Environments with few rules stand below the others.
    """
    import matplotlib.pyplot as plt

    from fleetjax.io import figure  # imported on demand

    panels: dict[str, list[tuple[Place, Group]]] = {name: [] for name in BUDGETS}
    for place in store.places:
        if one := store.group_of(place):
            panels[place.environment].append((place, one))
    panels = {name: found for name, found in panels.items() if found}
    rules = {name: len({place.algorithm for place, _ in found}) for name, found in panels.items()}
    few = [name for name in panels if 2 * rules[name] < max(rules.values())]
    lines = [line for line in ([name for name in panels if name not in few], few) if line]
    heights = [1.4 + 0.27 * max(rules[name] for name in line) for line in lines]
    with figure.style():
        canvas = plt.figure(figsize=(5 * max(map(len, lines)), sum(heights)), layout="constrained")
        for part, line in zip(canvas.subfigures(len(lines), 1, squeeze=False, height_ratios=heights)[:, 0], lines, strict=True):
            for ax, name in zip(part.subplots(1, len(line), squeeze=False)[0], line, strict=True):
                _panel(ax, name, panels[name])
        return figure.render(canvas)


def _panel(ax: Any, environment: str, found: list[tuple[Place, Group]]) -> None:
    """Draw an environment: the rule with the most successes at any budget at the top, hollow where it missed the budget."""
    means = {place: float(np.mean(comparing.values(one, "successes"))) for place, one in found}
    rules = sorted({place.algorithm for place in means}, key=lambda rule: max(means[p] for p in means if p.algorithm == rule))
    budgets = sorted({place.budget for place in means})
    for place, one in found:
        level = budgets.index(place.budget)
        low, high = mean_bounds(comparing.values(one, "successes"))
        height = rules.index(place.algorithm) + 0.22 * (level - (len(budgets) - 1) / 2)
        colour = COLOURS[level % len(COLOURS)]
        ax.plot((low, high), (height, height), color=colour, linewidth=1.2)
        ax.plot(
            means[place], height, "o", markersize=4, color=colour, markerfacecolor="white" if _missed(place, one) else colour
        )
    for level, budget in enumerate(budgets):
        ax.plot([], [], "o", markersize=4, color=COLOURS[level % len(COLOURS)], label=f"{budget:,}")
    ax.set_yticks(range(len(rules)), [text.label(rule) for rule in rules])
    if "cur" in rules:
        ax.get_yticklabels()[rules.index("cur")].set_fontweight("bold")
    ax.grid(axis="y", alpha=0.3)
    ax.set(title=environment, xlabel="successes", ylim=(-0.7, len(rules) - 0.3))
    ax.set_xlim(left=0)
    ax.legend(title="human timesteps\n(hollow: missed)", loc="best")

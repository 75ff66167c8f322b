"""The paper's four curves: cumulative successes, violations and idle time, and the return on human effort.

The paper calls violations hard resets.
"""

import contextlib
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from fleetjax import statistics
from fleetjax.config import Config
from fleetjax.io import outcomes, text
from fleetjax.io.sources import Source, collect
from fleetjax.metrics import Metrics, rohe

PANELS = ("Cumulative successes", "Cumulative violations", "Cumulative idle timesteps", "Return on human effort")
_LEGEND_WIDTH = 165  # letters that fit into a row
_RESAMPLES = 1000  # of each band; more would not be seen
FORMATS = (".png", ".pdf", ".svg")
# Okabe and Ito's palette: told apart with every common kind of colour vision. One colour for an algorithm, always.
_COLOURS = {
    "cur": "#0072B2",
    "constraint": "#000000",
    "random": "#E69F00",
    "ensemble_dagger": "#009E73",
    "thrifty_dagger": "#D55E00",
    "expert": "#7F7F7F",
}
_OTHERS = ("#CC79A7", "#56B4E9", "#F0E442", *_COLOURS.values())
_DASHES = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.7,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "legend.frameon": False,
    "legend.fontsize": 10,
    "legend.title_fontsize": 9,
    "svg.fonttype": "none",
}


def style() -> contextlib.AbstractContextManager[None]:
    """Return a context in which Matplotlib draws as fleetjax does."""
    return mpl.rc_context(_STYLE)


class Picture(Figure):
    """A figure that notebooks show."""

    def _repr_png_(self) -> bytes:
        return render(self)


class Curves(NamedTuple):
    """What is drawn as one line.

    Attributes:
        label: its name in the legend.
        algorithm: gives the colour.
        environment: where it was run.
        values: f64[S, 4, K] the panels' curves, for each seed.
        timesteps: i64[K] at which they are known.
    """

    label: str
    algorithm: str
    environment: str
    values: np.ndarray
    timesteps: np.ndarray


def curves_of(metrics: Metrics, config: Config) -> np.ndarray:
    """Return f64[4, T], the curves of one run in the order of `PANELS`."""
    counts = np.array([metrics.successes, metrics.violations, metrics.idle], np.float64)
    return np.vstack([np.cumsum(counts, axis=1), np.asarray(rohe(metrics, config))])


def plot(runs: str | Path | Iterable[Source], title: str = "") -> Figure:
    """Draw runs as the paper does: cumulative successes, violations and idle time, and the return on human effort.

    Runs that differ in nothing but their seed become one line: their mean, in a band of 95 % intervals (BCa bootstrap at each
    timestep), or from the smallest to the largest where there are fewer than five seeds.

    Args:
        runs: as `compare` takes them.
        title: takes the place of the legend.

    Raises:
        ValueError: if there are no runs, or one is damaged.
    """
    return draw(group(runs), title)


def group(runs: str | Path | Iterable[Source]) -> list[Curves]:
    """Return the curves of runs, those that differ in nothing but their seed together, cut at the shortest of them."""
    return [
        Curves(group.label, group.config.algorithm, group.config.environment, *_align(list(group.runs.values())))
        for group in outcomes.group(collect(runs))
    ]


def _align(runs: Sequence[outcomes.Outcome]) -> tuple[np.ndarray, np.ndarray]:
    """Return the curves f64[S, 4, K] of several runs, and the timesteps i64[K] at which all of them are known."""
    timesteps = min((run.timesteps for run in runs), key=len)
    within = np.count_nonzero(timesteps <= min(run.timesteps[-1] for run in runs))
    timesteps = timesteps[: max(1, within)]
    curves = [(run.timesteps, curves_of(run.metrics, run.config)) for run in runs]
    return np.array([[np.interp(timesteps, t, curve) for curve in values] for t, values in curves]), timesteps


def draw(groups: Sequence[Curves], title: str = "") -> Figure:
    """Draw each group in every panel: the mean over its seeds, and a band of `statistics.mean_bounds`.

    Args:
        groups: what to draw; each environment has its own row of panels.
        title: takes the place of the legend.
    """
    with style():
        places = list(dict.fromkeys(curves.environment for curves in groups))
        figure = Picture(figsize=(12.5, 0.5 + 2.6 * len(places)), layout=ConstrainedLayoutEngine(w_pad=0.12))
        axes = figure.subplots(len(places), len(PANELS), squeeze=False)
        labels = _labels(groups)
        legend: dict[str, Line2D] = {}
        styles = _styles(groups)
        for row, place in zip(axes, places, strict=True):
            here = [(curves, style) for curves, style in zip(groups, styles, strict=True) if curves.environment == place]
            for panel, (ax, name) in enumerate(zip(row, PANELS, strict=True)):
                _prepare_axes(ax, name)
                for curves, (colour, dashes) in here:
                    seeds = curves.values[:, panel]
                    t, label = curves.timesteps, labels[curves.label]
                    (line,) = ax.plot(t, seeds.mean(axis=0), color=colour, linestyle=dashes, linewidth=1.8, label=label)
                    legend.setdefault(label, line)
                    if len(seeds) > 1:
                        kept = outcomes.thinned(len(t))
                        low, high = statistics.mean_bounds(seeds[:, kept], _RESAMPLES)
                        ax.fill_between(t[kept], low, high, color=colour, alpha=0.2, linewidth=0)
                ax.set_xlim(0, max(curves.timesteps[-1] for curves, _ in here))
                ax.set_ylim(bottom=0)
                if name != PANELS[0]:
                    _spread(ax, [curves.values[:, panel, -1].mean() for curves, _ in here])
            if len(places) > 1:
                row[0].set_ylabel(place, fontsize=10)
        if title:  # it says what the only line is
            figure.suptitle(title, x=0.008, ha="left", fontsize=11)
        else:
            shown = list(legend)
            columns = max(1, min(len(shown), _LEGEND_WIDTH // (7 + max(map(len, shown)))))
            figure.legend(
                list(legend.values()), shown, loc="outside upper left", ncols=columns, alignment="left", title=_note(groups)
            )
            figure.set_figheight(figure.get_figheight() + 0.24 * -(-len(shown) // columns))
    return figure


def _labels(groups: Sequence[Curves]) -> dict[str, str]:
    """Return each label as the legend shows it: with the number of seeds (fewest to most), if not all have as many."""
    numbers: dict[str, list[int]] = {}
    for curves in groups:
        numbers.setdefault(curves.label, []).append(len(curves.values))
    if len({number for of_label in numbers.values() for number in of_label}) == 1:
        return {label: label for label in numbers}
    fewest = {label: f"{min(of_label)} to " if min(of_label) < max(of_label) else "" for label, of_label in numbers.items()}
    return {label: f"{label} ({fewest[label]}{text.plural(max(of_label), 'seed')})" for label, of_label in numbers.items()}


def _note(groups: Sequence[Curves]) -> str:
    """Return where the fleets ran, and what lines and bands are where there are several seeds."""
    places = ", ".join(dict.fromkeys(curves.environment for curves in groups))
    seeds = {len(curves.values) for curves in groups}
    if max(seeds) == 1:
        return places
    number = f" of {max(seeds)} seeds" if len(seeds) == 1 else ""
    band = "95 % interval" if max(seeds) >= statistics.MIN_SEEDS else "range"
    mixed = band != "range" and any(1 < count < statistics.MIN_SEEDS for count in seeds)
    return f"{places}: mean{number}, band: {band}{f', range below {statistics.MIN_SEEDS} seeds' if mixed else ''}"


def _prepare_axes(ax: Axes, name: str) -> None:
    ax.set_title(name)
    ax.set_xlabel("timesteps")
    counts = FuncFormatter(lambda number, _: f"{number:,.0f}")
    ax.xaxis.set_major_locator(MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10]))
    ax.xaxis.set_major_formatter(counts)
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=name != PANELS[3], steps=[1, 2, 2.5, 5, 10]))
    if name != PANELS[3]:
        ax.yaxis.set_major_formatter(counts)


def _spread(ax: Axes, ends: Sequence[float]) -> None:
    """Give a panel a logarithmic axis where the lower curves would lie on a linear one's bottom; those at 0 do not show."""
    above = [end for end in ends if end > 0]
    if above and 10 * min(above) < max(above):
        ax.set_yscale("log")
        ax.set_ylim(min(above) / 10, 2 * max(above))


def _styles(groups: Sequence[Curves]) -> list[tuple[str, Any]]:
    """Return colour and dashes of each line: an algorithm's own colour, dashes where it comes again with another label.

    An algorithm with more labels than there are dashes gets a colour from dark to light for each.
    """
    names = list(dict.fromkeys(curves.algorithm for curves in groups))
    spare = iter(colour for colour in _OTHERS if colour not in {_COLOURS.get(name) for name in names})
    colours = dict(_COLOURS)
    for i, name in enumerate(names):
        if name not in colours:
            colours[name] = next(spare, _OTHERS[i % len(_OTHERS)])
    labels = {name: list(dict.fromkeys(c.label for c in groups if c.algorithm == name)) for name in names}

    def style_of(curves: Curves) -> tuple[str, Any]:
        own = labels[curves.algorithm]
        place = own.index(curves.label)
        many = len(own) > len(_DASHES)
        shade = to_hex(mpl.colormaps["viridis"](0.92 * place / max(len(own) - 1, 1)))
        return shade if many else colours[curves.algorithm], _DASHES[place % len(_DASHES)]

    return [style_of(curves) for curves in groups]


def render(figure: Figure, suffix: str = ".png") -> bytes:
    """Return a figure as the content of a file of this kind."""
    data = io.BytesIO()
    with style():
        figure.savefig(data, format=suffix.removeprefix("."), dpi=160)
    return data.getvalue()

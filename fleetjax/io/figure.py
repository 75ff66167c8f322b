"""The paper's four curves: cumulative successes, violations and idle time, and the return on human effort.

The paper calls violations hard resets.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from fleetjax.config import Config
from fleetjax.io import text
from fleetjax.io.plain import to_plain
from fleetjax.metrics import Metrics, rohe

PANELS = ("Cumulative successes", "Cumulative violations", "Cumulative idle timesteps", "Return on human effort")
_LEGEND_WIDTH = 165  # letters that fit into a row
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


class Curves(NamedTuple):
    """What is drawn as one line.

    Attributes:
        label: its name in the legend.
        algorithm: gives the colour.
        environment: where it was run.
        values: f64[S, 4, T] the panels' curves, for each seed.
    """

    label: str
    algorithm: str
    environment: str
    values: np.ndarray


def curves_of(metrics: Metrics, config: Config) -> np.ndarray:
    """Return f64[4, T], the curves of one run in the order of `PANELS`."""
    counts = np.array([metrics.successes, metrics.violations, metrics.idle], np.float64)
    return np.vstack([np.cumsum(counts, axis=1), np.asarray(rohe(metrics, config))])


def group(runs: Sequence[tuple[Config, int, Metrics]]) -> list[Curves]:
    """Gather runs that differ in nothing but their seed. Labels tell what else differs.

    Args:
        runs: configuration, seed and Metrics[T] of each; a seed that comes twice counts once, the later run.

    Returns:
        Curves for each setting, in order of appearance, cut at the shortest of its runs.
    """
    groups: dict[str, dict[int, Metrics]] = {}
    configs: dict[str, Config] = {}
    for config, seed, metrics in runs:
        key = repr(to_plain(config))
        configs[key] = config
        groups.setdefault(key, {})[seed] = metrics
    labels = _labels([to_plain(config) for config in configs.values()])
    result = []
    for (key, seeds), name in zip(groups.items(), labels, strict=True):
        length = min(len(metrics.successes) for metrics in seeds.values())
        values = np.stack([curves_of(metrics, configs[key])[:, :length] for metrics in seeds.values()])
        result.append(Curves(name, configs[key].algorithm, configs[key].environment, values))
    return result


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


def draw(groups: Sequence[Curves], title: str = "") -> Figure:
    """Draw each group in every panel: the mean over its seeds, and a band of one standard deviation.

    Args:
        groups: what to draw; each environment has its own row of panels.
        title: takes the place of the legend.
    """
    with mpl.rc_context(_STYLE):
        places = list(dict.fromkeys(curves.environment for curves in groups))
        figure = Figure(figsize=(12.5, 0.5 + 2.6 * len(places)), layout=ConstrainedLayoutEngine(w_pad=0.12))
        axes = figure.subplots(len(places), len(PANELS), squeeze=False)
        numbers = {len(curves.values) for curves in groups}
        legend: dict[str, Line2D] = {}
        styles = _styles(groups)
        for row, place in zip(axes, places, strict=True):
            here = [(curves, style) for curves, style in zip(groups, styles, strict=True) if curves.environment == place]
            for panel, (ax, name) in enumerate(zip(row, PANELS, strict=True)):
                _prepare_axes(ax, name)
                for curves, (colour, dashes) in here:
                    seeds = curves.values[:, panel]
                    label = f"{curves.label} ({text.plural(len(seeds), 'seed')})" if len(numbers) > 1 else curves.label
                    t, mean = np.arange(1, seeds.shape[1] + 1), seeds.mean(axis=0)
                    (line,) = ax.plot(t, mean, color=colour, linestyle=dashes, linewidth=1.8, label=label)
                    legend.setdefault(label, line)
                    if len(seeds) > 1:
                        deviation = seeds.std(axis=0, ddof=1)
                        ax.fill_between(t, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0)
                ax.set_xlim(0, max(curves.values.shape[2] for curves, _ in here))
                ax.set_ylim(bottom=0)
            _spread_returns(row[-1], [curves.values[:, -1, -1].mean() for curves, _ in here])
            if len(places) > 1:
                row[0].set_ylabel(place, fontsize=10)
        if title:  # it says what the only line is
            figure.suptitle(title, x=0.008, ha="left", fontsize=11)
        else:
            labels = list(legend)
            columns = max(1, min(len(labels), _LEGEND_WIDTH // (7 + max(map(len, labels)))))
            figure.legend(
                list(legend.values()), labels, loc="outside upper left", ncols=columns, alignment="left", title=_note(groups)
            )
            figure.set_figheight(figure.get_figheight() + 0.24 * -(-len(labels) // columns))
    return figure


def _note(groups: Sequence[Curves]) -> str:
    """Return where the fleets ran, and what lines and bands are where there are several seeds."""
    places = ", ".join(dict.fromkeys(curves.environment for curves in groups))
    seeds = {len(curves.values) for curves in groups}
    number = f" of {max(seeds)} seeds" if len(seeds) == 1 else ""
    return f"{places}: mean{number}, band of one standard deviation" if max(seeds) > 1 else places


def _prepare_axes(ax: Axes, name: str) -> None:
    ax.set_title(name)
    ax.set_xlabel("timesteps")
    counts = FuncFormatter(lambda number, _: f"{number:,.0f}")
    ax.xaxis.set_major_locator(MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10]))
    ax.xaxis.set_major_formatter(counts)
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=name != PANELS[3], steps=[1, 2, 2.5, 5, 10]))
    if name != PANELS[3]:
        ax.yaxis.set_major_formatter(counts)


def _spread_returns(ax: Axes, ends: Sequence[float]) -> None:
    """Give the returns a logarithmic axis where the lower ones would lie on a linear one's bottom."""
    if 0 < 10 * min(ends) < max(ends):
        ax.set_yscale("log")
        ax.set_ylim(min(ends) / 10, 2 * max(ends))


def _styles(groups: Sequence[Curves]) -> list[tuple[str, Any]]:
    """Return colour and dashes of each line: an algorithm's own colour, dashes where it comes again with another label."""
    names = list(dict.fromkeys(curves.algorithm for curves in groups))
    spare = iter(colour for colour in _OTHERS if colour not in {_COLOURS.get(name) for name in names})
    colours = dict(_COLOURS)
    for i, name in enumerate(names):
        if name not in colours:
            colours[name] = next(spare, _OTHERS[i % len(_OTHERS)])
    labels = {name: list(dict.fromkeys(c.label for c in groups if c.algorithm == name)) for name in names}
    return [(colours[c.algorithm], _DASHES[labels[c.algorithm].index(c.label) % len(_DASHES)]) for c in groups]


def render(figure: Figure, suffix: str = ".png") -> bytes:
    """Return a figure as the content of a file of this kind."""
    data = io.BytesIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(data, format=suffix.removeprefix("."), dpi=160)
    return data.getvalue()


def check_format(path: Path) -> None:
    """Check that a figure can be written to a file of this name.

    Raises:
        ValueError: if its ending is none that is known.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"--output {path} must end in one of {', '.join(FORMATS)}")

"""What people see: curves, tables and progress."""

import io
import sys

import numpy as np
import pytest
from commands import make_metrics

import fleetjax
from fleetjax import statistics
from fleetjax.io import figure, text
from fleetjax.io.progress import progress
from fleetjax.metrics import Metrics

STEPS = 40


@pytest.fixture
def config():
    return fleetjax.make_config("navigation", num_steps=STEPS, hidden_sizes=(8,), uncertainty_threshold=0.07)


def test_curves_are_the_papers(config):
    metrics = make_metrics()
    curves = figure.curves_of(metrics, config)
    np.testing.assert_array_equal(curves[0], np.cumsum(metrics.successes))
    np.testing.assert_array_equal(curves[1], np.cumsum(metrics.violations))
    np.testing.assert_array_equal(curves[2], np.cumsum(metrics.idle))
    human_time = np.cumsum(metrics.human_steps)
    expected = 10 / 100 * np.cumsum(metrics.successes) / (1 + human_time / 100)
    np.testing.assert_allclose(curves[3], expected, rtol=1e-6)
    assert text.rohe_of(text.add_up(metrics), config) == pytest.approx(expected[-1], rel=1e-6)


def test_seeds_become_one_line_and_settings_another(config):
    other = config.replace(num_humans=5)
    runs = [(config, 0, make_metrics(0)), (other, 0, make_metrics(1)), (config, 1, make_metrics(2, steps=30))]
    runs += [(config, 0, make_metrics(3)), (fleetjax.make_config("navigation", "uc"), 0, make_metrics(4))]
    groups = figure.group(runs)
    assert [curves.label for curves in groups] == ["C.U.R., num_humans 10", "C.U.R., num_humans 5", "U.C."]
    assert groups[0].values.shape == (2, 4, 30)  # the shortest seed's timesteps; a seed that comes twice counts once
    np.testing.assert_array_equal(groups[0].values[0, 0], np.cumsum(make_metrics(3).successes)[:30])


def test_labels_tell_settings_apart_and_rows_tell_environments_apart(config):
    humanoid = fleetjax.make_config("humanoid")
    runs = [(c, 0, make_metrics()) for c in (config, humanoid, humanoid.replace(risk_threshold=0.25))]
    groups = figure.group(runs)
    names = ["C.U.R.", "C.U.R., risk_threshold 0.5", "C.U.R., risk_threshold 0.25"]
    assert [curves.label for curves in groups] == names
    drawn = figure.draw(groups)
    rows = np.array(drawn.axes).reshape(2, 4)
    assert [row[0].get_ylabel() for row in rows] == ["navigation", "humanoid"]
    assert [[line.get_label() for line in ax.lines] for ax in rows[:, 2]] == [names[:1], names[1:]]
    assert [entry.get_text() for entry in drawn.legends[0].get_texts()] == names


@pytest.mark.parametrize(("seeds", "kind"), [(3, "range"), (6, "95 % interval")])
def test_lines_are_means_in_a_band(config, seeds, kind):
    drawn = figure.plot([(config, seed, make_metrics(seed)) for seed in range(seeds)])
    successes = np.array([np.cumsum(make_metrics(seed).successes) for seed in range(seeds)])
    mean, (low, high) = successes.mean(axis=0), statistics.mean_bounds(successes, 1000)
    np.testing.assert_allclose(drawn.axes[0].lines[0].get_ydata(), mean)
    assert np.all(low <= mean)
    band = drawn.axes[0].collections[0].get_paths()[0].vertices
    for t in (1, 20, STEPS):
        np.testing.assert_allclose(np.unique(band[band[:, 0] == t, 1])[[0, -1]], [low[t - 1], high[t - 1]])
    assert (low[-1] == successes[:, -1].min()) == (kind == "range")
    assert [ax.get_title(loc="left") for ax in drawn.axes] == list(figure.PANELS)
    assert drawn.legends[0].get_title().get_text() == f"navigation: mean of {seeds} seeds, band: {kind}"


def test_the_legend_tells_what_each_band_is(config):
    rule = fleetjax.make_config("navigation", "uc")
    runs = [(config, seed, make_metrics(seed)) for seed in range(5)] + [(rule, seed, make_metrics(seed)) for seed in range(2)]
    legend = figure.plot(runs).legends[0]
    assert legend.get_title().get_text() == "navigation: mean, band: 95 % interval, range below 5 seeds"
    assert [entry.get_text() for entry in legend.get_texts()] == ["C.U.R. (5 seeds)", "U.C. (2 seeds)"]


def test_the_legend_names_a_label_once_whatever_its_numbers_of_seeds(config):
    elsewhere = fleetjax.make_config("block_push", "cur")
    runs = [(config, seed, make_metrics(seed)) for seed in range(3)] + [(elsewhere, 0, make_metrics())]
    legend = figure.plot(runs).legends[0]
    assert [entry.get_text() for entry in legend.get_texts()] == ["C.U.R. (1 to 3 seeds)"]


def test_counts_of_different_size_are_told_apart_even_beside_zero(config):
    few, many = make_metrics(0), make_metrics(0)._replace(violations=20 * make_metrics(0).violations)
    none = make_metrics(0)._replace(violations=0 * make_metrics(0).violations, successes=0 * make_metrics(0).successes)
    rules = [config, *(fleetjax.make_config("navigation", name) for name in ("uc", "c"))]
    axes = figure.draw(figure.group([(rule, 0, metrics) for rule, metrics in zip(rules, (few, many, none), strict=True)])).axes
    assert [ax.get_yscale() for ax in axes] == ["linear", "log", "linear", "linear"]
    assert 0 < axes[1].get_ylim()[0] < few.violations.sum()


def test_returns_of_different_size_are_told_apart(config):
    few, many = make_metrics(0), make_metrics(0)._replace(successes=20 * make_metrics(0).successes)
    returns = [figure.curves_of(metrics, config)[3, -1] for metrics in (few, many)]
    rule = fleetjax.make_config("navigation", "uc")
    apart = figure.draw(figure.group([(config, 0, few), (rule, 0, many)])).axes
    assert [ax.get_yscale() for ax in apart] == ["linear"] * 3 + ["log"]
    low, high = apart[3].get_ylim()
    assert 0 < low < returns[0]
    assert high > returns[1] > 10 * returns[0]
    alike = figure.draw(figure.group([(config, 0, few), (rule, 0, few)])).axes
    assert alike[3].get_yscale() == "linear"


def test_every_line_of_a_figure_can_be_told_apart(config):
    names = ["cur", "constraint", "random", "ensemble_dagger", "thrifty_dagger", "uc", "c", "u", "r"]
    runs = [(fleetjax.make_config("navigation", name), 0, make_metrics()) for name in names]
    runs += [(config.replace(num_humans=m), 0, make_metrics()) for m in (2, 3, 4)]
    lines = figure.draw(figure.group(runs)).axes[0].lines
    assert len({(line.get_color(), str(line._dash_pattern)) for line in lines}) == len(runs)


@pytest.mark.parametrize("suffix", figure.FORMATS)
def test_figures_come_in_every_format(config, suffix):
    data = figure.render(figure.draw(figure.group([(config, 0, make_metrics())]), "one run"), suffix)
    assert data[:8].startswith({".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}[suffix])


def halves(metrics):
    return [Metrics(*(x[part] for x in metrics)) for part in (slice(0, 20), slice(20, 40))]


def test_progress_without_a_terminal_is_a_few_lines(config, capsys):
    metrics = make_metrics()
    with progress(config) as show:
        for t in range(STEPS):
            show(Metrics(*(x[t : t + 1] for x in metrics)))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[4].startswith(" 50% ")
    assert f"{metrics.successes[:20].sum()} successes, {metrics.violations[:20].sum()} violations" in lines[4]
    assert f"{metrics.human_steps[19]} humans busy, {metrics.idle[19]} idle" in lines[4]
    assert f"ROHE {text.rohe_of(text.add_up(metrics), config):.3f}" in lines[-1]
    assert "steps/s" in lines[-1]
    assert "left" in lines[-1]


def test_progress_in_a_terminal_is_redrawn_in_place(config, monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    monkeypatch.setattr("fleetjax.io.progress._is_screen", lambda: True)
    with progress(config, with_rohe=False) as show:
        for chunk in halves(make_metrics()):
            show(chunk)
    shown = sys.stderr.getvalue()
    assert "100%" in shown
    assert f"{make_metrics().successes.sum()} successes" in shown
    assert "steps/s" in shown
    assert "ROHE" not in shown
    assert shown.count("\r") >= 4


def test_tables_tell_the_totals(config):
    metrics = make_metrics()
    shown = text.run_table(metrics, config)
    for name in ("successes", "violations", "hard_resets", "idle", "human_steps", "teleop_steps", "switches"):
        assert f" {getattr(metrics, name).sum()} " in shown
    assert text.share(metrics.risk_choices.sum(), metrics.choices.sum()) in shown
    assert str(metrics.idle.sum()) in text.evaluation_table(metrics, config).splitlines()[1]


def test_every_algorithm_has_a_name_and_a_meaning():
    for name in fleetjax.list_algorithms():
        assert text.label(name)
        assert text.is_order(name) or text.meaning(name)
    assert text.label("ruc") == "R.U.C."
    assert not text.is_order("cc")
    assert not text.is_order("")

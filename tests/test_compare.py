"""Statistics over seeds: each against its definition, whatever runs are read from; and the tables, figures and rows of them."""

import csv
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import make_metrics, refused, write_run
from scipy import stats

import fleetjax
from fleetjax import cli, envs, statistics
from fleetjax.io import comparing, figure, folder, outcomes, plain, rows, sources

STEPS = 300  # more than a thinned curve has points


def config_of(algorithm="cur", **changes):
    return fleetjax.make_config("navigation", algorithm, **{"num_steps": STEPS} | changes)


def metrics_of(value, *, field="successes", steps=STEPS, seed=0):
    """Return metrics whose total of a field is a given number."""
    counts = np.zeros(steps, np.int32)
    counts[-1] = value
    return make_metrics(seed, steps)._replace(**{field: counts})


def runs_of(algorithm, totals, **changes):
    """Return a run for each seed, with a given number of successes."""
    return [(config_of(algorithm, **changes), seed, metrics_of(total, seed=seed)) for seed, total in totals.items()]


def rows_of(comparison, **wanted):
    """Return the rows of a comparison in which columns have given values, as dictionaries."""
    table = pd.DataFrame(comparison._asdict())
    for column, value in wanted.items():
        table = table[table[column] == value]
    return table.to_dict("records")


@pytest.fixture
def study(tmp_path):
    """Run folders of two algorithms, five seeds each, in one folder."""
    for i, (algorithm, seed) in enumerate(itertools.product(("cur", "random"), range(5))):
        write_run(tmp_path / "study" / f"{algorithm}-{seed}", config_of(algorithm), seed, make_metrics(i, STEPS))
    return tmp_path / "study"


def direct(samples, statistic, **others):
    """Return scipy's interval."""
    options = others | {"n_resamples": 9999, "method": "BCa", "confidence_level": 0.95, "rng": np.random.default_rng(0)}
    return stats.bootstrap(samples, statistic, **options).confidence_interval


def test_intervals_are_bca_bootstraps():
    values = np.random.default_rng(1).gamma(2.0, 100.0, (7, 3))
    low, high = statistics.mean_bounds(values)
    for i in range(3):
        np.testing.assert_allclose((low[i], high[i]), direct((values[:, i],), np.mean))
    others = values[:6, 0] ** 1.1
    np.testing.assert_allclose(
        statistics.difference_bounds(values[:, 1], others),
        direct((values[:, 1], others), lambda x, y, axis: np.mean(x, axis) - np.mean(y, axis)),
    )
    np.testing.assert_allclose(
        statistics.ratio_bounds(values[:, 1], values[:, 2]),
        direct((values[:, 1], values[:, 2]), lambda x, y, axis: np.mean(x, axis) / np.mean(y, axis), paired=True),
    )


def test_intervals_of_what_does_not_vary_are_points():
    values = np.stack([np.full(5, 3.0), np.arange(5.0)], axis=1)
    low, high = statistics.mean_bounds(values)
    assert (low[0], high[0]) == (3, 3)
    assert low[1] < 2 < high[1]
    np.testing.assert_array_equal(statistics.difference_bounds(values[:, 0], values[:, 0]), (0, 0))
    np.testing.assert_array_equal(statistics.ratio_bounds(2 * values[:, 0], values[:, 0]), (2, 2))
    assert statistics.ratio_bounds(3 * values[1:, 1], values[1:, 1]) == (3, 3)


def test_few_seeds_have_a_range():
    few, more = np.array([4.0, 1.0, 2.0, 9.0]), np.arange(6.0)
    assert statistics.mean_bounds(few) == (1, 9)
    assert statistics.difference_bounds(few, more) == (1 - 5, 9 - 0)
    assert statistics.ratio_bounds(few, np.array([2.0, 2.0, 1.0, 3.0])) == (0.5, 3)


def test_ratios_are_of_the_seeds_that_both_groups_have():
    totals = ({0: 4, 1: 9, 2: 70}, {1: 3, 0: 2, 5: 100})
    one, other = (outcomes.group(sources.collect(runs_of("cur", total)))[0] for total in totals)
    assert comparing.ratio(one, other, "successes") == pytest.approx(13 / 5)
    assert comparing.ratio_interval(one, other, "successes") == "2.60 (2.00 to 3.00)"
    nothing = outcomes.group(sources.collect(runs_of("cur", {0: 0, 1: 0})))[0]
    assert comparing.ratio(one, nothing, "successes") is None
    assert comparing.ratio_interval(one, nothing, "successes") == ""


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    values = np.array([1000.0, 3.0, 5.0, 4.0, 6.0, -70.0, 8.0, 2.0])
    assert statistics.interquartile_mean(values) == np.mean([3, 4, 5, 6]) == stats.trim_mean(values, 0.25)


@pytest.mark.parametrize("seed", range(4))
def test_the_probability_counts_every_pair_of_runs(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 5, 6).astype(float), rng.integers(1, 6, 9).astype(float)
    wins = [(a > b) + 0.5 * (a == b) for a in x for b in y]
    probability, p_value = statistics.probability_higher(x, y)
    assert probability == pytest.approx(np.mean(wins))
    assert p_value == stats.mannwhitneyu(x, y).pvalue
    assert statistics.probability_higher(y, x)[0] == pytest.approx(1 - probability)
    assert statistics.probability_higher(x, x[::-1]) == (0.5, 1)


def test_every_column_follows_its_definition():
    totals = {"cur": [50, 90, 40, 70, 60, 80], "random": [30, 10, 20, 50, 40, 70]}
    runs = [run for name, values in totals.items() for run in runs_of(name, dict(enumerate(values)))]
    comparison = fleetjax.compare(runs, against="random", metrics="successes")
    cur, random = rows_of(comparison)
    assert [cur[name] for name in ("environment", "metric", "group", "seeds")] == ["navigation", "successes", "C.U.R.", 6]
    assert (cur["mean"], cur["interquartile_mean"]) == (65, 65)
    x, y = (np.array(values, float) for values in totals.values())
    assert (cur["low"], cur["high"]) == pytest.approx(direct((x,), np.mean))
    assert cur["human_time"] == np.mean([np.sum(make_metrics(seed, STEPS).human_steps) for seed in range(6)])
    assert (cur["against"], cur["pairs"], cur["difference"]) == ("Random", 6, np.mean(x - y))
    assert (cur["difference_low"], cur["difference_high"]) == pytest.approx(direct((x - y,), np.mean))
    assert cur["probability_higher"] == np.mean([(a > b) + 0.5 * (a == b) for a in x for b in y])
    assert cur["p_value"] == stats.mannwhitneyu(x, y).pvalue
    assert (cur["bounds"], cur["difference_bounds"]) == ("interval", "interval")
    assert (random["against"], random["pairs"]) == ("", 0)
    assert np.isnan([random["difference"], random["probability_higher"], random["p_value"]]).all()


def test_runs_are_paired_by_seed():
    """A group that gains 10 with every seed gains 10 for certain, however much seeds differ."""
    base = {3: 100, 0: 700, 2: 400, 1: 900, 4: 300}
    gained = {seed: total + 10 for seed, total in sorted(base.items())}
    row = rows_of(fleetjax.compare(runs_of("cur", gained) + runs_of("random", base), "random", "successes"))[0]
    assert [row[name] for name in ("pairs", "difference", "difference_low", "difference_high")] == [5, 10, 10, 10]


@pytest.mark.parametrize(
    ("totals", "expected"),
    [
        ({1: 5, 2: 8, 7: 90}, (2, 5.5, 4, 7, "range")),  # seeds 1 and 2 are shared
        ({2: 8, 7: 90}, (0, 49 - 2, 8 - 4, 90 - 0, "range")),  # one shared seed makes no pairs
        ({7: 4, 8: 5, 9: 9, 10: 8, 11: 9}, (0, 5, None, None, "interval")),
    ],
)
def test_only_shared_seeds_are_paired(totals, expected):
    others = {0: 3, 1: 1, 2: 1, 3: 2, 4: 4, 5: 1} if len(totals) == 5 else {0: 0, 1: 1, 2: 1, 3: 4, 4: 4}
    row = rows_of(fleetjax.compare(runs_of("cur", totals) + runs_of("random", others), "random", "successes"))[0]
    pairs, difference, low, high, kind = expected
    assert (row["pairs"], row["difference"], row["difference_bounds"]) == (pairs, difference, kind)
    if low is None:
        samples = tuple(np.array(list(values.values()), float) for values in (totals, others))
        low, high = direct(samples, lambda x, y, axis: np.mean(x, axis) - np.mean(y, axis))
    assert (row["difference_low"], row["difference_high"]) == pytest.approx((low, high))


def test_every_metric_can_be_compared():
    config = config_of("constraint")
    assert int(config.extra_demonstrations) > 0
    metrics = make_metrics(0, STEPS)
    extra = metrics.human_steps.copy()
    extra[0] += int(config.extra_demonstrations)
    expected = {name: np.sum(x, dtype=float) for name, x in metrics._asdict().items()}
    expected |= {
        "rohe": fleetjax.rohe(metrics, config)[-1],
        "rohe_with_demonstrations": fleetjax.rohe(metrics._replace(human_steps=extra), config)[-1],
    }
    comparison = fleetjax.compare([(config, 0, metrics)], metrics=list(expected))
    assert comparison.metric.tolist() == list(expected)
    np.testing.assert_allclose(comparison.mean, [float(x) for x in expected.values()], rtol=1e-6)
    assert set(fleetjax.compare([(config, 0, metrics)]).metric) == {"successes", "violations", "idle", "rohe"}


def test_the_order_of_runs_changes_nothing(study):
    paths = sorted(study.iterdir())
    first = fleetjax.compare(paths, against="C.U.R.")
    again = fleetjax.compare([*paths[4::-1], *paths[:4:-1]], against="cur")
    assert first.csv() == again.csv()
    assert first.markdown() == again.markdown()


def test_runs_may_come_from_anywhere(study, tmp_path):
    runs = [(config_of("cur"), seed, make_metrics(seed, STEPS)) for seed in range(5)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *(metrics for _, _, metrics in runs))
    (tmp_path / "rows.csv").write_bytes(rows.write(sources.collect(runs)))
    folders = sorted(study.glob("cur-*"))
    expected = fleetjax.compare(runs).csv()
    for others in (
        [(config, seed, fleetjax.Result(metrics, None)) for config, seed, metrics in runs],  # pyright: ignore[reportArgumentType]
        [(config_of("cur"), range(5), stacked)],
        folders,
        map(str, folders),
        [*folders[:2], *runs[2:]],
        tmp_path / "rows.csv",
    ):
        assert fleetjax.compare(others).csv() == expected
    assert set(expected.splitlines()) < set(fleetjax.compare(study).csv().splitlines())


def test_results_on_a_device_can_be_compared_and_drawn():
    stacked = jax.tree.map(lambda *x: jnp.stack(x), make_metrics(0), make_metrics(1))
    results = [(config_of(num_steps=40), (0, 1), fleetjax.Result(stacked, None))]  # pyright: ignore[reportArgumentType]
    assert fleetjax.compare(results, metrics="moving").mean == np.mean(np.sum(stacked.moving, axis=1))
    line = fleetjax.plot(results).axes[2].lines[0]
    np.testing.assert_allclose(line.get_ydata(), np.mean(np.cumsum(stacked.idle, axis=1), axis=0))


def test_groups_are_settings_and_environments_have_their_own(study):
    other = fleetjax.make_config("block_push", "cur", num_steps=STEPS)
    runs = [study, *runs_of("cur", {0: 7}, uncertainty_threshold=0.1), (other, 0, make_metrics(0, STEPS))]
    comparison = fleetjax.compare(runs, against="Random", metrics="idle")
    shown = [(row["environment"], row["group"], row["against"]) for row in rows_of(comparison)]
    assert shown == [
        ("navigation", "C.U.R., uncertainty_threshold 0.03", "Random"),
        ("navigation", "Random", ""),
        ("navigation", "C.U.R., uncertainty_threshold 0.1", "Random"),
        ("block_push", "C.U.R.", ""),
    ]
    with pytest.raises(
        ValueError, match=r"against = 'cur' stands for several groups of navigation; choose one of: C.U.R., unc"
    ):
        fleetjax.compare(runs, against="cur")


def test_tables_fit_a_screen_and_tell_all(study):
    text = fleetjax.compare(study, against="random").markdown()
    assert max(map(len, text.splitlines())) <= 100
    assert [line for line in text.splitlines() if line.startswith("#")] == [
        "## navigation", "### successes", "### violations", "### idle", "### rohe",
    ]  # fmt: skip
    row = rows_of(fleetjax.compare(study), metric="successes")[0]
    shown = [f"{row[name]:,.0f}" for name in ("mean", "low", "high", "interquartile_mean", "human_time")]
    mean, low, high, middle, human_time = shown
    line = next(line for line in text.splitlines() if line.startswith("| C.U.R."))
    assert [cell.strip() for cell in line.split("|")[1:-1]] == ["C.U.R.", "5", mean, f"{low} to {high}", middle, human_time]
    assert "| 95 % interval |" in text.splitlines()[4]
    assert "P(higher)" not in fleetjax.compare(study).markdown()


def test_tables_say_where_they_show_a_range():
    few, many = runs_of("cur", {0: 5, 1: 9}), runs_of("random", {seed: 5 + seed for seed in range(5)})
    text = fleetjax.compare([*few, *many, *runs_of("uc", {0: 7})], metrics="successes").markdown()
    lines = {line.split("|")[1].strip(): line for line in text.splitlines() if line.startswith("|")}
    assert "95 % interval (range)" in lines["group"]
    assert "(5.00 to 9.00)" in lines["C.U.R."]
    assert "5.80 to 8.20" in lines["Random"]
    assert lines["U.C."].split("|")[4].strip() == "-"
    assert " range |" in fleetjax.compare(few, metrics="successes").markdown()
    assert "fewer than 5 seeds" in " ".join(text.split())


def test_the_csv_has_every_column(study):
    comparison = fleetjax.compare(study, against="random")
    table = pd.read_csv(pd.io.common.StringIO(comparison.csv()))
    assert list(table.columns) == list(comparison._fields)
    for name, column in comparison._asdict().items():
        found = table[name].fillna("") if column.dtype.kind == "U" else table[name]
        np.testing.assert_array_equal(found, column, err_msg=name)


def test_the_command_writes_what_is_asked_for(study, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    expected = fleetjax.compare("study", against="cur")
    assert cli.main(["compare", "study", "--against", "cur"]) == 0
    assert capsys.readouterr().out == expected.markdown()
    outputs = [flag for name in ("a.md", "a.csv", "a.png", "a.svg") for flag in ("--output", name)]
    command = ["compare", "study", *outputs, "--against", "cur", "--rows", "rows.csv"]
    assert cli.main(command) == 0
    printed = capsys.readouterr()
    assert (printed.out.split(), printed.err) == (["a.md", "a.csv", "a.png", "a.svg"], "rows.csv: 10 rows\n")
    content = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    assert content["a.md"].decode() == expected.markdown()
    assert content["a.csv"].decode() == expected.csv()
    assert content["a.png"][:4] == b"\x89PNG"
    assert b"mean of 5 seeds, band: 95 % interval" in content["a.svg"]
    assert "a.md already exists" in refused(capsys, *command)
    assert cli.main([*command, "--overwrite"]) == 0
    assert cli.main(["compare", "rows.csv", "--metric", "idle", "--metric", "rohe", "--against", "cur"]) == 0
    again = capsys.readouterr().out.split("\n## ")[-1]
    assert again.split("\n\n")[2:4] == expected.markdown().split("### idle\n\n")[1].split("\n\n")[:2]


def test_rows_hold_whole_runs(study, tmp_path):
    changed = config_of("random", num_robots=20, hidden_sizes=(8, 8), learning_rate=0.02, random_threshold=0.3)
    runs = [*sources.collect(study), *sources.collect([(changed, 7, make_metrics(9, STEPS))])]
    path = tmp_path / "rows.csv"
    path.write_bytes(rows.write(runs))
    found = sources.collect(path)
    assert rows.write(found) == path.read_bytes()
    table = pd.read_csv(path)
    kept = json.loads(table["config"][10])
    assert (kept["hidden_sizes"], kept["learning_rate"], kept["random_threshold"]) == ([8, 8], 0.02, 0.3)
    assert set(table["processor"]) == {rows.processor()} != {""}
    assert table["successes"].tolist() == [np.sum(run.metrics.successes) for run in runs]
    assert max(map(len, path.read_text().splitlines())) < 6000
    for run, read in zip(runs, found, strict=True):
        assert plain.to_plain(read.config) == plain.to_plain(run.config)
        assert read.seed == run.seed
        assert len(read.timesteps) == outcomes.MAX_POINTS
        for name in rows.CURVES:
            curve, kept = (np.cumsum(getattr(x.metrics, name)) for x in (run, read))
            np.testing.assert_array_equal(kept, curve[read.timesteps - 1])
    assert fleetjax.compare(found[:10]).csv() == fleetjax.compare(study).csv()


@pytest.mark.parametrize(
    ("algorithm", "given"),
    [
        ("constraint_trained", {"gradient_steps": 2, "pretraining_steps": 1160, "num_steps": 40}),
        ("cur", {"human_model": "perfect", "absence_time": 50.0, "takeover_spread": 0.2}),
        ("cur", {"human_model": "imperfect"}),
        ("cur", {"num_humans": 2, "takeover_time": (1.0, 2.5), "link_model": "swapping"}),
        ("random", {"link_model": "gilbert_elliott", "link_failure_rate": 0.3, "random_threshold": 0.25}),
    ],
)
def test_rows_give_back_the_configuration_though_defaults_follow_from_others(tmp_path, algorithm, given):
    config = fleetjax.make_config("navigation", algorithm, **given)
    path = tmp_path / "rows.csv"
    path.write_bytes(rows.write(sources.collect([(config, 0, make_metrics(0, config.num_steps))])))
    assert plain.to_plain(rows.read(path)[0].config) == plain.to_plain(config)


def test_rows_do_not_change_with_the_defaults(tmp_path, monkeypatch):
    config, path = fleetjax.make_config("navigation"), tmp_path / "rows.csv"
    path.write_bytes(rows.write(sources.collect([(config, 0, make_metrics(0, config.num_steps))])))
    entry = envs.ENVIRONMENTS.get("navigation")
    monkeypatch.setitem(envs.ENVIRONMENTS.entries, "navigation", entry._replace(defaults={"batch_size": 32}))
    assert fleetjax.make_config("navigation").batch_size == 32
    assert plain.to_plain(rows.read(path)[0].config) == plain.to_plain(config)


def test_a_file_that_is_named_twice_is_refused(study, tmp_path, capsys):
    path = tmp_path / "table.csv"
    assert "is named twice" in refused(capsys, "compare", study, "--output", path, "--rows", path)
    assert not path.exists()


def test_figures_of_rows_are_those_of_the_runs(study, tmp_path):
    (tmp_path / "rows.csv").write_bytes(rows.write(sources.collect(study)))
    drawn, again = (fleetjax.plot(source).axes for source in (study, tmp_path / "rows.csv"))
    for panel, same in zip(drawn, again, strict=True):
        for line, other in zip(panel.lines, same.lines, strict=True):
            kept = np.isin(line.get_xdata(), other.get_xdata())
            assert np.sum(kept) == outcomes.MAX_POINTS
            np.testing.assert_allclose(line.get_ydata()[kept], other.get_ydata(), rtol=1e-6)
        for band, other in zip(panel.collections, same.collections, strict=True):
            assert band.get_paths()[0].vertices[-1] == pytest.approx(other.get_paths()[0].vertices[-1], rel=1e-5)


def test_rows_and_runs_of_another_length_share_a_figure(study, tmp_path):
    (tmp_path / "rows.csv").write_bytes(rows.write(sources.collect(study / "cur-0")))
    short = (config_of("cur"), 1, make_metrics(1, 100))
    curves = figure.group([tmp_path / "rows.csv", short])[0]
    assert curves.timesteps[-1] <= 100
    np.testing.assert_array_equal(curves.values[1, 0], np.cumsum(short[2].successes)[curves.timesteps - 1])


def test_rows_keep_what_they_say_of_their_machine(study):
    run = sources.collect(study / "cur-0")[0]
    elsewhere = run._replace(processor="an older one", versions=run.versions | {"jax": "0.1"})
    content = rows.write([elsewhere]).decode()
    assert "an older one" in content
    assert next(csv.DictReader(content.splitlines()))["jax"] == "0.1"


def damage(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def test_damaged_rows_are_refused(study, tmp_path, capsys):
    sound = rows.write(sources.collect(study)[:2]).decode()
    spoilt = {
        '""human_steps"":[': ('""human_steps"":[9999,', "row 1: the curve of human_steps does not rise to its total"),
        "navigation,": ("navigatoin,", "row 1: environment = 'navigatoin' is unknown"),
        f",{STEPS},": (",many,", "row 1: invalid literal"),
        '""batch_size"":': ('""batch_sizes"":', "row 1: unknown fields: batch_sizes"),
        '""batch_size"":128,': ("", "row 1: missing fields: batch_size (another version of fleetjax?)"),
        '"{""supervisor""': ('"{""num_robot"":3,""supervisor""', "row 1: unknown fields: num_robot"),
    }  # fmt: skip
    for i, (old, (new, reason)) in enumerate(spoilt.items()):
        path = tmp_path / f"{i}.csv"
        path.write_text(sound)
        assert f"{path} cannot be used: {reason}" in " ".join(refused(capsys, "compare", damage(path, old, new)).split())
    path.write_text(sound[:-700])
    assert f"{path} cannot be used: row 2: " in refused(capsys, "compare", path)
    path.write_text(sound.replace("timesteps", "times", 1))
    assert f"{path} is not a file of rows: it has no columns timesteps" in refused(capsys, "compare", path)
    path.write_text(sound.splitlines()[0])
    assert f"{path} has no rows" in refused(capsys, "compare", path)
    assert "nowhere.csv cannot be read" in refused(capsys, "compare", "nowhere.csv")
    path.write_text(sound.replace("switches", "swaps"))
    assert f"{path}, row 1 has no switches; choose another --metric" in refused(capsys, "compare", path, "--metric", "switches")
    assert cli.main(["compare", str(path)]) == 0


def test_what_cannot_be_compared_is_refused(study, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for arguments, reason in {
        (study, "--metric", "sucesses"): "metric = 'sucesses' is unknown; choose from successes, violations, hard_resets,",
        (study, "--against", "uc"): "against = 'uc' is not among the groups; choose an algorithm or one of: C.U.R.; Random",
        (study, "--output", "table.txt"): "--output table.txt must end in one of .md, .csv, .png",
        (study, "--rows", "rows.json"): "--rows rows.json must end in .csv",
        (study, "--output", tmp_path / "no" / "a.md"): "does not exist",
        (tmp_path / "empty",): f"{tmp_path / 'empty'} is not a run folder and holds none",
        (tmp_path / "nowhere",): f"{tmp_path / 'nowhere'} is not a run folder: it does not exist",
        (): "required: DIR",
    }.items():
        assert reason in refused(capsys, "compare", *arguments)
    damage(study / "random-3" / "metrics.csv", "\n7,", "\n8,")
    assert f"{study / 'random-3' / 'metrics.csv'} cannot be used: its SHA-256" in refused(capsys, "compare", study)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"num_steps": 200}, "num_steps = 300 in {0}/cur-0, but 200 in {0}/odd"),
        ({"num_robots": 50}, "num_robots = 100 in {0}/cur-0, but 50 in {0}/odd"),
        ({"num_humans": 5}, "num_humans = 10 in {0}/cur-0, but 5 in {0}/odd"),
        ({"interrupted": True}, "{0}/odd has 200 of 300 timesteps; finish it, or compare with --allow-different"),
    ],
)
def test_different_runs_are_compared_only_if_asked(study, changes, reason, capsys):
    interrupted = changes == {"interrupted": True}
    config = config_of("uc") if interrupted else config_of("uc", **changes)
    write_run(study / "odd", config, 0, make_metrics(0, 200 if interrupted else config.num_steps))
    assert reason.format(study) in refused(capsys, "compare", study)
    assert cli.main(["compare", str(study), "--allow-different"]) == 0
    assert "| U.C. " in capsys.readouterr().out


def test_expert_may_have_its_humans_and_results_need_their_configuration(study):
    expert = (config_of("expert"), 0, make_metrics(0, STEPS))
    assert "Expert" in fleetjax.compare([study, expert]).group
    with pytest.raises(ValueError, match=r"pass \(config, seed, result\)"):
        fleetjax.plot([fleetjax.Result(make_metrics(), None)])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"seed = 0 does not fit metrics of shape \(2, 40\)"):
        fleetjax.compare([(config_of(), 0, jax.tree.map(lambda *x: np.stack(x), make_metrics(), make_metrics()))])
    with pytest.raises(ValueError, match="there are no runs"):
        fleetjax.compare([])


def test_runs_that_were_killed_are_refused(study, capsys):
    run = folder.read_run(study / "cur-0")
    folder.write_config(run, sealed=False)
    said = refused(capsys, "compare", study, "--allow-different")
    assert f"the run is not finished; resume it with: fleetjax run --resume {run.folder}" in said

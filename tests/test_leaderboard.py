"""The leaderboard: its rows, its table, its command."""

import functools
import shutil

import numpy as np
import pytest
from commands import make_metrics, refused

import fleetjax
from fleetjax import cli
from fleetjax.io import calibration, folder, leaderboard, resumable, sources
from fleetjax.io.errors import Diverged


@pytest.fixture
def stored(tmp_path):
    """A folder with the runs of C.U.R., of a rule with twice its successes, and of one whose human time nothing changes."""
    store = leaderboard.Store(tmp_path)
    for algorithm, field, factor in (
        ("cur", "uncertainty_threshold", 1),
        ("random", "random_threshold", 2),
        ("constraint", "", 1),
    ):
        config = fleetjax.make_config("navigation", algorithm, initial_period=0, num_steps=40)
        runs = []
        for seed in range(3):
            metrics = make_metrics(seed, 40)
            spent = np.full(40, 120 if field else 150, np.int32)  # of 5,000: within a tenth, and not
            runs.append((config, seed, metrics._replace(successes=factor * metrics.successes, human_steps=spent)))
        value = float(fleetjax.config.get_value(config, field)) if field else 0.0
        place = leaderboard.Place("navigation", algorithm, 5000, field, value, 5000.0, solved=bool(field))
        store.add(place, sources.collect(runs))
    return tmp_path


def test_the_table_has_the_most_successes_first_and_stars_for_other_human_times(stored, capsys):
    assert cli.main(["leaderboard", "show", "--results", str(stored)]) == 0
    assert capsys.readouterr().out == f"{stored / 'leaderboard.md'}\n"
    rows = [line.split("|")[1].strip() for line in (stored / "leaderboard.md").read_text().splitlines() if "|" in line]
    assert rows[2] == "Random"
    assert sorted(rows[3:]) == ["C.U.R.", "Constraint *"]
    total = {seed: int(make_metrics(seed, 40).successes.sum()) for seed in range(3)}
    low, high, mean = min(total.values()), max(total.values()), sum(total.values()) / 3
    line = next(line for line in (stored / "leaderboard.md").read_text().splitlines() if "| Random" in line)
    assert line.split("|")[-2].strip() == f"{mean:.3g} ({low} to {high})"  # more than C.U.R.: as many as that has
    assert (stored / "leaderboard.png").stat().st_size > 10_000


def test_extra_demonstrations_count_as_human_time_and_the_newest_settings_stand(stored):
    store, runs = leaderboard.Store(stored), []
    place = leaderboard.Place("navigation", "constraint", 5000, "", 0.0, 0.0, solved=False)
    config = fleetjax.make_config("navigation", "constraint", initial_period=0, num_steps=40, extra_demonstrations=2000)
    for seed in range(3):
        metrics = make_metrics(seed, 40)
        runs.append((config, seed, metrics._replace(human_steps=np.full(40, 150, np.int32))))
    store.add(place, sources.collect(runs))
    assert cli.main(["leaderboard", "show", "--results", str(stored)]) == 0
    line = next(line for line in (stored / "leaderboard.md").read_text().splitlines() if "| Constraint" in line)
    cells = [cell.strip() for cell in line.split("|")]
    assert cells[4] == "8,000"  # 40 * 150 + 2,000, of which the older runs have 6,000
    successes = [int(metrics.successes.sum()) for _, _, metrics in runs]
    rohe = np.mean([config.num_humans / config.num_robots * count / (1 + 8000 / 100) for count in successes])
    assert float(cells[6]) == pytest.approx(rohe, rel=0.01)


def test_stored_runs_and_calibrations_are_read_again(stored):
    again = leaderboard.Store(stored)
    assert [place.algorithm for place in again.places] == ["cur", "random", "constraint"]
    assert len(again.runs) == 9
    assert again.find("navigation", "random", 5000) == again.places[1]
    assert again.find("navigation", "random", 2500) is None


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("show", "cur"), "unexpected argument 'cur'"),
        (("remove", "expert"), "nothing is stored of 'expert'; there is cur, random, constraint"),
        (("add",), "the following arguments are required: RULE"),
        ((), "the following arguments are required: ACTION"),
        (("add", "curr"), "algorithm = 'curr' is unknown; the closest are"),
        (("add", "cur", "--environments", "mars"), "environment = 'mars' has no leaderboard; choose from navigation"),
        (("add", "cur", "--seeds", "0"), "seeds = 0 must be from 1 to 100"),
        (("add", "cur", "--budgets", "0"), "human_time = 0 must lie between 0 and 20000"),
        (("add", "thrifty_dagger", "--environments", "humanoid"), "needs a goal"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, reason, stored, capsys):
    before = {path.name: path.read_bytes() for path in stored.iterdir()}
    assert reason in refused(capsys, "leaderboard", *arguments, *(["--results", stored] if arguments else []))
    assert {path.name: path.read_bytes() for path in stored.iterdir()} == before


def test_rows_without_their_calibrations_are_refused_and_nothing_is_overwritten(stored, capsys):
    shown = (stored / "leaderboard.md").read_bytes() if (stored / "leaderboard.md").exists() else None
    for content, reason in (
        (None, "has no calibrations of theirs"),
        ("{}", "leaderboard.json cannot be used: 'calibrations'"),
        ('{"calibrations": [{"rule": 1}]}', "leaderboard.json cannot be used"),
        ("{", "leaderboard.json cannot be used"),
    ):
        (stored / "leaderboard.json").unlink(missing_ok=True)
        if content:
            (stored / "leaderboard.json").write_text(content)
        assert reason in refused(capsys, "leaderboard", "show", "--results", stored)
        assert ((stored / "leaderboard.md").read_bytes() if (stored / "leaderboard.md").exists() else None) == shown


def test_robots_keep_the_initial_period_and_have_one_threshold_tuned(tmp_path):
    for environment in leaderboard.BUDGETS:
        (entry,) = leaderboard.entries(["cur"], [environment], leaderboard.BUDGETS[environment][:1], 3, tmp_path)
        period = {"humanoid": 1000, "anymal": 250, "allegro_hand": 2500}.get(environment, 0)
        assert int(entry.config.initial_period) == period
        assert len(entry.requests) == (1 if period else 3)


@pytest.mark.parametrize(("seeds", "best"), [((100,), 0.95), ((100, 101), 0.8)])
def test_rules_with_two_thresholds_have_both_tuned(tmp_path, monkeypatch, seeds, best):
    """Of the risk thresholds at which a budget is met, the one with the most successes runs; if none is, the nearest."""
    effort = leaderboard.Effort(seeds=seeds, most=3, tolerance=0.07)
    monkeypatch.setitem(leaderboard.EFFORTS, "navigation", effort)
    (entry,) = leaderboard.entries(["cur"], ["navigation"], (5000,), 2, tmp_path)
    (other,) = leaderboard.entries(["thrifty_dagger"], ["navigation"], (5000,), 2, tmp_path)
    assert all((request.seeds, request.most, request.tolerance) == effort[:3] for request in entry.requests.values())
    assert tuple(entry.requests) == effort.risk_thresholds == (0.5, 0.8, 0.95)
    assert all(request.config.risk_threshold == risk for risk, request in entry.requests.items())
    assert len({request.output for request in entry.requests.values()}) == len(entry.requests)
    assert tuple(other.requests) == (None,)
    spends, successes = {0.5: 9000.0, 0.8: 5100.0, 0.95: 4950.0}, {0.5: 90, 0.8: 10, 0.95: 20}

    def calibrate(request):
        spent = spends[round(float(request.config.risk_threshold), 2)]
        solved = abs(spent - request.human_time) <= 0.05 * request.human_time
        each = tuple(spent + shift for shift in range(1 - len(seeds), len(seeds), 2))
        return calibration.Calibration(0.1, each, 0.0, solved, [(0.1, spent)])

    def collect(path):
        risk, seed = float(path.parent.name.removeprefix("risk_threshold-")), path.name.rpartition("-seed")[2]
        metrics = make_metrics(0, 40)
        metrics = metrics._replace(successes=np.full(1, successes[risk] if seed == "100" else 60 - 2 * successes[risk]))
        return sources.collect([(entry.config, 100, metrics)])

    monkeypatch.setattr(calibration, "calibrate", calibrate)
    monkeypatch.setattr(calibration, "has_effect", lambda request: True)
    monkeypatch.setattr(leaderboard, "collect", collect)
    place = leaderboard.tune(entry)
    assert place.solved
    assert place.settings == {"uncertainty_threshold": 0.1, "risk_threshold": best}
    place = leaderboard.tune(entry._replace(budget=7000))
    assert (place.solved, place.spent, place.risk_threshold) == (False, 5100.0, 0.8)


def test_a_rule_without_a_threshold_is_not_calibrated(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "calibrate", lambda request: pytest.fail("a calibration runs"))
    (entry,) = leaderboard.entries(["longest_waiting"], ["navigation"], (5000,), 2, tmp_path)
    place = leaderboard.tune(entry)
    assert (place.field, place.settings, place.solved) == ("", {}, False)


def test_rules_that_need_goals_are_left_out_where_there_are_none(tmp_path, capsys):
    found = leaderboard.entries(["thrifty_dagger", "cur"], ["humanoid", "navigation"], (), 2, tmp_path)
    pairs = {(entry.environment, entry.algorithm) for entry in found}
    assert pairs == {("navigation", "thrifty_dagger"), ("humanoid", "cur"), ("navigation", "cur")}
    assert "left out: humanoid: algorithm = 'thrifty_dagger' needs a goal" in capsys.readouterr().err


def test_a_removed_rule_is_forgotten(stored, capsys):
    assert cli.main(["leaderboard", "remove", "random", "--results", str(stored)]) == 0
    assert "before you add a changed rule, delete them or choose another --output" in capsys.readouterr().err
    again = leaderboard.Store(stored)
    assert {run.config.algorithm for run in again.runs} == {"cur", "constraint"}
    assert "Random" not in (stored / "leaderboard.md").read_text()
    assert cli.main(["leaderboard", "remove", "cur", "constraint", "--results", str(stored)]) == 0
    assert [path.name for path in stored.iterdir() if path.suffix != ".lock"] == ["leaderboard.json"]
    assert not leaderboard.Store(stored).places


def test_only_runs_with_the_tuned_values_count(stored):
    store = leaderboard.Store(stored)
    place = store.find("navigation", "random", 5000)
    assert place is not None
    assert store.group_of(place) is not None
    assert store.group_of(place._replace(value=place.value / 2)) is None
    assert store.group_of(place._replace(risk_threshold=0.8)) is None
    assert store.group_of(place._replace(risk_threshold=0.5)) is not None


@pytest.fixture
def add(tmp_path, monkeypatch):
    """A function that adds rules by the command, with runs that are made up; it returns the exit code.

    Random diverges if `diverges`. Changed defaults are those of navigation.
    """

    def add(*rules, diverges=False, **defaults):
        done: list[folder.Run] = []

        def complete(run, **_):
            if diverges and run.config.algorithm == "random":
                raise Diverged("the policy is no longer finite")
            done.append(run)

        def collect(_):
            return sources.collect([(done[-1].config, done[-1].seed, make_metrics(0, 40))])

        def tune(entry):
            field = "random_threshold" if entry.algorithm == "random" else ""
            return leaderboard.Place(*entry[:3], field, 0.9, 300.0, solved=bool(field))

        for name, replacement in {"tune": tune, "collect": collect}.items():
            monkeypatch.setattr(leaderboard, name, replacement)
        monkeypatch.setattr(leaderboard, "make_config", functools.partial(fleetjax.make_config, num_steps=40, **defaults))
        monkeypatch.setattr(resumable, "complete", complete)
        where = ("--results", tmp_path, "--output", tmp_path / "runs")
        command = ("leaderboard", "add", *rules, "--environments", "navigation", "--budgets", 300, *where)
        return cli.main([*map(str, command)])

    return add


def test_runs_of_other_defaults_are_never_compared(tmp_path, add, capsys):
    assert add("random") == 0
    before = (tmp_path / "leaderboard.csv").read_bytes()
    for rule in ("random", "constraint"):
        assert add(rule, hard_reset_time=7) == 2
        reason = "the stored runs of random on navigation have other settings (hard_reset_time = 7, but the run has 5)"
        assert reason in capsys.readouterr().err
    assert (tmp_path / "leaderboard.csv").read_bytes() == before
    leaderboard.remove(tmp_path, ["random"])
    assert add("random", hard_reset_time=7) == 0


@pytest.mark.parametrize("newest_first", [False, True])
def test_of_two_settings_that_are_stored_todays_stand_in_the_table(tmp_path, add, newest_first):
    assert add("random") == 0
    store = leaderboard.Store(tmp_path)
    others = [run._replace(config=run.config.replace(hard_reset_time=7)) for run in store.runs[:1]]
    store.runs = others + store.runs if newest_first else store.runs + others
    found = store.group_of(store.places[0])
    assert found is not None
    assert len(found.runs) == 5


def test_a_rule_that_fails_does_not_stop_the_others(tmp_path, add, capsys):
    assert add("random", "constraint", diverges=True) == 1
    printed = capsys.readouterr().err
    assert "Random on navigation at 300 human timesteps failed: the policy is no longer finite" in printed
    assert "1 of 2 failed: Random on navigation at 300 human timesteps" in printed
    assert [run.config.algorithm for run in leaderboard.Store(tmp_path).runs] == ["constraint"] * 5


def test_a_calibration_without_runs_can_be_removed(tmp_path):
    leaderboard.Store(tmp_path).add(leaderboard.Place("navigation", "random", 5000, "random_threshold", 0.9, 5e3, solved=True))
    assert not (tmp_path / "leaderboard.csv").exists()
    assert cli.main(["leaderboard", "remove", "random", "--results", str(tmp_path)]) == 0
    assert not leaderboard.Store(tmp_path).places


@pytest.mark.slow
def test_an_interrupted_rule_goes_on_where_it_stopped(tmp_path, monkeypatch):
    small = {
        "num_robots": 6,
        "num_humans": 3,
        "num_steps": 60,
        "hidden_sizes": (8,),
        "batch_size": 16,
        "num_demonstrations": 40,
    }
    monkeypatch.setattr(leaderboard, "make_config", functools.partial(fleetjax.make_config, **small, pretraining_steps=5))
    complete, done = resumable.complete, []

    def interrupted(run, **options):
        if len(done) == stop:
            raise KeyboardInterrupt
        done.append(run.folder.name)
        return complete(run, **options)

    monkeypatch.setattr(resumable, "complete", interrupted)
    (tmp_path / "results").mkdir()
    entry, stop = leaderboard.entries(["teach_first"], ["navigation"], (90,), 3, tmp_path / "runs")[0], 10**9
    leaderboard.compete(leaderboard.Store(tmp_path / "results"), [entry])
    whole, number = leaderboard.Store(tmp_path / "results"), len(done)
    place = whole.places[0]
    assert place.solved
    assert abs(place.spent - 90) <= 0.05 * 90
    assert [run.seed for run in whole.runs] == [0, 1, 2]

    shutil.rmtree(tmp_path / "results")
    shutil.rmtree(tmp_path / "runs")
    (tmp_path / "results").mkdir()
    done.clear()
    stop = number - 1  # before the last seed
    with pytest.raises(KeyboardInterrupt):
        leaderboard.compete(leaderboard.Store(tmp_path / "results"), [entry])
    assert [run.seed for run in leaderboard.Store(tmp_path / "results").runs] == [0, 1]
    stop = 10**9
    leaderboard.compete(leaderboard.Store(tmp_path / "results"), [entry])
    assert len(done) == number
    again = leaderboard.Store(tmp_path / "results")
    assert again.places == whole.places
    assert [run.metrics.successes.tolist() for run in again.runs] == [run.metrics.successes.tolist() for run in whole.runs]


def test_without_stored_runs_it_says_where_they_are(tmp_path, capsys):
    shutil.rmtree(tmp_path)
    line = refused(capsys, "leaderboard", "show", "--results", tmp_path)
    assert "run this in a clone of the repository, or give --results DIR" in line

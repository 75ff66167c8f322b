"""`fleetjax calibrate`: the value of a parameter at which an algorithm spends a given human time."""

import json
import math

import numpy as np
import pytest
from commands import refused

import fleetjax
from fleetjax import cli
from fleetjax.io import calibration, folder

SMALL = [
    *("navigation", "--algorithm", "random", "--num-robots", "20", "--num-humans", "4", "--num-steps", "60"),
    *("--gradient-steps", "0", "--pretraining-steps", "1", "--num-demonstrations", "128", "--hidden-sizes", "8"),
]


def calibrate(path, *arguments: object) -> int:
    return cli.main(["calibrate", *SMALL, "--output", str(path), *map(str, arguments)])


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration")
    assert calibrate(path, "--human-time", 120, "--seeds", 3, "--tolerance", 0.1) == 0
    return path


def test_the_value_spends_the_time_in_runs_that_anyone_can_look_at(solved):
    found = json.loads((solved / "calibration-random_threshold-120.json").read_text())
    assert found["solved"]
    assert found["field"] == "random_threshold"
    spent = []
    for seed in range(3):
        run = folder.read_run(solved / f"random_threshold-{np.float32(found['value'])!s}-seed{seed}")
        assert float(run.config.parameters["random_threshold"]) == pytest.approx(found["value"])
        spent.append(int(folder.read_metrics(run).human_steps.sum()))
    assert spent == found["human_time"]
    assert sum(spent) / 3 == pytest.approx(120, rel=0.1)
    assert 0 < found["error"] < 0.5


def test_the_same_command_answers_from_what_it_ran(solved, capsys):
    before = {path: path.stat().st_mtime_ns for path in solved.glob("*/metrics.csv")}
    assert calibrate(solved, "--human-time", 120, "--seeds", 3, "--tolerance", 0.1) == 0
    assert {path: path.stat().st_mtime_ns for path in solved.glob("*/metrics.csv")} == before
    assert capsys.readouterr().out.startswith("random_threshold = 0.9")


def calibrated(tmp_path, monkeypatch, spends, **options):
    """Calibrate Random where a run spends `spends(threshold, seed)`; return what was found and the runs that it took."""
    config = fleetjax.make_config("navigation", "random")
    request = calibration.Request(config, "random_threshold", 1000.0, (0, 1, 2), 0.1, 5, tmp_path)._replace(**options)
    runs = []

    def spend(request, value, seed):
        runs.append((value, seed))
        return float(spends(value, seed))

    monkeypatch.setattr(calibration, "_human_time", spend)
    return calibration.calibrate(request), runs


@pytest.mark.parametrize("others", [0.5, 0.8, 1.3, 3.0])
def test_the_mean_over_all_seeds_is_what_is_solved(tmp_path, monkeypatch, others):
    found, runs = calibrated(tmp_path, monkeypatch, lambda x, seed: 2e4 * (1 - x) * (others if seed else 1))
    assert found.solved
    assert np.mean(found.human_time) == pytest.approx(1000, rel=0.1)
    assert 2e4 * (1 - found.value) * (1 + 2 * others) / 3 == pytest.approx(1000, rel=0.1)
    assert len(runs) == len(set(runs)) <= 5 + 3 * 5


def test_a_first_value_that_is_near_enough_for_one_seed_alone_is_corrected(tmp_path, monkeypatch):
    config = fleetjax.make_config("navigation", "random", random_threshold=0.95)
    found, _ = calibrated(tmp_path, monkeypatch, lambda x, seed: 2e4 * (1 - x) * (2 if seed else 1), config=config)
    assert found.solved
    assert found.value == pytest.approx(0.97, abs=0.005)


def test_no_uncertainty_above_the_largest_entropy_is_tried(tmp_path, monkeypatch):
    config = fleetjax.make_config("block_push", "cur")
    options = {"config": config, "field": "uncertainty_threshold", "human_time": 50.0}
    found, runs = calibrated(tmp_path, monkeypatch, lambda x, seed: 400 if x < 1 else 90, **options)
    assert found.value == max(value for value, _ in runs) == pytest.approx(math.log(4))
    assert not found.solved


def test_of_values_with_all_seeds_the_nearest_is_taken(tmp_path, monkeypatch):
    found, _ = calibrated(tmp_path, monkeypatch, lambda x, seed: (500 if x > 0.9 else 1400) + 300 * (seed == 1))
    assert not found.solved
    assert found.human_time == (500, 800, 500)  # with the first seed alone, 1,400 is nearer
    assert math.isnan(found.error)


@pytest.mark.slow
def test_the_nearest_is_told_where_nothing_spends_so_much(tmp_path, capsys):
    assert calibrate(tmp_path, "--human-time", 239, "--seeds", 1, "--most", 2, "--tolerance", 0.001) == 0
    assert "No value that was tried spends 239; this one is the nearest." in capsys.readouterr().out
    answer = (tmp_path / "calibration-random_threshold-239.json").read_text()
    assert json.loads(answer, parse_constant=pytest.fail)["error"] is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--human-time is missing"),
        (["--human-time", "300"], "human_time = 300 must lie between 0 and 240"),
        (["--human-time", "100", "--field", "num_robots"], "field = 'num_robots' must be a real-valued traced field; choose"),
        (["--human-time", "100", "--field", "uncertainty"], "field = 'uncertainty' must be a real-valued traced field"),
        (["--human-time", "100", "--seeds", "0"], "seeds must name one or more"),
        (["--human-time", "100", "--most", "0"], "most = 0 must be at least 1"),
        (["--human-time", "100", "--field", "temperature"], "field = 'temperature' makes no difference to 'random'"),
        (["--human-time", "100", "--field", "takeover_time"], "takeover_time has no effect with human_model = 'perfect'"),
        (["--human-time", "100", "--field", "success_return"], "field = 'success_return' may be negative"),
        (["--human-time", "100", "--first-seed", str(2**32 - 1), "--seeds", "2"], f"end at seed {2**32}, beyond {2**32 - 1}"),
    ],
)
def test_what_cannot_be_found_is_refused(tmp_path, capsys, arguments, words):
    assert words in refused(capsys, "calibrate", *SMALL, "--output", tmp_path / "new", *arguments)
    assert not (tmp_path / "new").exists()


def test_runs_of_other_settings_in_the_same_folder_are_refused_in_a_line(solved, capsys):
    given = ("--human-time", 120, "--seeds", 3, "--tolerance", 0.1, "--hard-reset-time", 3)
    reason = refused(capsys, "calibrate", *SMALL, "--output", solved, *given)
    assert "hard_reset_time = 3, but the run has 5" in reason

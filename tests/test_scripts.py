"""Every script in benchmarks/ and experiments/ prints and writes what it should, with arguments that make it small."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import paper
import pytest
from commands import TINY, make_metrics, write_run
from compiling import environment

import fleetjax
from fleetjax.io import rows, scripts, sources

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(
    path.relative_to(ROOT).as_posix()
    for part in ("benchmarks", "experiments")
    for path in (ROOT / part).glob("*.py")
    if "\ndef main(" in path.read_text()
)
FLEET = " ".join(TINY)
CHANGED = ("teach-oldest", "teach-gain-apart", "cur-dense", "cur-apart", "cur-until-certain", "cur-priced")  # of beat_cur.py
PPO = "num_envs=8 num_eval_envs=2 episode_length=10 unroll_length=4 batch_size=8 num_minibatches=2"


class Case(NamedTuple):
    """How a script is tried.

    Attributes:
        commands: its arguments, of one run after the other.
        prints: regular expressions, each of which is found in what it prints, line by line.
        writes: files that are there afterwards.
        prepare: what is called with the working folder before.
        pace: None if it is done in about 15 s; "slow" if users rely on it; else "long".
    """

    commands: tuple[str, ...]
    prints: tuple[str, ...]
    writes: tuple[str, ...] = ()
    prepare: Callable[[Path], None] = lambda place: None
    pace: str | None = "slow"


def row(*cells: str) -> str:
    """Return a regular expression for a line of a Markdown table that begins with these cells."""
    return r"^\|" + "".join(rf" +{cell} +\|" for cell in cells)


def make_runs(place: Path) -> None:
    """Write what `human_time.py` reads: two finished runs."""
    config = fleetjax.make_config("navigation", num_robots=6, num_humans=2, num_steps=40)
    for seed in range(2):
        write_run(place / f"run-{seed}", config, seed, make_metrics(seed, 40))


def test_parameters_of_rules_are_passed_on_and_other_flags_refused(monkeypatch, capsys):
    parser = argparse.ArgumentParser(prog="script")
    monkeypatch.setattr("sys.argv", ["script", "--", "--num-robots", "6", "--teaching-time", "4", "--takeover-time", "2"])
    assert scripts.parse(parser)[1] == {"num_robots": 6, "teaching_time": 4.0, "takeover_time": 2.0}
    monkeypatch.setattr("sys.argv", ["script", "--", "--num-robots", "6", "--seed", "7", "--output", "here"])
    with pytest.raises(SystemExit):
        scripts.parse(parser)
    assert "only parameters of a run may follow after --, and not --seed, --output" in capsys.readouterr().err


def make_rows(place: Path) -> None:
    """Write rows that `claims.py` judges: C.U.R. has ten times the successes of others, and more violations than Random."""
    runs = []
    for i, algorithm in enumerate(("cur", "constraint", "random", "ensemble_dagger")):
        config = fleetjax.make_config("humanoid", algorithm, num_robots=6, num_humans=2, num_steps=40, initial_period=10)
        for seed in range(5):
            metrics = make_metrics(seed, 40)
            counts = {
                "successes": metrics.successes + 10 * (i == 0),
                "violations": metrics.violations + 2 * (i == 0) + (i == 3),
            }
            runs.append((config, seed, metrics._replace(**counts)))
    (place / "rows").mkdir()
    (place / "rows" / "main.csv").write_bytes(rows.write(sources.collect(runs)))


def make_page(place: Path) -> None:
    """Write the same rows, and a page with room for all tables."""
    make_rows(place)
    parts = [part for part in paper.PARTS if part != "policies"]
    (place / "page.md").write_text("".join(f"<!-- {name} -->\nold\n<!-- end -->\n" for name in (*parts, "claims", "missing")))


TINY_STUDY = """
environment = ["navigation"]
algorithm = ["expert", "constraint"]
num_robots = 2
num_humans = 2
num_steps = 6
num_demonstrations = 128
pretraining_steps = 2
hidden_sizes = [8]
"""

IMPERFECT = """
[[runs]]

[[runs]]
takeover_time = [2.0, 5.0]

[[runs]]
link_model = "unequal"
"""

CASES = {
    "benchmarks/console.py": Case(("--pages 3 --ticks 10 --robots 4",), (row("3", r"\d+", r"[\d.]+", r"[\d.]+"),)),
    "benchmarks/fleet_step.py": Case(
        (f"humanoid --steps 2 --repeats 1 -- {FLEET}",), (row("humanoid", r"\d+ %", r"[\d.]+", r"[\d.]+"),)
    ),
    "benchmarks/gradients.py": Case(
        (f"--lengths 4 9 --num-samples 2 --repeats 1 -- {FLEET} --algorithm weighted",),
        (
            row("4", r"[\d.]+", r"[\d.]+", r"[\d.]+", r"\d+", r"\d+"),
            row("9", r"[\d.]+", r"[\d.]+", r"[\d.]+", r"\d+", r"\d+"),
            row("4", r"[\d,.]+", r"[\d,.]+", r"[\d.]+"),
        ),
        pace="long",
    ),
    "benchmarks/large.py": Case(
        (f"--num-steps 2 -- {FLEET}",),
        (row("navigation", r"\d+", r"[\d,]+", r"[\d.]+", r"-?[\d,]+", r"[\d,]+"), row("8", r"\d+", r"[\d.]+", r"[\d.]+")),
        pace="long",
    ),
    "benchmarks/physics.py": Case(
        ("humanoid --num-robots 4 --backends native --repeats 1",),
        (row("humanoid", "4", "raw rollout", r"[\d,]+", "1.00"), row("humanoid", "4", "native", r"[\d,]+", r"[\d.]+")),
    ),
    "benchmarks/profile_step.py": Case(
        (f"navigation --steps 2 --repeats 1 --trace trace -- {FLEET}",),
        (row("navigation", r"\w+", r"\d+", *[r"\d+\.\d\d"] * 8),),
        pace="long",
    ),
    "benchmarks/scaling.py": Case(
        ("--environments navigation --num-robots 2 --num-seeds 1 --largest-navigation 10",),
        (row("navigation", "10", r"[\d.]+"), row("2", "1", r"[\d.]+", "1.00"), row("x10", r"[\d.]+"), row("navigation", "1")),
        pace="long",
    ),
    "benchmarks/soak.py": Case(
        (f"--kills 1 --checkpoint-every 20 -- {FLEET} --num-steps 1000",),
        (r"^\d+ rounds, [1-9]\d* kills survived, \d+ starts from t > 0, \d+ timesteps lost in all$", "^results differing: 0$"),
        pace="long",
    ),
    "benchmarks/startup.py": Case(
        (f"--environments navigation --run-steps 4 -- {FLEET}",),
        (row("navigation", *[r"\d+\.\d+"] * 4),),
        pace="long",
    ),
    "benchmarks/sweep.py": Case(
        (f"--seeds 2 -- {FLEET} --algorithm constraint --extra-demonstrations 0 --num-steps 4",),
        (row("1", r"\d+", r"[\d.]+", r"[\d.]+", "1.00"), row(r"\d+", "1", r"[\d.]+", r"[\d.]+", r"[\d.]+")),
        pace="long",
    ),
    "experiments/beat_cur.py": Case(
        (
            f"humanoid --variants random-half,risk-last --until 4 -- {FLEET}",
            f"humanoid --variants {','.join(CHANGED)} -- {FLEET} --teaching-time 4 --price 0.1",
        ),
        tuple(row("humanoid", name, *[r"\d+"] * 4) for name in ("random-half", "risk-last", *CHANGED)),
        pace="long",
    ),
    "experiments/claims.py": Case(
        ("--results rows", "--results rows --output claims.md"),
        (
            row("Humanoid: C.U.R. has the most successes", "holds", r"C.U.R. - \w+", "400, 400 to 400", "5"),
            row("Humanoid: C.U.R. has the fewest violations", "does not hold", "Constraint - C.U.R.", "-80, -80 to -80", "5"),
            row("the return of C.U.R. is up to 8.8 times a baseline's", r"[\w ]+", r"C.U.R. - 8.8 x \w+"),
            row("ANYmal: C.U.R. has the most successes", "not run yet", "", "", ""),
        ),
        ("claims.md",),
        make_rows,
    ),
    "experiments/clone_error.py": Case(
        ("humanoid --demonstrations 256 --fresh 100 --gradient-steps 2",),
        (row("observation", "256", *[r"\d\.\d{4}"] * 3, r"\d+"), r"variance of the expert's actions \| +\| 0\.\d+"),
        pace="long",
    ),
    "experiments/gradient_check.py": Case(
        (f"--seeds 1 --num-samples 2 --fresh 2 --lengths 4 --differences 4 --output check.png -- {FLEET} --num-steps 4",),
        (
            row("4", "none", r"\d+", r".+", r".+"),
            row("risk_weight", r"-?[\d.]+", r"(nan|[\d.]+)"),
            row("0.01", r"-?[\w.]+", r"\d of 5"),
            row("the smoothed gradient", r"[\d.]+", r"[\d.]+", r"-?[\d.]+", r"-?[\d.]+ to -?[\d.]+"),
            row("4", r"[\d.e+-]+", r"[\d.e+-]+"),
        ),
        ("check.png",),
        pace="long",
    ),
    "experiments/human_time.py": Case(
        ("run-0 run-1",),
        (r"^run-1: \d+ of 80 human timesteps, [\d.]+ %$", r"^mean \d+; .* random_threshold 0\.\d{5}$"),
        prepare=make_runs,
        pace=None,
    ),
    "experiments/leaderboard.py": Case(
        (
            "navigation --algorithms longest_waiting --budgets 2500 --seeds 1 --output runs --results rows",
            "navigation --algorithms longest_waiting --budgets 2500 --seeds 2 --output runs --results rows",
            "--rows-only --results rows",
        ),
        (r"^rows/leaderboard\.md$",),
        ("rows/leaderboard.csv", "rows/leaderboard.json", "rows/leaderboard.md", "rows/leaderboard.png"),
    ),
    "experiments/page.py": Case(
        ("page.md --results rows",),
        (r"^page\.md$",),
        ("page.md",),
        make_page,
    ),
    "experiments/paper.py": Case(
        (
            "main policies --studies . --workers 1 --output runs --results rows",
            "main policies --studies . --output elsewhere --results rows",
            "policies --studies . --workers 1 --output elsewhere --results again",
            "main policies --studies . --results rows --rows-only",
        ),
        (
            r"^2 runs finished",
            r"^navigation-constraint-seed0: \d+ successes$",
            r"^2 policies have no run folder in elsewhere/main: they are trained again$",
            r"^rows/policies\.md$",
        ),
        ("rows/main.csv", "rows/main.md", "rows/main.png", "rows/policies.csv", "again/policies.csv", "runs/main/sweep.json"),
        lambda place: (place / "main.toml").write_text(TINY_STUDY) and None,
        pace="long",
    ),
    "experiments/people.py": Case(
        (
            "navigation --studies . --workers 1 --output runs --results rows",
            "navigation --studies . --results rows --rows-only",
        ),
        (r"^rows/people_navigation\.md$",),
        ("rows/people_navigation.csv", "rows/people_navigation.md", "rows/people_navigation.png"),
        lambda place: (place / "people_navigation.toml").write_text(TINY_STUDY + IMPERFECT) and None,
        pace="long",
    ),
    "experiments/settle_cubes.py": Case(
        ("--number 4 --output settled.npz",), (r"^\d+ of \d+ cubes came to rest near the goal$",), ("settled.npz",), pace=None
    ),
    "experiments/train_expert.py": Case(
        (
            f"humanoid --output expert --num-timesteps 64 --evaluate-every 64 --settings {PPO}",
            "humanoid --output expert --ship --weights weights --candidates 1 --num-episodes 2",
        ),
        (r"^\{'steps': 64, ", r"^shipped \{'environment': 'humanoid', 'steps': 64, 'num_episodes': 2"),
        ("expert/curve.csv", "expert/checkpoint_0000000064.msgpack", *(f"weights/humanoid{x}" for x in (".npz", "_curve.csv"))),
    ),
    "experiments/tuning_check.py": Case(
        (f"--steps 1 --seeds 2 --num-samples 2 --fresh 2 -- {FLEET}",),
        (
            r"^objective before each step: [\d.]+$",
            r"^grid: 3 points, the best with a mean of [\d.]+$",
            row("best of the grid", *[r"[\d.]+"] * 6, r"-?[\d.]+", r"-?[\d.]+ to -?[\d.]+"),
        ),
        pace="long",
    ),
    "experiments/which_part.py": Case(
        (
            f"navigation --seeds 2 --removals 1 --num-samples 2 --rows rows.csv -- {FLEET}",
            f"navigation --rows rows.csv --seeds 2 --removals 2 -- {FLEET}",
        ),
        (
            r"^navigation: removed, seed 0\nnavigation: derivative, seed 0\nnavigation: derivative, seed 1\n\| environment",
            r"^navigation: removed, seed 1\n\| environment",
            row("navigation", "uncertainty", *[r"[-\d.]+ \([-\d.]+ to [-\d.]+\)"] * 3),
        ),
        ("rows.csv",),
        pace="long",
    ),
}


def repository() -> dict[str, int]:
    """Return when the files that scripts could write were changed last."""
    parts = [ROOT / part for part in ("benchmarks", "experiments", "fleetjax")]
    paths = [path for part in parts for path in part.rglob("*") if path.is_file() and path.parent.name != "__pycache__"]
    return {str(path): path.stat().st_mtime_ns for path in [*paths, *ROOT.glob("*")] if path.is_file()}


def test_every_script_has_its_case():
    assert list(CASES) == SCRIPTS


@pytest.mark.parametrize(
    "script",
    [pytest.param(script, marks=[getattr(pytest.mark, case.pace)] if case.pace else []) for script, case in CASES.items()],
)
def test_a_script_runs_and_gives_what_it_should(script, tmp_path):
    case, before, printed = CASES[script], repository(), ""
    case.prepare(tmp_path)
    for arguments in case.commands:
        command = [sys.executable, ROOT / script, *shlex.split(arguments)]
        quick = os.environ | environment()
        done = subprocess.run(command, cwd=tmp_path, env=quick, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        printed += done.stdout
    for pattern in case.prints:
        assert re.search(pattern, printed, re.MULTILINE), printed
    for name in case.writes:
        assert (tmp_path / name).stat().st_size > 0
    assert repository() == before

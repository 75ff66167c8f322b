"""What is committed of the study: its tables are those of its rows."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import claims
import numpy as np
import page
import paper
import people
import pytest
from commands import make_metrics

import fleetjax
from fleetjax.io import leaderboard, rows, sources, standings
from fleetjax.io.outcomes import group

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
IMPERFECT = [f"people_{name}" for name in people.ENVIRONMENTS]
PARTS = [name for name in paper.PARTS if (RESULTS / f"{name}.csv").exists()]


@pytest.fixture(scope="module")
def remade(tmp_path_factory):
    """The folder in which tables and figures of all parts were made anew from copies of their rows."""
    folder = tmp_path_factory.mktemp("results")
    for part in PARTS:
        shutil.copy(RESULTS / f"{part}.csv", folder)
    command = [sys.executable, ROOT / "experiments" / "paper.py", *PARTS, "--rows-only", "--results", folder]
    subprocess.run(command, check=True, capture_output=True)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_tables_are_those_of_the_rows(part, remade):
    assert (remade / f"{part}.md").read_text() == (RESULTS / f"{part}.md").read_text()
    if part != "policies":
        assert (remade / f"{part}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_table_of_the_leaderboard_is_that_of_its_rows():
    assert standings.table(leaderboard.Store(RESULTS)) == (RESULTS / "leaderboard.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("part", IMPERFECT)
def test_tables_of_imperfect_people_are_those_of_their_rows(part):
    assert people.table(page.groups(RESULTS, part)) == (RESULTS / f"{part}.md").read_text()


def test_shares_are_over_the_seeds_that_both_have():
    """The rule keeps half of its successes, seed by seed; a seed that only perfect people have makes no difference."""
    runs = []
    for seed in range(5):
        config = fleetjax.make_config("navigation", "cur", num_steps=40)
        metrics = make_metrics(0, 40)._replace(successes=np.full(40, 10 * (seed + 1)))
        runs.append((config, seed, metrics))
        if seed < 3:
            runs.append((config.replace(action_noise=0.5), seed, metrics._replace(successes=metrics.successes // 2)))
    (line,) = [line for line in people.table(group(sources.collect(runs))).splitlines() if "action noise" in line]
    assert "400 (200 to 600) (3 seeds), 50 %;" in line


@pytest.mark.parametrize("part", [*PARTS, *IMPERFECT, "leaderboard"])
def test_rows_are_those_of_whole_runs(part):
    for run in rows.read(RESULTS / f"{part}.csv"):
        assert run.timesteps[-1] == run.config.num_steps
        assert run.processor
        assert run.versions["fleetjax"]


@pytest.mark.slow
@pytest.mark.parametrize("name", page.PAGES)
def test_a_page_shows_the_stored_rows(name, tmp_path):
    shown = (ROOT / "docs" / f"{name}.md").read_text()
    without = re.sub(r"(?s)(<!-- (\w+) -->\n).*?(<!-- end -->)", r"\1\3", shown)
    assert without != shown
    (tmp_path / "page.md").write_text(without)
    subprocess.run([sys.executable, ROOT / "experiments" / "page.py", tmp_path / "page.md"], check=True)
    assert (tmp_path / "page.md").read_text() == shown


def test_the_page_of_results_has_every_table():
    names = re.findall(r"<!-- (\w+) -->", (ROOT / "docs" / "results.md").read_text())
    elsewhere = {"policies", "teaching", "trained_early"}
    assert set(names) == {*paper.PARTS, "claims", "missing", "end"} - elsewhere


@pytest.mark.parametrize(("seeds", "verdict"), [(0, "not run yet"), (1, "not run yet"), (2, "holds")])
def test_a_pair_that_shares_one_seed_decides_nothing(tmp_path, seeds, verdict):
    """C.U.R. has ten times the successes of Random, which has the first `seeds` of its seeds."""
    runs = []
    for algorithm, number in (("cur", 3), ("random", seeds)):
        config = fleetjax.make_config("humanoid", algorithm, num_steps=40)
        for seed in range(number):
            metrics = make_metrics(seed, 40)
            runs.append((config, seed, metrics._replace(successes=metrics.successes * (10 if algorithm == "cur" else 1))))
    (tmp_path / "main.csv").write_bytes(rows.write(sources.collect(runs)))
    one, other = ({"environment": "humanoid", "algorithm": name} for name in ("cur", "random"))
    claim = claims.Claim("humanoid", "more successes", "main", lambda run: float(run.metrics.successes.sum()), [(one, other)])
    found, difference = claims.judge(claims.Study(tmp_path), claim)
    assert found == verdict
    assert (difference is None) == (seeds < 2)

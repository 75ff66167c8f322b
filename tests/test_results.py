"""What is committed of the study: its tables are those of its rows."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import paper
import pytest

from fleetjax.io import rows

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
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


@pytest.mark.parametrize("part", PARTS)
def test_rows_are_those_of_whole_runs(part):
    for run in rows.read(RESULTS / f"{part}.csv"):
        assert run.timesteps[-1] == run.config.num_steps
        assert run.processor
        assert run.versions["fleetjax"]


@pytest.mark.slow
def test_the_page_shows_the_stored_rows(tmp_path):
    page = ROOT / "docs" / "results.md"
    without = re.sub(r"(?s)(<!-- (\w+) -->\n).*?(<!-- end -->)", r"\1\3", page.read_text())
    (tmp_path / "results.md").write_text(without)
    subprocess.run([sys.executable, ROOT / "experiments" / "page.py", "--page", tmp_path / "results.md"], check=True)
    assert without.count("<!-- end -->") == len(PARTS) + 1  # policies stand in main's table; verdicts; what is missing
    assert (tmp_path / "results.md").read_text() == page.read_text()

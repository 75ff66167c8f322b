"""The notebooks: they run (at a small size, among the slow tests), and what is committed is what a full run printed."""

import re
import shutil
from pathlib import Path

import nbformat
import pytest
from compiling import environment
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "experiments" / "notebooks"
NAMES = sorted(path.name for path in FOLDER.glob("*.ipynb"))
LONG = "which_part_matters.ipynb"  # minutes even at a small size
SMALL = {"NUM_STEPS": 12, "NUM_SEEDS": 2, "NUM_SAMPLES": 2, "TUNING_STEPS": 1, "FILM_STEPS": 6}  # of the cell `parameters`


@pytest.fixture(params=NAMES)
def notebook(request):
    return nbformat.read(FOLDER / request.param, 4)


def parameters(notebook):
    (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    return cell


def test_there_are_notebooks():
    assert {"first_fleet.ipynb", "which_part_matters.ipynb", "your_own_rule.ipynb"} <= set(NAMES)


def test_a_notebook_says_first_what_one_will_learn(notebook):
    assert notebook.cells[0].cell_type == "markdown"
    assert "You will learn" in notebook.cells[0].source


def test_outputs_are_those_of_one_run_from_top_to_bottom(notebook):
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    kinds = [output.output_type for cell in code for output in cell.outputs]
    assert "error" not in kinds
    assert any("image/png" in output.get("data", {}) for cell in code for output in cell.outputs)
    assert not re.search(r"/(home|tmp|work|root)/", nbformat.writes(notebook))


def test_files_that_notebooks_link_to_exist(notebook):
    for cell in notebook.cells:
        for target in re.findall(r"\]\(([^):#]+)\)", cell.source if cell.cell_type == "markdown" else ""):
            assert (FOLDER / target).exists(), target


@pytest.mark.slow
@pytest.mark.parametrize("notebook", [pytest.param(x, marks=[pytest.mark.long] * (x == LONG)) for x in NAMES], indirect=True)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    cell = parameters(notebook)
    cell.source = re.sub(r"^(\w+) = .*$", lambda found: f"{found[1]} = {SMALL[found[1]]}", cell.source, flags=re.MULTILINE)
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    for rows in FOLDER.glob("*.csv"):
        shutil.copy(rows, tmp_path)
    options = {"timeout": 600, "startup_timeout": 600, "resources": {"metadata": {"path": tmp_path}}}
    NotebookClient(notebook, kernel_name="python3", **options).execute()

"""Algorithms of the form MODULE:NAME, from modules of users."""

import itertools
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from commands import TINY, make_metrics, refused

import fleetjax
from fleetjax import cli, field, priority
from fleetjax.io import folder, leaderboard, plain, rows, sources, study

RULES = """
import jax.numpy as jnp
import fleetjax

ONE = jnp.ones(())

def make_mine(config):
    def score(signals, aux, key):
        return jnp.where(signals.violation, ONE, config.parameters["zeal_rate"] * signals.uncertainty), aux
    return fleetjax.Priority(tuple, score)

mine = fleetjax.Algorithm(make_mine, parameters={"zeal_rate": fleetjax.Field("zeal", high=1, default=0.5)})
"""
_numbers = itertools.count()


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A function that writes a module of a new name below a new folder on the path, and returns that name."""
    place = tmp_path / "modules"
    place.mkdir()
    monkeypatch.syspath_prepend(place)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(place), os.environ.get("PYTHONPATH", "")]))

    def write(content):
        name = f"rules_{next(_numbers)}"
        (place / f"{name}.py").write_text(content)
        return name

    return write


def test_a_rule_of_a_module_has_its_parameters(module):
    name = f"{module(RULES)}:mine"
    config = fleetjax.make_config("navigation", name, zeal_rate=0.25)
    assert (config.algorithm, config.parameters["zeal_rate"]) == (name, 0.25)
    assert plain.to_plain(plain.from_plain(plain.to_plain(config))) == plain.to_plain(config)
    assert field.owners("zeal_rate") == (name,)


def test_two_modules_may_use_the_same_name(module):
    first, second = module(RULES), module(RULES.replace("0.5", "0.75"))
    zeal = [fleetjax.make_config("navigation", f"{one}:mine").parameters["zeal_rate"] for one in (first, second)]
    assert zeal == [0.5, 0.75]
    with pytest.raises(ValueError, match="algorithm = 'mine' is unknown"):
        fleetjax.make_config("navigation", "mine")


def test_a_module_may_be_imported_during_a_trace(module):
    name = f"{module(RULES)}:mine"
    scores = jax.jit(lambda: priority.get_algorithm(name).parameters["zeal_rate"].default)()
    assert scores == 0.5
    assert not isinstance(sys.modules[name.split(":")[0]].ONE, jax.core.Tracer)


def test_a_rule_of_a_module_runs_from_the_command_line(module, tmp_path, monkeypatch):
    name, output = f"{module(RULES)}:mine", tmp_path / "run"
    command = ["run", "navigation", *TINY, "--zeal-rate", "0.25"]
    assert cli.main([*command, "--algorithm", name, "--output", str(output)]) == 0
    assert json.loads((output / "config.json").read_text())["config"]["algorithm"] == name
    found = sources.collect(output)[0]
    assert found.config.parameters["zeal_rate"] == 0.25
    again = jax.jit(fleetjax.run)(found.config, jax.random.key(0)).metrics
    np.testing.assert_array_equal(found.metrics.human_steps, again.human_steps)
    assert ":" not in folder.default_folder(found.config, 0).name
    printed = subprocess.run(
        [sys.executable, "-m", "fleetjax", "compare", output, "--rows", tmp_path / "rows.csv"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert name in printed.stdout
    assert plain.to_plain(rows.read(tmp_path / "rows.csv")[0].config) == plain.to_plain(found.config)


def test_processes_of_a_sweep_import_the_module(module, tmp_path):
    name, file, output = f"{module(RULES)}:mine", tmp_path / "study.toml", tmp_path / "sweep"
    file.write_text(f'environment = "navigation"\nalgorithm = ["cur", "{name}"]\n[[runs]]\nzeal_rate = [0.1, 0.3]\n')
    runs = study.plan(study.make_study([str(file)], {"output": str(output)}))
    assert [run.config.algorithm for run in runs] == ["cur", name, name]
    assert not any(":" in run.folder.name for run in runs)
    command = ["sweep", "navigation", *TINY, "--algorithm", f"random, {name}", "--workers", "2", "--output", str(output)]
    assert cli.main(command) == 0
    assert {one.config.algorithm for one in sources.collect(output)} == {"random", name}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "algorithm = 'NAME': there is no module nowhere; add the folder that holds it to PYTHONPATH"),
        ("import os\n1 / 0", "'NAME': importing the module failed: ZeroDivisionError: division by zero (MODULE.py, line 2)"),
        ("import nothing_here", "No module named 'nothing_here' (MODULE.py, line 1)"),
        ("def broken(:", "importing the module failed: SyntaxError: invalid syntax (MODULE.py, line 1)"),
        ("raise SystemExit(0)", "importing the module failed: SystemExit: 0 (MODULE.py, line 1)"),
        (RULES.replace("mine =", "others ="), "module MODULE has no fleetjax.Algorithm named 'mine'; it has MODULE:others"),
        (RULES.replace("mine =", "mine ,="), "importing the module failed: TypeError: "),
        ("mine = 3", "has no fleetjax.Algorithm named 'mine'; define mine = fleetjax.Algorithm(...) there"),
        (RULES.replace("zeal_rate", "batch_size"), "parameter 'batch_size' of 'NAME' is a field of Config already"),
    ],
)
def test_what_a_module_lacks_is_refused(module, capsys, tmp_path, content, reason):
    name = "nowhere" if content is None else module(content)
    reason = reason.replace("MODULE", name).replace("NAME", f"{name}:mine")
    with pytest.raises(ValueError, match=r"rules_|nowhere") as found:
        fleetjax.make_config("navigation", f"{name}:mine")
    assert reason in str(found.value)
    output = tmp_path / "run"
    for option in (["--algorithm", f"{name}:mine"], [f"--algorithm={name}:mine"]):
        assert reason in refused(capsys, "run", "navigation", *TINY, *option, "--output", output)
    assert not output.exists()


@pytest.mark.parametrize("name", ["a b:mine", ":mine", "..:mine", "os;x:mine", "a::mine", "os:", "os:a.b", "https://a.b:mine"])
def test_what_is_no_name_of_a_module_is_not_imported(name, monkeypatch):
    monkeypatch.setattr("importlib.import_module", lambda module: pytest.fail(f"{module} is imported"))
    with pytest.raises(ValueError, match="must have the form MODULE:NAME"):
        priority.get_algorithm(name)


def test_stored_rules_whose_module_is_gone_can_be_removed(module, tmp_path, capsys, monkeypatch):
    names = [f"{module(RULES)}:mine" for _ in range(2)]
    store = leaderboard.Store(tmp_path)
    for algorithm in ("cur", *names):
        config = fleetjax.make_config("navigation", algorithm, initial_period=0, num_steps=40)
        runs = sources.collect([(config, seed, make_metrics(seed, 40)) for seed in range(2)])
        threshold = ("uncertainty_threshold", float(config.uncertainty_threshold))
        store.add(leaderboard.Place("navigation", algorithm, 5000, *threshold, 5000.0, solved=True), runs)
    assert [run.config.algorithm for run in leaderboard.Store(tmp_path).runs[::2]] == ["cur", *names]
    assert cli.main(["leaderboard", "show", "--results", str(tmp_path)]) == 0
    assert all(name in (tmp_path / "leaderboard.md").read_text() for name in names)
    for name in names:
        gone, *_ = name.split(":")
        monkeypatch.delitem(sys.modules, gone)
        (tmp_path / "modules" / f"{gone}.py").unlink()
        priority.ALGORITHMS.entries.pop(name)
    stored = {path.name: path.read_bytes() for path in tmp_path.glob("leaderboard.*")}
    capsys.readouterr()
    lost = f"row 3: algorithm = '{names[0]}': there is no module"
    assert lost in refused(capsys, "leaderboard", "show", "--results", tmp_path)
    assert "nothing is stored of 'mine'" in refused(capsys, "leaderboard", "remove", "mine", "--results", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("leaderboard.*")} == stored
    assert cli.main(["leaderboard", "remove", names[0], "--results", str(tmp_path)]) == 2  # the other one is still there
    assert f"row 3: algorithm = '{names[1]}': there is no module" in capsys.readouterr().err
    assert cli.main(["leaderboard", "remove", names[1], "--results", str(tmp_path)]) == 0
    assert {run.config.algorithm for run in rows.read(tmp_path / "leaderboard.csv")} == {"cur"}
    assert "mine" not in (tmp_path / "leaderboard.md").read_text()
    again = leaderboard.Store(tmp_path)
    assert rows.write(again.runs) == rows.write(store.runs[:2])


def test_folders_of_a_rule_of_a_module_have_no_colon(module, tmp_path):
    (entry,) = leaderboard.entries([f"{module(RULES)}:mine"], ["navigation"], (5000,), 1, tmp_path)
    assert ":" not in str(entry.folder.relative_to(tmp_path))
    assert entry.requests[None].field == "zeal_rate"

"""Names of the form MODULE:NAME: what a module registers is found wherever a registered name is."""

import itertools
import json
import sys

import jax
import numpy as np
import pytest
from commands import TINY, make_metrics, refused

import fleetjax
from fleetjax import cli, envs, field, priority, registry, supervisors
from fleetjax.io import leaderboard, plain, rows, sources, study

RULES = """
import jax.numpy as jnp
import fleetjax

def make_mine(config):
    def score(signals, aux, key):
        return jnp.where(signals.violation, 1.0, config.parameters["zeal_rate"] * signals.uncertainty), aux
    return fleetjax.Priority(tuple, score)

zeal = fleetjax.Field("zeal", high=1, default=0.5)
fleetjax.register_priority("mine", make_mine, estimators=(), parameters={"zeal_rate": zeal})
"""
WORLD = """
import fleetjax
from fleetjax.envs import navigation
DEFAULTS = {"num_robots": 3, "num_humans": 1, "random_threshold": 0.7}
fleetjax.register_env("world", lambda backend: navigation.make_env(), defaults=DEFAULTS)
"""
_numbers = itertools.count()


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A function that writes a module of a new name below a new folder on the path, and returns that name."""
    for known in (envs.ENVIRONMENTS, priority.ALGORITHMS, supervisors.SUPERVISORS):
        monkeypatch.setattr(known, "entries", dict(known.entries))
    before = dict(field.PARAMETERS)
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)

    def write(content):
        name = f"others_{next(_numbers)}"
        (folder / f"{name}.py").write_text(content)
        return name

    yield write
    field.PARAMETERS.clear()
    field.PARAMETERS.update(before)


def test_a_rule_of_a_module_runs_from_python(module):
    name = f"{module(RULES)}:mine"
    config = fleetjax.make_config("navigation", name, zeal_rate=0.25, num_robots=4, num_humans=2, num_steps=3)
    assert (config.algorithm, config.parameters["zeal_rate"]) == (name, 0.25)
    assert priority.get_algorithm(name) is priority.get_algorithm("mine")
    assert plain.to_plain(plain.from_plain(plain.to_plain(config))) == plain.to_plain(config)


def test_a_rule_of_a_module_runs_from_the_command_line(module, tmp_path, monkeypatch, capsys):
    name, output = f"{module(RULES)}:mine", tmp_path / "run"
    command = ["run", "navigation", *TINY, "--zeal-rate", "0.25", "--output", str(output)]
    assert cli.main([*command, "--algorithm", name]) == 0
    assert json.loads((output / "config.json").read_text())["config"]["algorithm"] == name
    assert cli.main(["evaluate", str(output), "--num-steps", "3"]) == 0
    capsys.readouterr()
    found = sources.collect(output)[0]
    assert found.config.parameters["zeal_rate"] == 0.25
    again = jax.jit(fleetjax.run)(found.config, jax.random.key(0)).metrics
    np.testing.assert_array_equal(found.metrics.human_steps, again.human_steps)
    monkeypatch.chdir(tmp_path)
    assert cli.main([*command[:-2], f"--algorithm={name}"]) == 0
    (made,) = (tmp_path / "runs").iterdir()
    assert ":" not in made.name


def test_sweeps_take_parameters_of_a_module(module, tmp_path):
    name = f"{module(RULES)}:mine"
    file = tmp_path / "study.toml"
    file.write_text(f'environment = "navigation"\nalgorithm = ["cur", "{name}"]\n[[runs]]\nzeal_rate = [0.1, 0.3]\n')
    runs = study.plan(study.make_study([str(file)], {"output": str(tmp_path / "sweep")}))
    assert [run.config.algorithm for run in runs] == ["cur", name, name]
    assert not any(":" in run.folder.name for run in runs)


def test_an_environment_of_a_module_has_its_defaults(module):
    config = fleetjax.make_config(f"{module(WORLD)}:world", "random")
    assert (config.num_robots, config.num_humans, config.parameters["random_threshold"]) == (3, 1, np.float32(0.7))
    assert envs.make(config.environment, "auto").spec.name == "navigation"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "its module cannot be imported: ModuleNotFoundError: No module named 'nowhere'; is its folder on PYTHONPATH?"),
        ("1 / 0", "its module cannot be imported: ZeroDivisionError: division by zero"),
        ("def broken(:", "its module cannot be imported: SyntaxError: "),
        (RULES.replace('"mine"', '"others"'), "algorithm = 'MODULE:mine' is unknown; the closest are others"),
    ],
)
def test_what_a_module_lacks_is_refused(module, capsys, tmp_path, content, reason):
    name = "nowhere" if content is None else module(content)
    reason = reason.replace("MODULE", name)
    with pytest.raises(ValueError, match=r"cannot be imported|is unknown") as found:
        fleetjax.make_config("navigation", f"{name}:mine")
    assert reason in str(found.value)
    output = tmp_path / "run"
    for option in (["--algorithm", f"{name}:mine"], [f"--algorithm={name}:mine"]):
        assert reason in refused(capsys, "run", "navigation", *TINY, *option, "--output", output)
    assert not output.exists()


@pytest.mark.parametrize("name", ["a b:mine", ":mine", "..:mine", "os;x:mine", "a::mine"])
def test_what_is_no_name_of_a_module_is_not_imported(name):
    before = set(sys.modules)
    with pytest.raises(ValueError, match="is not the name of a module"):
        registry.load(name)
    assert set(sys.modules) == before


def test_stored_rules_that_can_no_longer_be_imported_can_be_removed(module, tmp_path, capsys, monkeypatch):
    name = f"{module(RULES)}:mine"
    store = leaderboard.Store(tmp_path)
    for algorithm in ("cur", name):
        config = fleetjax.make_config("navigation", algorithm, initial_period=0, num_steps=40)
        runs = sources.collect([(config, seed, make_metrics(seed, 40)) for seed in range(2)])
        threshold = float(config.uncertainty_threshold)
        store.add(
            leaderboard.Place("navigation", algorithm, 5000, "uncertainty_threshold", threshold, 5000.0, solved=True), runs
        )
    assert {run.config.algorithm for run in leaderboard.Store(tmp_path).runs} == {"cur", name}
    assert cli.main(["leaderboard", "show", "--results", str(tmp_path)]) == 0
    assert name in (tmp_path / "leaderboard.md").read_text()
    gone, *_ = name.split(":")
    monkeypatch.delitem(sys.modules, gone)
    (tmp_path / "modules" / f"{gone}.py").unlink()
    priority.ALGORITHMS.entries.pop("mine")
    capsys.readouterr()
    stored = {path.name: path.read_bytes() for path in tmp_path.glob("leaderboard.*")}
    assert f"row 3: {name}: its module cannot be imported" in refused(capsys, "leaderboard", "show", "--results", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("leaderboard.*")} == stored
    assert cli.main(["leaderboard", "remove", name, "--results", str(tmp_path)]) == 0
    assert {run.config.algorithm for run in rows.read(tmp_path / "leaderboard.csv")} == {"cur"}
    assert "mine" not in (tmp_path / "leaderboard.md").read_text()

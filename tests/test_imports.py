"""Which modules need which: no two need each other, and help needs no JAX."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import fleetjax

PACKAGE = Path(fleetjax.__file__).parent
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}


def needs(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, within functions as well."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in MODULES else str(node.module) for name in found}
    return names & set(MODULES)


def test_no_modules_need_each_other():
    graph = {name: needs(path) for name, path in MODULES.items() if name != "fleetjax"}  # which gathers the public names
    assert sum(map(len, graph.values())) > 100
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, with the cycle


def run_fresh(program: str) -> str:
    """Return what a program prints in a process of its own."""
    return subprocess.run([sys.executable, "-c", program], check=True, text=True, capture_output=True).stdout


@pytest.mark.parametrize(
    "command", ["--help", "--version", "run --help", "run humanoid --help", "sweep --help", "run navigation --num-robot 4", ""]
)
def test_help_and_refused_flags_load_no_jax(command):
    program = f"""
import sys
from fleetjax.cli import main
try:
    code = main({command.split()})
except SystemExit as stop:
    code = stop.code
print(code, sorted({{"jax", "numpy", "mujoco", "matplotlib"}} & set(sys.modules)))"""
    assert run_fresh(program).splitlines()[-1] == f"{2 if '--num-robot' in command else 0} []"


def test_public_names_are_there_in_a_fresh_process():
    """Whichever comes first: `fleetjax.run` is the function even where a module that needs it was imported before."""
    assert run_fresh("import sys, fleetjax; print('jax' in sys.modules, callable(fleetjax.run), 'run' in dir(fleetjax))") == (
        "False True True\n"
    )
    program = (
        "import fleetjax.io.commands, fleetjax; from fleetjax import *; "
        "print(run is fleetjax.run, callable(run), envs.__name__)"
    )
    assert run_fresh(program) == "True True fleetjax.envs\n"


def test_every_public_name_is_found():
    assert set(fleetjax.__all__) <= set(dir(fleetjax))
    assert {name for name in fleetjax.__all__ if not callable(getattr(fleetjax, name))} == {"envs"}
    with pytest.raises(AttributeError, match="module 'fleetjax' has no attribute 'rnu'"):
        fleetjax.rnu  # noqa: B018

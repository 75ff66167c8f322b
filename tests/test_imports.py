"""Which modules need which: no two need each other."""

import ast
import graphlib
from pathlib import Path

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

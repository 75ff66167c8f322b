"""What the pages promise holds: their Python blocks run, in order, commands and files that they name exist, and the API
reference is complete. So do the examples in docstrings.
"""

import doctest
import importlib
import pkgutil
import re
import shlex
import sys
import types
from pathlib import Path

import jax
import pytest

import fleetjax
from fleetjax.io import flags

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TEXTS = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for path in [*ROOT.glob("*.md"), *DOCS.rglob("*.md"), ROOT / "benchmarks" / "README.md"]
}
PAGES = [name for name, text in TEXTS.items() if "```python" in text]
SMALL = {
    "num_robots": 4,
    "num_humans": 2,
    "num_steps": 3,
    "ensemble_size": 2,
    "hidden_sizes": (8,),
    "batch_size": 8,
    "critic_capacity": 100,
    "num_demonstrations": 20,
    "pretraining_steps": 2,
    "critic_pretraining_steps": 2,
    "num_critic_transitions": 20,
}


def blocks(text: str) -> str:
    """Return a page with all but its Python blocks blanked out, so that errors name the page's lines."""
    kept = [""] * (text.count("\n") + 1)
    for match in re.finditer(r"```python\n(.*?)```", text, re.DOTALL):
        first = text[: match.start(1)].count("\n")
        for i, line in enumerate(match.group(1).splitlines()):
            kept[first + i] = line
    return "\n".join(kept)


def commands(text: str) -> list[str]:
    """Return the fleetjax commands of a page: those in blocks, and those with flags in sentences, with values filled in."""
    shell = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL))
    found = re.findall(r"(?:^|&& |do )(fleetjax [^#;\n]*)", shell, re.MULTILINE) + re.findall(
        r"`(fleetjax [^`]* --[^`]*)`", text
    )
    filled = [re.sub(r"\b(?:ENV|ROBOT)\b", "humanoid", command) for command in found if "--help" not in command]
    return [re.sub(r"\$seed|\b[NS]\b", "1", command) for command in filled]


@pytest.fixture
def small_fleets(monkeypatch):
    """Let pages run small fleets where they do not ask for a size."""
    make_config = fleetjax.make_config
    monkeypatch.setattr(fleetjax, "make_config", lambda *names, **fields: make_config(*names, **SMALL | fields))


@pytest.fixture
def quick_compilation():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


def run_page(name: str) -> dict:
    names = {}
    exec(compile(blocks(TEXTS[name]), name, "exec"), names)
    return names


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_custom_page_runs(capsys):
    metrics = run_page("docs/custom.md")["result"].metrics
    assert metrics.successes.sum() > 0
    assert metrics.hard_resets.sum() > 0
    assert "brax/inverted_pendulum" in capsys.readouterr().out


@pytest.mark.usefixtures("quick_compilation", "small_fleets")
@pytest.mark.parametrize("name", [pytest.param(p, marks=pytest.mark.slow) for p in PAGES if p != "docs/custom.md"])
def test_other_pages_run(name):
    assert run_page(name)


def test_there_are_pages():
    assert {"README.md", "docs/guide.md", "docs/custom.md"} <= set(PAGES)


@pytest.mark.slow
def test_examples_in_docstrings():
    names = [module.name for module in pkgutil.walk_packages(fleetjax.__path__, "fleetjax.")]
    results = [doctest.testmod(importlib.import_module(name)) for name in names if name != "fleetjax.__main__"]
    assert sum(result.attempted for result in results) > 5
    assert not any(result.failed for result in results)


def test_commands_can_be_typed(monkeypatch):
    rules = types.ModuleType("my_rules")
    rules.surprise = fleetjax.Algorithm(lambda config: None)
    monkeypatch.setitem(sys.modules, "my_rules", rules)
    typed = {command for text in TEXTS.values() for command in commands(text)}
    assert len(typed) > 15
    for command in typed:
        flags.parse(shlex.split(command)[1:])  # refuses what is unknown


def test_files_that_pages_name_exist():
    links = [(name, target) for name, text in TEXTS.items() for target in re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", text)]
    scripts = [target for text in TEXTS.values() for target in re.findall(r"\b(?:benchmarks|experiments|tests)/\w+\.py", text)]
    assert len(links) > 20
    assert len(scripts) > 10
    assert [link for link in links if not (ROOT / link[0]).parent.joinpath(link[1]).exists()] == []
    assert [script for script in scripts if not (ROOT / script).exists()] == []


def test_api_reference_is_complete():
    reference = re.findall(r"^::: (\S+)", "\n".join(TEXTS.values()), re.MULTILINE)
    assert len(reference) == len(set(reference))
    assert set(fleetjax.__all__) - {"envs"} <= {name.split(".")[-1] for name in reference}
    for name in reference:
        pkgutil.resolve_name(name)  # raises if there is none

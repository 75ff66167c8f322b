"""The pages below docs/ keep their promise: their Python blocks run, in order. So do the examples in docstrings."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import jax
import pytest

import fleetjax
from fleetjax import envs, priority, supervisors

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [page for page in sorted(DOCS.glob("*.md")) if "```python" in page.read_text()]


def blocks(page: Path) -> str:
    """Return the page with all but its Python blocks blanked out, so that errors name the page's lines."""
    text = page.read_text()
    kept = [""] * (text.count("\n") + 1)
    for match in re.finditer(r"```python\n(.*?)```", text, re.DOTALL):
        first = text[: match.start(1)].count("\n")
        for i, line in enumerate(match.group(1).splitlines()):
            kept[first + i] = line
    return "\n".join(kept)


@pytest.fixture
def own_registries(monkeypatch):
    """Let what a page registers vanish after it."""
    for module, name in ((envs, "_ENVS"), (priority, "_ALGORITHMS"), (supervisors, "_SUPERVISORS")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))


def test_there_are_pages():
    assert "custom.md" in [page.name for page in PAGES]


@pytest.fixture
def quick_compilation():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.mark.usefixtures("own_registries", "quick_compilation")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_run(page, capsys):
    names = {}
    exec(compile(blocks(page), str(page), "exec"), names)
    if page.name == "custom.md":
        metrics = names["result"].metrics
        assert metrics.successes.sum() > 0
        assert metrics.hard_resets.sum() > 0
        assert "brax/inverted_pendulum" in capsys.readouterr().out


def test_examples_in_docstrings():
    names = [module.name for module in pkgutil.walk_packages(fleetjax.__path__, "fleetjax.")]
    results = [doctest.testmod(importlib.import_module(name)) for name in names if name != "fleetjax.__main__"]
    assert sum(result.attempted for result in results) > 5
    assert not any(result.failed for result in results)

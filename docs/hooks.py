"""What the documentation site adds to its pages: the table of configuration fields, the study's figures, doctests as code."""

import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from fleetjax.config import FIELDS, Config
from fleetjax.io.parameters import show

_TABLE = "<!-- table of configuration fields -->"
_RESULTS = Path(__file__).parents[1] / "experiments" / "results"


class Doctests(griffe.Extension):
    """Fences `>>>` examples in docstrings; Markdown would read them as quotations."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Fence the examples of one object."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^>>> (?:.+\n?)+", r"```pycon\n\g<0>\n```\n", obj.docstring.value)


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Put the table of configuration fields where a page asks for it, and find the study's figures where the site has them."""
    return markdown.replace(_TABLE, _fields()).replace("../experiments/results/", "results/")


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the study's figures, which lie outside of the pages' folder."""
    for path in sorted(_RESULTS.glob("*.png")):
        files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    return files


def _fields() -> str:
    rows = ["| field | default | meaning | unit | swept |", "|---|---|---|---|---|"]
    for name, field in FIELDS.items():
        default = show(getattr(Config, name))
        rows.append(f"| `{name}` | {default} | {field.help} | {field.unit} | {'yes' if field.traced else 'no'} |")
    return "\n".join(rows)

"""What the documentation site adds to its pages: the table of configuration fields, and doctests shown as code."""

import re
from typing import Any

import griffe

from fleetjax.config import FIELDS, Config
from fleetjax.io.flags import show

_TABLE = "<!-- table of configuration fields -->"


class Doctests(griffe.Extension):
    """Fences `>>>` examples in docstrings; Markdown would read them as quotations."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Fence the examples of one object."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^>>> (?:.+\n?)+", r"```pycon\n\g<0>\n```\n", obj.docstring.value)


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Put the table of configuration fields where a page asks for it."""
    return markdown.replace(_TABLE, _fields())


def _fields() -> str:
    rows = ["| field | default | meaning | unit | swept |", "|---|---|---|---|---|"]
    for name, field in FIELDS.items():
        default = show(getattr(Config, name))
        rows.append(f"| `{name}` | {default} | {field.help} | {field.unit} | {'yes' if field.traced else 'no'} |")
    return "\n".join(rows)

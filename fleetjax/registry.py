"""Names that users choose by: environments, algorithms, supervisors and estimators are each in a registry.

A name may have the form `MODULE:NAME`, as in Gymnasium: the module is imported, and registers NAME.
"""

import difflib
import importlib
import re
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

Entry = TypeVar("Entry")


class Registry(Generic[Entry]):
    """Entries by name.

    Args:
        kind: what the entries are, as errors call it: "environment".

    >>> colours = Registry("colour")
    >>> colours.register("red", 1)
    >>> colours.get("red"), colours.names(), "blue" in colours
    (1, ('red',), False)
    >>> colours.get("rad")
    Traceback (most recent call last):
    ValueError: colour = 'rad' is unknown; the closest are red
    """

    def __init__(self, kind: str):
        self.kind = kind
        self.entries: dict[str, Entry] = {}

    def register(self, name: str, entry: Entry) -> None:
        """Add an entry.

        Raises:
            ValueError: if the name is taken.
        """
        if name in self.entries:
            raise ValueError(f"{self.kind} = {name!r} is already registered; choose another name")
        self.entries[name] = entry

    def get(self, name: str) -> Entry:
        """Return an entry, after the import of the module in `MODULE:NAME`.

        Raises:
            ValueError: if there is none of that name; the message has the closest ones. Or if the module cannot be imported.
        """
        own = load(name)
        if own not in self.entries:
            raise ValueError(unknown(self.kind, name, self.entries))
        return self.entries[own]

    def names(self) -> tuple[str, ...]:
        """Return the names, in the order of registration."""
        return tuple(self.entries)

    def __contains__(self, name: object) -> bool:
        try:
            return load(name) in self.entries
        except ValueError:
            return False

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)


def load(name: object) -> str:
    """Import the module in a name of the form `MODULE:NAME`, and return NAME; return other names as they are.

    Raises:
        ValueError: if the module cannot be imported.
    """
    module, colon, own = str(name).rpartition(":")
    if not colon:
        return own
    try:
        if not re.fullmatch(r"\w+(\.\w+)*", module):
            raise ImportError(f"{module!r} is not the name of a module")
        importlib.import_module(module)
    except Exception as error:  # whatever the module does
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"{name}: its module cannot be imported: {reason}; is its folder on PYTHONPATH?") from error
    return own


def unknown(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the message for an unknown name, with the closest known ones."""
    close = difflib.get_close_matches(str(name), list(known), n=3, cutoff=0.3) or list(known)
    return f"{kind} = {name!r} is unknown; the closest are {', '.join(close)}"

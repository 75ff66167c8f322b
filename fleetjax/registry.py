"""Names that users choose by: environments, algorithms, supervisors and estimators are each in a registry."""

import difflib
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
        """Return an entry.

        Raises:
            ValueError: if there is none of that name; the message has the closest ones.
        """
        if not isinstance(name, str) or name not in self.entries:
            raise ValueError(unknown(self.kind, name, self.entries))
        return self.entries[name]

    def names(self) -> tuple[str, ...]:
        """Return the names, in the order of registration."""
        return tuple(self.entries)

    def __contains__(self, name: object) -> bool:
        return name in self.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)


def unknown(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the message for an unknown name, with the closest known ones."""
    close = difflib.get_close_matches(str(name), list(known), n=3, cutoff=0.3) or list(known)
    return f"{kind} = {name!r} is unknown; the closest are {', '.join(close)}"

"""What pages may say: four kinds of short JSON messages, parsed strictly."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

LONGEST = 1024  # bytes
_LARGEST = 2**31 - 1


class Claim(NamedTuple):
    """Ask for a seat: with the key of an earlier one (or ""), and a wish (or -1)."""

    key: str
    seat: int


class Act(NamedTuple):
    """Press keys for a robot, as an answer to the picture of a timestep."""

    robot: int
    since: int
    tick: int
    held: list[str]


class Reset(NamedTuple):
    """Want the hard reset of a robot."""

    robot: int
    since: int


class Seen(NamedTuple):
    """Still there."""


class Leave(NamedTuple):
    """Stand up."""


Message = Claim | Act | Reset | Seen | Leave
_KINDS: dict[str, type[Any]] = {"claim": Claim, "act": Act, "reset": Reset, "seen": Seen, "leave": Leave}


def parse(text: str) -> Message:
    """Return the message that a page sent.

    Raises:
        ValueError: if it is none; the reason does not repeat what was sent.

    >>> parse('{"type": "reset", "robot": 3, "since": 17}')
    Reset(robot=3, since=17)
    """
    if len(text) > LONGEST:
        raise ValueError(f"messages have at most {LONGEST} bytes")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("messages must be JSON") from None
    if not isinstance(content, dict) or not isinstance(content.get("type"), str) or content["type"] not in _KINDS:
        raise ValueError(f"type must be one of {', '.join(_KINDS)}")
    kind = _KINDS[content.pop("type")]
    if set(content) != set(kind._fields):
        raise ValueError(f"fields must be {', '.join(('type', *kind._fields))}")
    _check(kind, content)
    return kind(**content)


def _check(kind: type[Any], content: Mapping[str, Any]) -> None:
    """Check the types of the fields.

    Raises:
        ValueError: if one is wrong.
    """
    for name, wanted in kind.__annotations__.items():
        value = content[name]
        if wanted is int and not (type(value) is int and -1 <= value <= _LARGEST):
            raise ValueError(f"{name} must be a whole number")
        if wanted is str and not (isinstance(value, str) and len(value) <= 64):
            raise ValueError(f"{name} must be a short text")
        if wanted == list[str] and not (isinstance(value, list) and len(value) <= 8 and all(type(x) is str for x in value)):
            raise ValueError(f"{name} must be a short list of names")

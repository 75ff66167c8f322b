"""The flags of a run's parameters, one for each, and what reads and shows their values. Nothing here loads JAX."""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fleetjax.environments import get_defaults, list_envs
from fleetjax.field import FIELDS, OF_LINKS, Field, every_field, owners_in_words
from fleetjax.io.lists import listed, sizes

LARGEST_SEED = 2**32 - 1  # JAX folds larger ones onto these
IN_CONSOLE = MappingProxyType({"initial_period": 0})  # its own defaults: a person who is free is asked at once
_LARGEST = 2**31 - 1


def add_parameters(
    command: Any,
    environment: str | None,
    short: Mapping[str, str] = MappingProxyType({}),
    *,
    with_lists: bool = False,
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Add a flag for each field of `Config`, and for each parameter of an algorithm.

    Args:
        command: that gets the flags.
        environment: whose defaults are shown; None = those of all.
        short: second flags of some fields.
        with_lists: take several values, separated by commas.
        defaults: of this command, where they are not the environment's.
    """
    add = _add_list if with_lists else _add_field
    fields = command.add_argument_group(f"parameters{f' (defaults of {environment})' if environment else ''}")
    people = command.add_argument_group("humans and links (@FILE: a number for each human)")
    own = command.add_argument_group("parameters of one algorithm each")
    for name, field in every_field().items():
        if name == "environment":
            continue
        default = show(defaults[name]) if name in defaults else _default(name, field, environment)
        if name in FIELDS:
            group = people if field.per_human or name in OF_LINKS else fields
            add(group, name, field, default, *([short[name]] if name in short else []))
        else:
            add(own, name, field._replace(help=f"{owners_in_words(name)}: {field.help}"), default)


def _add_field(group: Any, name: str, field: Field, default: str, *short: str) -> None:
    options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": _help(field, default)}
    if field.kind is bool:
        options |= {"action": argparse.BooleanOptionalAction}
    elif field.kind is tuple:
        options |= {"type": integer, "nargs": "+", "metavar": "N"}
    else:
        options["type"], options["metavar"] = _reader(field)
    group.add_argument(_flag(name), *short, **options)


def _add_list(group: Any, name: str, field: Field, default: str) -> None:
    """Add a flag that takes several values of a parameter, separated by commas, in place of one."""
    options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": _help(field, default)}
    if field.kind is tuple:
        options |= {"action": sizes(integer), "nargs": "+", "metavar": "N"}
    else:
        read, letter = _reader(field)
        options |= {"type": listed(read), "metavar": f"{letter},..."}
    if field.kind is bool:
        options |= {"nargs": "?", "const": [True]}
        group.add_argument(f"--no-{_flag(name)[2:]}", dest=name, action="store_const", const=[False], default=argparse.SUPPRESS)
    group.add_argument(_flag(name), **options)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _help(field: Field, default: str) -> str:
    unit = f" ({field.unit})" if field.unit else ""
    return f"{field.help}{unit} [default: {default}]".replace("%", "%%")


def _default(name: str, field: Field, environment: str | None) -> str:
    general = field.default
    if environment:
        return show(get_defaults(environment).get(name, general))
    changed = {env: get_defaults(env)[name] for env in list_envs() if get_defaults(env).get(name, general) != general}
    return "; ".join([show(general), *(f"{env} {show(value)}" for env, value in changed.items())])


def show(value: Any) -> str:
    """Return a value as it is typed on the command line."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value) or "the environment's own"


def integer(text: str) -> int:
    """Return a whole number of 32 bits."""
    value = number(text)
    if not math.isfinite(value) or value != int(value) or abs(value) > _LARGEST:
        raise argparse.ArgumentTypeError(f"{text} must be a whole number, at most {_LARGEST}")
    return int(value)


def number(text: str) -> float:
    """Return a number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number") from None


def _number_or_file(text: str) -> float | tuple[float, ...]:
    """Return a number, or of @FILE the numbers that it holds, one for each human, separated by white space."""
    if not text.startswith("@"):
        return number(text)
    try:
        return tuple(map(number, Path(text[1:]).read_text().split()))
    except (OSError, UnicodeDecodeError) as error:
        raise argparse.ArgumentTypeError(f"{text[1:]} cannot be read: {error}") from None


def _switch(text: str) -> bool:
    if text not in ("on", "off"):
        raise argparse.ArgumentTypeError(f"{text!r} must be on or off")
    return text == "on"


def seed(text: str) -> int:
    """Return a seed that differs from every other one."""
    if not text.isascii() or not text.isdecimal() or int(text) > LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from 0 to {LARGEST_SEED}")
    return int(text)


def _reader(field: Field) -> tuple[Any, str]:
    """Return what reads a field's value, and what stands for it in the help."""
    return (_number_or_file, "X|@FILE") if field.per_human else _KINDS[field.kind]


_KINDS = {  # what reads a value, and what stands for it in the help
    str: (str, "NAME"),
    int: (integer, "N"),
    float: (number, "X"),
    bool: (_switch, "on|off"),
}

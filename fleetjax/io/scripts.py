"""Command lines of scripts around the library: names to choose from, and the settings of a run after `--`."""

import argparse
import sys
from collections.abc import Collection
from typing import Any

from fleetjax.field import every_field
from fleetjax.io import flags


def add_names(parser: argparse.ArgumentParser, dest: str, known: Collection[str]) -> None:
    """Let a script be told names out of those that are known; without any it takes all."""

    def check(name: str) -> str:  # in place of `choices`, which would be asked for the default as a whole
        if name not in known:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(known)}")
        return name

    parser.add_argument(
        dest, nargs="*", type=check, default=list(known), help=f"out of {', '.join(known)}; all if none is given"
    )


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, dict[str, Any]]:
    """Parse the command line; return the script's own arguments, and the parameters of a run that follow `--`."""
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    try:
        nothing, found = (vars(flags.parse(["run", *given])) for given in ([], words[cut + 1 :]))
    except flags.Refusal as refusal:
        parser.error(str(refusal))
    known = every_field()
    others = [name for name, value in found.items() if name not in known and value != nothing.get(name)]
    if others:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in others)
        parser.error(f"only parameters of a run may follow after --, and not {named}")
    return parser.parse_args(words[:cut]), {name: value for name, value in found.items() if name in known}

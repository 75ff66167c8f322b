"""Command lines of scripts around the library: names to choose from, and the settings of a run after `--`."""

import argparse
import sys
from collections.abc import Collection
from typing import Any

from fleetjax.config import FIELDS
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
    """Parse the command line; return the script's own arguments, and the fields of `Config` that follow `--`."""
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    try:
        found = vars(flags.parse(["run", *words[cut + 1 :]]))
    except flags.Refusal as refusal:
        parser.error(str(refusal))
    return parser.parse_args(words[:cut]), {name: value for name, value in found.items() if name in FIELDS}

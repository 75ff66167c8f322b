"""Lists of values as they are typed, separated by commas. Nothing here loads JAX."""

import argparse
from collections.abc import Callable
from typing import Any


def listed(read: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    """Return what reads a list of values, where `read` reads one.

    >>> listed(int)("3, 7")
    [3, 7]
    """

    def read_all(text: str) -> list[Any]:
        words = [word.strip() for word in text.split(",")]
        if not all(words):
            raise argparse.ArgumentTypeError(f"{text!r} has an empty entry; separate values by single commas")
        return [read(word) for word in words]

    return read_all


def sizes(read: Callable[[str], int]) -> type[argparse.Action]:
    """Return the action of a flag that takes a list of tuples, `64 64,256 256`, where `read` reads a number."""

    class Sizes(argparse.Action):
        """Joins what the shell took apart at spaces."""

        def __call__(self, parser, namespace, values, option_string=None):
            """Store the list."""
            read_all = listed(lambda words: tuple(map(read, words.split())))
            try:
                setattr(namespace, self.dest, read_all(" ".join(map(str, values or ()))))
            except argparse.ArgumentTypeError as error:
                raise argparse.ArgumentError(self, str(error)) from None

    return Sizes

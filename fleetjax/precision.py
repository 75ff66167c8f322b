"""One precision for all: fleets compute in 32 bits, whatever JAX's default is."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def in_32_bits(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Return a function that traces with 32-bit defaults, so that a program is the same with `JAX_ENABLE_X64` and without."""

    @functools.wraps(function)
    def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Returned:
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return wrapped

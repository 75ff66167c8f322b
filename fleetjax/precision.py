"""One precision for all: fleets compute in 32 bits, whatever JAX's default is."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax

Function = TypeVar("Function", bound=Callable)


def in_32_bits(function: Function) -> Function:
    """Return a function that traces with 32-bit defaults, so that a program is the same with `JAX_ENABLE_X64` and without."""

    @functools.wraps(function)
    def wrapped(*args, **kwargs):
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return wrapped  # pyright: ignore[reportReturnType]  the same signature

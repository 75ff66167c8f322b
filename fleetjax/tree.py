"""Helpers for pytrees whose leaves share a leading axis."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


def where(mask: jax.Array, new: Tree, old: Tree) -> Tree:
    """Return `new` in the rows where `mask` holds and `old` elsewhere, leaf by leaf.

    Args:
        mask: bool[N].
        new: pytree of arrays [N, ...].
        old: pytree of the same structure.
    """

    def choose(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (jnp.ndim(a) - mask.ndim)), a, b)

    return jax.tree.map(choose, new, old)


def take(rows: Tree, index: jax.Array) -> Tree:
    """Return the rows at `index` i32[...] of a pytree of arrays [N, ...]."""
    return jax.tree.map(lambda x: x[index], rows)


def finite(rows: object) -> jax.Array:
    """Return bool[N], for each row of a pytree of real arrays [N, ...] whether all its numbers are finite."""
    leaves = jax.tree.leaves(rows)
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x), axis=tuple(range(1, x.ndim))) for x in leaves]), axis=0)

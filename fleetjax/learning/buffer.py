"""A store of rows that grows in place inside a scan: time per step does not depend on its capacity."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

COUNTED = 2**30  # rows; a ring that was given more counts on from its capacity, far from the end of i32


class Buffer(NamedTuple):
    """Rows in order of arrival.

    Attributes:
        rows: pytree of arrays [capacity, ...].
        added: i32[] rows added so far, in all (of a ring the last `COUNTED`, more or less).
    """

    rows: Any
    added: jax.Array

    @property
    def capacity(self) -> int:
        """Number of slots."""
        return jax.tree.leaves(self.rows)[0].shape[0]

    @property
    def size(self) -> jax.Array:
        """i32[] rows that can be read."""
        return jnp.minimum(self.added, self.capacity)


def create(example: Any, capacity: int) -> Buffer:
    """Return an empty buffer for rows like `example`, a pytree of unbatched arrays."""
    rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
    return Buffer(rows, jnp.zeros((), jnp.int32))


def append(buffer: Buffer, rows: Any, mask: jax.Array, *, overwrite: bool) -> Buffer:
    """Add the rows where `mask` holds, in order.

    Args:
        buffer: the store.
        rows: pytree of arrays [K, ...], K <= capacity if `overwrite`.
        mask: bool[K].
        overwrite: when full, whether new rows take the place of the oldest (a ring) or are dropped.
    """
    place = buffer.added + jnp.cumsum(mask, dtype=jnp.int32) - 1
    if overwrite:
        place = place % buffer.capacity
    slot = jnp.where(mask, place, buffer.capacity)  # out of range: dropped
    stored = jax.tree.map(lambda old, new: old.at[slot].set(new.astype(old.dtype), mode="drop"), buffer.rows, rows)
    added = buffer.added + jnp.sum(mask, dtype=jnp.int32)
    if overwrite:
        return Buffer(stored, jnp.where(added < COUNTED, added, buffer.capacity + added % buffer.capacity))
    return Buffer(stored, jnp.minimum(added, buffer.capacity))


def draw_index(key: jax.Array, shape: tuple[int, ...], size: jax.Array) -> jax.Array:
    """Return i32[*shape] row numbers below `size` i32[...], uniform (to 1 part in 2^32 / size); 0 where `size` is 0."""
    bits = jax.random.bits(key, shape)
    return (bits % jnp.maximum(size, 1).astype(jnp.uint32)).astype(jnp.int32)

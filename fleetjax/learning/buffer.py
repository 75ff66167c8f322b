"""A store of rows that grows in place inside a scan: time per step does not depend on its capacity."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.tree import take

COUNTED = 2**30  # rows; a ring that was given more counts on from its capacity, far from the end of i32


class Buffer(NamedTuple):
    """Rows in order of arrival.

    Attributes:
        rows: pytree of arrays [capacity, ...].
        added: i32[] rows added so far, in all (of a ring the last `COUNTED`, more or less); i32[D] of a ring in D equal
            parts, each of which takes the rows of its own robots.
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
        return jnp.sum(self.sizes)

    @property
    def sizes(self) -> jax.Array:
        """i32[] rows that can be read; i32[D] in each part."""
        return jnp.minimum(self.added, self.capacity // self.added.size)


def is_buffer(x: Any) -> bool:
    """Return whether a part of a pytree is a buffer: the `is_leaf` of what treats buffers as a whole."""
    return isinstance(x, Buffer)


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
    if buffer.added.ndim:
        parts = buffer.added.size
        each = jax.vmap(partial(append, overwrite=overwrite))
        return unite(each(Buffer(divide(buffer.rows, parts), buffer.added), divide(rows, parts), divide(mask, parts)))
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


def read(buffer: Buffer, index: jax.Array) -> Any:
    """Return the rows of a buffer at `index` i32[...], below its size; those of its parts follow each other."""
    if not buffer.added.ndim:
        return take(buffer.rows, index)
    sizes = sharding.everywhere(buffer.sizes)  # else devices would exchange something at every step of the search
    ends = jnp.cumsum(sizes)
    part = jnp.minimum(jnp.searchsorted(ends, index, side="right"), ends.size - 1)
    return take(buffer.rows, part * (buffer.capacity // ends.size) + index - (ends - sizes)[part])


def in_parts(ring: Buffer, parts: int) -> Buffer:
    """Return a ring with the same rows in so many equal parts, dealt in turn, oldest first; 1 = undivided.

    Its capacity is rounded up to a multiple of `parts`.
    """
    before = max(ring.added.size, 1)
    room, each = ring.capacity // before, -(-ring.capacity // parts)
    # The number of the row in each place, in the order in which they are dealt.
    number = jnp.arange(each) * parts + jnp.arange(parts)[:, None]
    added = ring.added.reshape(-1)
    ends = jnp.cumsum(ring.sizes.reshape(-1))
    part = jnp.minimum(jnp.searchsorted(ends, number.reshape(-1), side="right"), before - 1)
    first = jnp.where(added > room, added % room, 0)  # the oldest
    place = (number.reshape(-1) - (ends - ring.sizes)[part] + first[part]) % room
    rows = take(ring.rows, part * room + place)
    dealt = jnp.clip((ends[-1] - jnp.arange(parts) + parts - 1) // parts, 0, each).astype(jnp.int32)
    return Buffer(rows, dealt if parts > 1 else dealt[0])


def divide(rows: Any, parts: int) -> Any:
    """Return the leaves [D K, ...] of a pytree as [D, K, ...]."""
    return jax.tree.map(lambda x: x.reshape(parts, x.shape[0] // parts, *x.shape[1:]), rows)


def unite(buffer: Buffer) -> Buffer:
    """Return the buffers [D] as a ring in D parts."""
    return Buffer(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), buffer.rows), buffer.added)

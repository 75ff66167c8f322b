"""Scores from several columns: ranks in the order of the first, then the second, and so on."""

from functools import partial

import jax
import jax.numpy as jnp

from fleetjax import sharding


def lexicographic(*columns: jax.Array) -> jax.Array:
    """Return scores f32[N] that order robots by the first column, then the second, and so on.

    Scores are dense ranks: equal rows are equal, and a row of zeros scores 0.

    Args:
        columns: f32[N] each, >= 0, most important first.

    On a mesh only the ranks of robots that can be helped are told apart.

    >>> lexicographic(jnp.array([0.0, 1.0, 1.0, 0.0]), jnp.array([0.3, 0.0, 0.2, 0.0])).tolist()
    [1.0, 2.0, 3.0, 0.0]
    """
    numbers = [jnp.nan_to_num(column.astype(jnp.float32)) for column in columns]
    here = sharding.division()
    if here is None:
        return _ranks(jnp.stack(numbers))
    return sharding.on_each(partial(_ranks_of_best, here.num_humans), sharding.DIVIDED, *numbers)


def _ranks(table: jax.Array) -> jax.Array:
    order = jnp.lexsort(table[::-1])
    ranked = table[:, order]
    first = jnp.any(ranked[:, :1] > 0, axis=0)
    rises = jnp.any(ranked[:, 1:] != ranked[:, :-1], axis=0)
    ranks = jnp.cumsum(jnp.concatenate([first, rises]))
    return jnp.zeros(order.shape, jnp.float32).at[order].set(ranks.astype(jnp.float32))


def _ranks_of_best(number: int, *columns: jax.Array) -> jax.Array:
    """Return ranks that tell apart the best `number` robots of each device, and whoever equals them; others have rank 1 or 0.

    No more robots than that can be helped, so devices exchange these rows alone.

    Args:
        number: M.
        columns: f32[N / D] of the robots of this device.
    """
    table = jnp.stack(columns)
    order = jnp.lexsort(table[::-1])[-number:]
    best = table[:, order]
    ranks = 1 + sharding.own_part(_ranks(jnp.stack(sharding.gather(tuple(best)))))
    like_last = jnp.all(table == best[:, :1], axis=0)
    scores = jnp.where(like_last, ranks[0], 1.0).at[order].set(ranks)
    return jnp.where(jnp.any(table > 0, axis=0), scores, 0.0)


def above(values: jax.Array, threshold: jax.Array) -> jax.Array:
    """Return `values`, with those below `threshold` set to 0."""
    return jnp.where(values >= threshold, values, 0.0)


def softly_above(values: jax.Array, threshold: jax.Array | float, temperature: jax.Array) -> jax.Array:
    """Return `values` times a sigmoid that rises from 0 to 1 about `threshold`.

    As the temperature falls to 0, this approaches `above`.
    """
    return values * jax.nn.sigmoid((values - threshold) / temperature)

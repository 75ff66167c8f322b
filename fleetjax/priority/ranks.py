"""Scores from several columns: ranks in the order of the first, then the second, and so on."""

import jax
import jax.numpy as jnp


def lexicographic(*columns: jax.Array) -> jax.Array:
    """Return scores f32[N] that order robots by the first column, then the second, and so on.

    Scores are dense ranks: equal rows are equal, and a row of zeros scores 0.

    Args:
        columns: f32[N] each, >= 0, most important first.

    >>> lexicographic(jnp.array([0.0, 1.0, 1.0, 0.0]), jnp.array([0.3, 0.0, 0.2, 0.0])).tolist()
    [1.0, 2.0, 3.0, 0.0]
    """
    table = jnp.stack([jnp.nan_to_num(column.astype(jnp.float32)) for column in columns])
    order = jnp.lexsort(table[::-1])
    ranked = table[:, order]
    first = jnp.any(ranked[:, :1] > 0, axis=0)
    rises = jnp.any(ranked[:, 1:] != ranked[:, :-1], axis=0)
    ranks = jnp.cumsum(jnp.concatenate([first, rises]))
    return jnp.zeros(order.shape, jnp.float32).at[order].set(ranks.astype(jnp.float32))


def above(values: jax.Array, threshold: jax.Array) -> jax.Array:
    """Return `values`, with those below `threshold` set to 0."""
    return jnp.where(values >= threshold, values, 0.0)


def softly_above(values: jax.Array, threshold: jax.Array | float, temperature: jax.Array) -> jax.Array:
    """Return `values` times a sigmoid that rises from 0 to 1 about `threshold`.

    As the temperature falls to 0, this approaches `above`.
    """
    return values * jax.nn.sigmoid((values - threshold) / temperature)

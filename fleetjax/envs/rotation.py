"""Rotations as unit quaternions (w, x, y, z)."""

import jax
import jax.numpy as jnp


def rotation_matrix(quaternion: jax.Array) -> jax.Array:
    """Return the rotation f32[3, 3] from body to world of a unit quaternion f32[4]."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )

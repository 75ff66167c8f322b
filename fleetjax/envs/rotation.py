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


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the product f32[4] of two quaternions: first turn by `b`, then by `a`."""
    w, x, y, z = a
    return jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


def conjugate(quaternion: jax.Array) -> jax.Array:
    """Return the inverse f32[4] of a unit quaternion."""
    return quaternion * jnp.array([1.0, -1.0, -1.0, -1.0])


def sine_of_half_angle(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the sine f32[] of half the angle between two orientations f32[4]; its derivative stays finite up to pi."""
    return jnp.linalg.norm(multiply(a, conjugate(b))[1:])


def angle_between(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return by how much two orientations f32[4] differ, f32[] (rad, in [0, pi])."""
    return 2.0 * jnp.arcsin(jnp.minimum(1.0, sine_of_half_angle(a, b)))

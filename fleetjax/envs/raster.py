"""Pictures of the square [-1, 1]^2 seen from above, in pure JAX: shapes painted over each other with soft edges."""

import jax
import jax.numpy as jnp


def grid(size: int) -> jax.Array:
    """Return the centre f32[size, size, 2] of each pixel; x to the right, y upwards, rows from the top."""
    centre = (2 * jnp.arange(size) + 1) / size - 1
    x, y = jnp.meshgrid(centre, -centre)
    return jnp.stack([x, y], axis=-1)


def disc(points: jax.Array, centre: jax.Array, radius: float) -> jax.Array:
    """Return the signed distance f32[H, W] to a disc, negative inside."""
    return jnp.linalg.norm(points - centre, axis=-1) - radius


def box(points: jax.Array, centre: jax.Array, half: jax.Array, angle: jax.Array | float = 0.0) -> jax.Array:
    """Return the signed distance f32[H, W] to a box with half sides `half` f32[2], turned by `angle` (rad)."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    offset = points - centre
    local = jnp.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], axis=-1)
    beyond = jnp.abs(local) - half
    return jnp.linalg.norm(jnp.maximum(beyond, 0.0), axis=-1) + jnp.minimum(jnp.max(beyond, axis=-1), 0.0)


def paint(
    picture: jax.Array, distance: jax.Array, colour: tuple[float, float, float] | jax.Array, opacity: float = 1.0
) -> jax.Array:
    """Return the picture f32[H, W, 3], of 0 to 255, with a shape painted over it; its edge is one pixel wide.

    Args:
        picture: what is there.
        distance: f32[H, W] signed distance to the shape.
        colour: red, green, blue, each 0 to 255.
        opacity: 1 hides what is below.
    """
    cover = opacity * jnp.clip(0.5 - distance * picture.shape[0] / 2, 0.0, 1.0)[..., None]
    return (1 - cover) * picture + cover * jnp.asarray(colour, jnp.float32)


def plain(size: int, colour: tuple[float, float, float]) -> jax.Array:
    """Return a picture f32[size, size, 3] of one colour."""
    return jnp.broadcast_to(jnp.array(colour, jnp.float32), (size, size, 3))


def as_pixels(picture: jax.Array) -> jax.Array:
    """Return the picture as u8[H, W, 3]."""
    return jnp.round(jnp.clip(picture, 0.0, 255.0)).astype(jnp.uint8)

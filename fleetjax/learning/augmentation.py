"""Images as other light and another camera might have shown them (paper, Appendix, physical experiment protocol)."""

import jax
import jax.numpy as jnp

LUMA = (0.299, 0.587, 0.114)  # of red, green, blue, in how bright a pixel is
CONTRAST, BRIGHTNESS, GAMMA, SATURATION = 0.15, 10.0, 0.1, 0.05  # largest changes; brightness in pixel values, others as shares
BLUR = 0.3  # largest deviation, in pixels
NOISE = 255 / 80  # largest deviation, in pixel values


def augment(image: jax.Array, key: jax.Array) -> jax.Array:
    """Return a variant of an image f32[H, W, 3]; pixel values are from 0 to 255, whole numbers in what is returned.

    In this order: linear contrast about mid-grey by 85 % to 115 %, -10 to 10 added to each channel, gamma from 0.9 to 1.1,
    Gaussian blur of up to 0.3 pixels, saturation by 95 % to 105 %, Gaussian noise of up to 255 / 80.
    """
    key_contrast, key_add, key_gamma, key_blur, key_saturation, key_noise, key_pixels = jax.random.split(key, 7)

    def change(key: jax.Array, largest: float, shape: tuple[int, ...] = ()) -> jax.Array:
        return jax.random.uniform(key, shape, minval=-largest, maxval=largest)

    image = 127.5 + (1 + change(key_contrast, CONTRAST)) * (image - 127.5)
    image = jnp.clip(image + change(key_add, BRIGHTNESS, (3,)), 0.0, 255.0)
    image = 255 * (image / 255) ** (1 + change(key_gamma, GAMMA))
    image = _blur(image, jax.random.uniform(key_blur, maxval=BLUR))
    grey = jnp.sum(image * jnp.array(LUMA), axis=-1, keepdims=True)
    image = grey + (1 + change(key_saturation, SATURATION)) * (image - grey)
    image += jax.random.uniform(key_noise, maxval=NOISE) * jax.random.normal(key_pixels, image.shape)
    return jnp.round(jnp.clip(image, 0.0, 255.0))


def _blur(image: jax.Array, deviation: jax.Array) -> jax.Array:
    """Return f32[H, W, C] blurred by a Gaussian of `deviation` pixels, cut at one pixel; the border repeats."""
    neighbour = jnp.exp(-0.5 / jnp.maximum(deviation, 1e-3) ** 2)
    for axis in (0, 1):
        ends = [(1, 1) if i == axis else (0, 0) for i in range(image.ndim)]
        wide = jnp.pad(image, ends, mode="edge")
        sides = sum(jax.lax.slice_in_dim(wide, i, i + image.shape[axis], axis=axis) for i in (0, 2))
        image = (image + neighbour * sides) / (1 + 2 * neighbour)
    return image

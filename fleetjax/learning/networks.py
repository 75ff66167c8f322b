"""The networks of policy and critics, and how they see observations."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from fleetjax.envs import EnvSpec

STAGES = ((4, 24), (1, 16))  # of the convolutions: side of a patch in pixels, which is also the stride, and channels
MID_GREY, SPREAD = 127.5, 64.0  # how networks see pixel values, whatever the data
CLIP = 10.0  # deviations at which normalised observations are clipped
# Adam without its learning rate, which is a traced field of the configuration. `eps_root` keeps derivatives through an update
# finite where a gradient is exactly 0, as behind a dead ReLU.
ADAM = optax.scale_by_adam(eps_root=1e-16)
_TRUNCATED_DEVIATION = 0.87962566103423978  # of a standard normal cut off at -2 and 2
_Dense = functools.partial(nn.Dense, kernel_init=nn.initializers.zeros)  # see `_draw_kernels`


class Network(NamedTuple):
    """Pure functions of a network: `init(key, example) -> params`, `apply(params, x f32[..., I]) -> f32[..., O]`."""

    init: Callable[[jax.Array, jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]


def make_mlp(hidden_sizes: Sequence[int], output_size: int, *, first: Sequence[Any] = ()) -> Network:
    """Return dense layers with ReLU between them, behind those that come `first`; the last is linear."""
    layers = [*first]
    for size in hidden_sizes:
        layers += [_Dense(size), nn.relu]
    module = nn.Sequential([*layers, _Dense(output_size)])

    def init(key: jax.Array, example: jax.Array) -> Any:
        return _draw_kernels(module.init(key, example), key)

    return Network(init, lambda params, x: jnp.asarray(module.apply(params, x)))


def _draw_kernels(params: Any, key: jax.Array) -> Any:
    """Return parameters with all kernels [I, O] drawn at once, as flax's `lecun_normal` does one by one.

    A draw takes long to compile.
    """
    leaves, structure = jax.tree.flatten(params)
    sizes = [x.size if x.ndim == 2 else 0 for x in leaves]
    draw = jax.random.truncated_normal(key, -2.0, 2.0, (sum(sizes),)) / _TRUNCATED_DEVIATION
    parts = jnp.split(draw, np.cumsum(sizes)[:-1])
    drawn = [part.reshape(x.shape) / math.sqrt(x.shape[0]) if x.ndim == 2 else x for x, part in zip(leaves, parts, strict=True)]
    return jax.tree.unflatten(structure, drawn)


class _Convolutions(nn.Module):
    """Where things are in an image that stands at the start of the input; what follows it is passed on.

    Convolutions with stride = kernel, then a spatial softmax: each channel's mean place. From a few hundred images this
    generalises where dense layers on all features do not. Patches are cut out by reshaping and multiplied as matrices,
    which is several times as fast in a scan on a CPU as XLA's convolutions.
    """

    image_shape: tuple[int, int, int]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Return features f32[..., 2 F + K] of inputs f32[..., H * W * C + K]: F places (x, y in [-1, 1]), the K others.

        Reference: Levine, Finn, Darrell and Abbeel, End-to-end training of deep visuomotor policies, 2016.
        """
        lead, size = x.shape[:-1], math.prod(self.image_shape)
        image = x[..., :size].reshape(*lead, *self.image_shape)
        for side, channels in STAGES:
            height, width, depth = image.shape[-3:]
            patches = image.reshape(*lead, height // side, side, width // side, side, depth)
            patches = jnp.moveaxis(patches, -4, -3).reshape(*lead, height // side, width // side, side * side * depth)
            image = nn.relu(_Dense(channels)(patches))
        height, width, channels = image.shape[-3:]
        sharpness = self.param("sharpness", nn.initializers.ones, (channels,))
        weight = jax.nn.softmax((sharpness * image).reshape(*lead, height * width, channels), axis=-2)
        y, x_ = (places.ravel() for places in jnp.meshgrid(*(jnp.linspace(-1, 1, n) for n in (height, width)), indexing="ij"))
        places = jnp.einsum("...pc,pd->...cd", weight, jnp.stack([x_, y], axis=-1)).reshape(*lead, 2 * channels)
        return jnp.concatenate([places, x[..., size:]], axis=-1)


def make_network(spec: EnvSpec, hidden_sizes: Sequence[int], output_size: int) -> Network:
    """Return the network for an environment's observations, which other inputs may follow: dense, after convolutions of images.

    Raises:
        ValueError: if the convolutions do not fit the image.
    """
    if spec.image_shape is None:
        return make_mlp(hidden_sizes, output_size)
    factor = math.prod(side for side, _ in STAGES)
    if spec.image_shape[0] % factor or spec.image_shape[1] % factor:
        raise ValueError(f"image_shape = {spec.image_shape} must have height and width that {factor} divides")
    return make_mlp(hidden_sizes, output_size, first=[_Convolutions(spec.image_shape)])


def descend(params: Any, gradients: Any, opt_state: Any, learning_rate: jax.Array | float) -> tuple[Any, Any]:
    """Return the parameters and the state of `ADAM` after one step against the gradients."""
    with jax.numpy_dtype_promotion("standard"):  # optax multiplies its i32 count and floats, which "strict" forbids
        steps, opt_state = ADAM.update(gradients, opt_state)
    return jax.tree.map(lambda p, step: p - learning_rate * step, params, steps), opt_state


class Normalizer(NamedTuple):
    """Shift and scale of observations.

    Attributes:
        mean: f32[O].
        deviation: f32[O].
        limit: f32[] deviations from the mean beyond which observations are clipped; the largest f32 for the identity.
    """

    mean: jax.Array
    deviation: jax.Array
    limit: jax.Array

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Return f32[..., O] observations at about unit scale."""
        return jnp.clip((obs.astype(jnp.float32) - self.mean) / self.deviation, -self.limit, self.limit)


def pixel_normalizer(size: int) -> Normalizer:
    """Return what brings pixel values f32[size] to unit scale."""
    return Normalizer(jnp.full(size, jnp.float32(MID_GREY)), jnp.full(size, jnp.float32(SPREAD)), jnp.float32(CLIP))


def fit_normalizer(obs: jax.Array, size: jax.Array, *, enabled: jax.Array | bool) -> Normalizer:
    """Return the statistics of the first `size` rows of `obs` f32[K, O], or the identity if not `enabled`.

    Entries that never vary keep their scale.
    """
    weight = jnp.where(jnp.arange(obs.shape[0]) < size, 1.0 / jnp.maximum(size, 1).astype(jnp.float32), 0.0)[:, None]
    mean = jnp.sum(weight * obs, axis=0)
    deviation = jnp.sqrt(jnp.sum(weight * (obs - mean) ** 2, axis=0))
    deviation = jnp.where(deviation < 1e-6, 1.0, deviation)
    fitted, identity = (mean, deviation, CLIP), (0.0, 1.0, jnp.finfo(jnp.float32).max)
    return Normalizer(*(jnp.where(enabled, a, b).astype(jnp.float32) for a, b in zip(fitted, identity, strict=True)))

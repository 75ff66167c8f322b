"""The networks of policy and critics, and how they see observations."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from fleetjax.envs import EnvSpec

STAGES = ((4, 24), (1, 16))  # of the convolutions: side of a patch in pixels, which is also the stride, and channels
MID_GREY, SPREAD = 127.5, 64.0  # how networks see pixel values, whatever the data


class Network(NamedTuple):
    """Pure functions of a network: `init(key, example) -> params`, `apply(params, x f32[..., I]) -> f32[..., O]`."""

    init: Callable[[jax.Array, jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]


def make_mlp(hidden_sizes: Sequence[int], output_size: int, *, first: Sequence[Any] = ()) -> Network:
    """Return dense layers with ReLU between them, behind those that come `first`; the last is linear."""
    layers = [*first]
    for size in hidden_sizes:
        layers += [nn.Dense(size), nn.relu]
    module = nn.Sequential([*layers, nn.Dense(output_size)])
    return Network(module.init, lambda params, x: jnp.asarray(module.apply(params, x)))


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
            image = nn.relu(nn.Dense(channels)(patches))
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


class Normalizer(NamedTuple):
    """Shift and scale of observations: mean f32[O], deviation f32[O]."""

    mean: jax.Array
    deviation: jax.Array

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Return f32[..., O] observations at about unit scale, clipped to ten deviations."""
        return jnp.clip((obs.astype(jnp.float32) - self.mean) / self.deviation, -10.0, 10.0)


def pixel_normalizer(size: int) -> Normalizer:
    """Return what brings pixel values f32[size] to unit scale."""
    return Normalizer(jnp.full(size, MID_GREY), jnp.full(size, SPREAD))


def fit_normalizer(obs: jax.Array, size: jax.Array, *, enabled: jax.Array | bool) -> Normalizer:
    """Return the statistics of the first `size` rows of `obs` f32[K, O], or the identity if not `enabled`.

    Entries that never vary keep their scale.
    """
    weight = (jnp.arange(obs.shape[0]) < size)[:, None] / jnp.maximum(size, 1)
    mean = jnp.sum(weight * obs, axis=0)
    deviation = jnp.sqrt(jnp.sum(weight * (obs - mean) ** 2, axis=0))
    deviation = jnp.where(deviation < 1e-6, 1.0, deviation)
    return Normalizer(jnp.where(enabled, mean, 0.0), jnp.where(enabled, deviation, 1.0))

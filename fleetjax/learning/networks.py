"""The networks of policy and critics, and how they see observations."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp


class Network(NamedTuple):
    """Pure functions of a network: `init(key, example) -> params`, `apply(params, x f32[..., I]) -> f32[..., O]`."""

    init: Callable[[jax.Array, jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]


def make_mlp(hidden_sizes: Sequence[int], output_size: int) -> Network:
    """Return dense layers with ReLU between them; the last is linear."""
    layers = []
    for size in hidden_sizes:
        layers += [nn.Dense(size), nn.relu]
    module = nn.Sequential([*layers, nn.Dense(output_size)])
    return Network(module.init, lambda params, x: jnp.asarray(module.apply(params, x)))


class Normalizer(NamedTuple):
    """Shift and scale of observations: mean f32[O], deviation f32[O]."""

    mean: jax.Array
    deviation: jax.Array

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Return f32[..., O] observations at about unit scale, clipped to ten deviations."""
        return jnp.clip((obs - self.mean) / self.deviation, -10.0, 10.0)


def fit_normalizer(obs: jax.Array, size: jax.Array, *, enabled: jax.Array | bool) -> Normalizer:
    """Return the statistics of the first `size` rows of `obs` f32[K, O], or the identity if not `enabled`.

    Entries that never vary keep their scale.
    """
    weight = (jnp.arange(obs.shape[0]) < size)[:, None] / jnp.maximum(size, 1)
    mean = jnp.sum(weight * obs, axis=0)
    deviation = jnp.sqrt(jnp.sum(weight * (obs - mean) ** 2, axis=0))
    deviation = jnp.where(deviation < 1e-6, 1.0, deviation)
    return Normalizer(jnp.where(enabled, mean, 0.0), jnp.where(enabled, deviation, 1.0))

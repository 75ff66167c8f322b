"""Running quantiles over the fleet, for rules that ask at a rate instead of at a threshold."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.priority.gates import helped
from fleetjax.types import Signals

LOWEST, HIGHEST = 1e-6, 1e3  # values beyond count as these
BINS = 2048  # equal on a logarithmic scale: each is 1 % wide
_LOGARITHMS = float(np.log(LOWEST)), float(np.log(HIGHEST))


class Histogram(NamedTuple):
    """How often values in bins of equal width on a logarithmic scale occurred; older ones count less.

    Attributes:
        mass: f32[BINS].
    """

    mass: jax.Array


def empty() -> Histogram:
    """Return the histogram of no values."""
    return Histogram(jnp.zeros(BINS, jnp.float32))


def add(histogram: Histogram, values: jax.Array, counted: jax.Array, memory: jax.Array) -> Histogram:
    """Return a histogram with one more timestep.

    Args:
        histogram: of the timesteps before.
        values: f32[N], >= 0.
        counted: bool[N], which of them count.
        memory: f32[] timesteps after which a value counts 1 / e of a new one.
    """
    low, high = _LOGARITHMS
    place = (jnp.log(jnp.clip(values, LOWEST, HIGHEST)) - low) / (high - low) * BINS
    index = jnp.clip(place.astype(jnp.int32), 0, BINS - 1)
    added = jnp.zeros(BINS, jnp.float32).at[index].add(counted.astype(jnp.float32))
    return Histogram(histogram.mass * jnp.exp(-1.0 / memory) + added)


def quantile(histogram: Histogram, level: jax.Array | float) -> jax.Array:
    """Return f32[], the value below which a share `level` of the mass lies, to the width of a bin; 0 without mass.

    Within its bin the mass is taken as even on the logarithmic scale.
    """
    low, high = _LOGARITHMS
    below = jnp.cumsum(histogram.mass)
    wanted = level * below[-1]
    index = jnp.minimum(jnp.searchsorted(below, wanted), BINS - 1)
    share = (wanted - (below - histogram.mass)[index]) / jnp.maximum(histogram.mass[index], 1e-30)
    place = (index.astype(jnp.float32) + jnp.clip(share, 0.0, 1.0)) / BINS
    return jnp.where(below[-1] > 0, jnp.exp(low + place * (high - low)), 0.0)


def on_their_own(signals: Signals) -> jax.Array:
    """Return bool[N], the robots that moved without help at the last timestep and are not in violation."""
    return ~(signals.violation | helped(signals))

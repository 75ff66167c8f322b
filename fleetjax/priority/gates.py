"""What gates share: rules that were made for one robot and one human, who watches it or not, put to work on a fleet.

A gate asks for help, and may keep it until the human agrees with the robot. On a fleet, who asks most gets a human first, and
robots in violation come after all who ask, as in the paper's Fleet-EnsembleDAgger (Section 4.2).
"""

import jax
import jax.numpy as jnp

from fleetjax.priority.ranks import lexicographic
from fleetjax.types import Signals

LEAST = 1e-6  # of who keeps its human and does not ask


def gated(signals: Signals, asking: jax.Array, keeping: jax.Array | None = None) -> jax.Array:
    """Return scores f32[N]: first robots that ask, the most first, then those that keep a human, then violations.

    Args:
        signals: of the robots.
        asking: f32[N], how much each robot asks; 0 = it does not.
        keeping: bool[N], robots that keep the human whom they have.
    """
    if keeping is not None:
        asking = jnp.where(keeping, jnp.maximum(asking, LEAST), asking)
    return lexicographic(asking, signals.violation)


def helped(signals: Signals) -> jax.Array:
    """Return bool[N], the robots that had a human at the last timestep; none where it is not known."""
    return jnp.zeros_like(signals.violation) if signals.helped is None else signals.helped


def teleoperated(signals: Signals) -> jax.Array:
    """Return bool[N], the robots on which a human acted at the last timestep, unless they are now in violation."""
    return signals.given & ~signals.violation


def known(values: jax.Array) -> jax.Array:
    """Return `values`, with 0 in place of those that are not finite."""
    return jnp.where(jnp.isfinite(values), values, 0.0)

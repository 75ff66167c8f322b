"""The contract that every physics backend meets: one robot, one control step, a compact state.

A `Physics` steps one robot; callers `vmap` it. Its state holds only what the next step needs, in float32,
so that selecting, storing and resetting robots stays cheap and every backend can share it.

Sensor data describe the state before the last substep, and are zero in a state that was never stepped:
all backends have both properties.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco


class PhysicsState(NamedTuple):
    """State of one robot between control steps.

    Attributes:
        qpos: f32[nq] generalised positions (m, rad; quaternions w, x, y, z).
        qvel: f32[nv] generalised velocities (m/s in the world frame, rad/s in the body frame for a free joint).
        act: f32[na] actuator activations.
        warmstart: f32[nv] acceleration that warm-starts the constraint solver (m/s^2, rad/s^2).
        sensors: f32[ns] sensor data, one substep behind `qpos`.
        time: f32[] simulated time since the reset (s).
        diverged: bool[] whether the last step left all bounds; the other fields are then those before it.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warmstart: jax.Array
    sensors: jax.Array
    time: jax.Array
    diverged: jax.Array


class Physics(NamedTuple):
    """Pure functions of one robot's physics.

    Attributes:
        initial: the model's reference state, at rest.
        step: `(state, control f32[nu], active bool[]) -> state`, one control step. An inactive robot keeps its state.
        model: the compiled MuJoCo model (names, limits, gears).
        control_step: seconds between two controls.
    """

    initial: PhysicsState
    step: Callable[[PhysicsState, jax.Array, jax.Array], PhysicsState]
    model: mujoco.MjModel
    control_step: float


def initial_state(model: mujoco.MjModel) -> PhysicsState:
    """Return the reference configuration `qpos0` at rest."""
    return PhysicsState(
        qpos=jnp.asarray(model.qpos0, jnp.float32),
        qvel=jnp.zeros(model.nv, jnp.float32),
        act=jnp.zeros(model.na, jnp.float32),
        warmstart=jnp.zeros(model.nv, jnp.float32),
        sensors=jnp.zeros(model.nsensordata, jnp.float32),
        time=jnp.zeros((), jnp.float32),
        diverged=jnp.zeros((), bool),
    )


def contain_divergence(before: PhysicsState, after: PhysicsState, *, failed: jax.Array) -> PhysicsState:
    """Return `after`, or `before` marked as diverged where the step failed or left the numbers that MuJoCo accepts.

    Args:
        before: the state that was stepped.
        after: what the backend made of it.
        failed: bool[] the backend's own verdict.
    """
    accepted = jnp.array([jnp.all(jnp.abs(leaf) < mujoco.mjMAXVAL) for leaf in after[:-1]])  # neither NaN nor infinity is
    diverged = failed | ~jnp.all(accepted)
    kept = jax.tree.map(lambda old, new: jnp.where(diverged, old, new), before, after)
    return kept._replace(diverged=diverged)

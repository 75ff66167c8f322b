"""MuJoCo XLA behind the physics contract: pure JAX, forward-mode differentiable, for GPUs, TPUs and CPUs."""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from fleetjax.physics.contract import PhysicsState, contain_divergence

with contextlib.redirect_stdout(io.StringIO()):  # where warp is missing, MJX prints so
    from mujoco import mjx


def make_step(model: mujoco.MjModel, substeps: int) -> Callable[[PhysicsState, jax.Array, jax.Array], PhysicsState]:
    """Return a control step of `substeps` MJX steps."""
    device_model = mjx.put_model(model)
    template = mjx.make_data(model)

    def step(state: PhysicsState, control: jax.Array, active: jax.Array) -> PhysicsState:
        data = advance(device_model, template, substeps, state, control)
        return keep(state, data, active, failed=jnp.zeros((), bool))

    return step


def advance(device_model: Any, template: Any, substeps: int, state: PhysicsState, control: jax.Array) -> Any:
    """Return a robot's `mjx.Data` after `substeps` steps of any implementation of MJX.

    Args:
        device_model: the model, as `mjx.put_model` gives it.
        template: `mjx.Data` for all that is not in `state`.
        substeps: number of steps.
        state: of one robot.
        control: f32[nu].
    """
    data = template.replace(
        qpos=state.qpos, qvel=state.qvel, act=state.act, qacc_warmstart=state.warmstart, time=state.time, ctrl=control
    )
    with jax.numpy_dtype_promotion("standard"):  # MJX mixes types
        return jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(device_model, d), data)


def keep(before: PhysicsState, data: Any, active: jax.Array, *, failed: jax.Array) -> PhysicsState:
    """Return the state that `mjx.Data` holds; the one before where the robot is inactive or diverged."""
    after = PhysicsState(data.qpos, data.qvel, data.act, data.qacc_warmstart, data.sensordata, data.time, before.diverged)
    after = contain_divergence(before, after, failed=failed)
    return jax.tree.map(lambda old, new: jnp.where(active, new, old), before, after)

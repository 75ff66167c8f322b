"""MuJoCo XLA behind the physics contract: pure JAX, forward-mode differentiable, for GPUs, TPUs and CPUs."""

import contextlib
import io
from collections.abc import Callable

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
        data = template.replace(
            qpos=state.qpos, qvel=state.qvel, act=state.act, qacc_warmstart=state.warmstart, time=state.time, ctrl=control
        )
        with jax.numpy_dtype_promotion("standard"):  # MJX mixes types
            data = jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(device_model, d), data)
        after = PhysicsState(data.qpos, data.qvel, data.act, data.qacc_warmstart, data.sensordata, data.time, state.diverged)
        after = contain_divergence(state, after, failed=jnp.zeros((), bool))
        return jax.tree.map(lambda old, new: jnp.where(active, new, old), state, after)

    return step

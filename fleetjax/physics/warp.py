"""MuJoCo Warp behind the physics contract: the implementation of MJX that NVIDIA GPUs run as CUDA kernels.

It steps all robots at once, and they share one store of contacts, so it must know how many there are: the rule for `vmap`
gathers them. Warp adds up in any order: the same step need not give the same bits twice. It has no derivatives.
"""

import functools
import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax.custom_batching import custom_vmap

from fleetjax.physics.base import check_backend
from fleetjax.physics.contract import PhysicsState
from fleetjax.physics.mjx import advance, keep, mjx

CONTACTS = 48  # room for each robot, which it may leave to others: MuJoCo Warp's default
CONSTRAINTS = 128  # rows for each robot: twice MuJoCo Warp's default, and three times what the tests' states need


def make_step(model: mujoco.MjModel, substeps: int) -> Callable[[PhysicsState, jax.Array, jax.Array], PhysicsState]:
    """Return a control step of `substeps` MuJoCo Warp steps. The model is put on the device when the step is first traced."""

    @functools.cache
    def on_device() -> Any:
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING  # else it prints on stdout which kernels it loads
        with jax.ensure_compile_time_eval():
            put = mjx.put_model(model, impl="warp")
            return put.tree_replace({"opt._impl.warn_overflow": 0})  # else kernels print that solvers stop early

    @functools.cache
    def template(num_robots: int) -> Any:
        with jax.ensure_compile_time_eval():
            return mjx.make_data(model, impl="warp", naconmax=CONTACTS * num_robots, njmax=CONSTRAINTS)

    @custom_vmap
    def step_all(states: PhysicsState, controls: jax.Array, active: jax.Array) -> PhysicsState:
        """Step robots [N]."""

        def step_one(state: PhysicsState, control: jax.Array, active: jax.Array) -> PhysicsState:
            data = advance(on_device(), template(len(controls)), substeps, state, control)
            absurd = ~jnp.all(jnp.isfinite(control))  # which Warp would take for the lower limit
            return keep(state, data, active, failed=absurd | _lost_contacts(data))

        return jax.vmap(step_one)(states, controls, active)

    @step_all.def_vmap
    def _(size: int, batched: Any, *robots: Any) -> tuple[PhysicsState, Any]:
        """Step robots [K, N] as [K N]."""
        full = jax.tree.map(lambda x, is_full: x if is_full else jnp.broadcast_to(x, (size, *x.shape)), robots, tuple(batched))
        after = step_all(*jax.tree.map(lambda x: x.reshape(size * x.shape[1], *x.shape[2:]), full))
        after = jax.tree.map(lambda x: x.reshape(size, len(x) // size, *x.shape[1:]), after)
        return after, jax.tree.map(lambda _: True, after)

    def step(state: PhysicsState, control: jax.Array, active: jax.Array) -> PhysicsState:
        if not importlib.util.find_spec("warp"):  # a fleet can be described, and its files read, without it
            return jax.pure_callback(_refuse, state, state, vmap_method="broadcast_all")
        alone = jax.tree.map(lambda x: jnp.asarray(x)[None], (state, control, active))
        return jax.tree.map(lambda x: x[0], step_all(*alone))

    return step


def _refuse(state: PhysicsState) -> PhysicsState:
    """Refuse to step.

    Raises:
        ValueError: with what is missing.
    """
    check_backend("warp")
    return state


def _lost_contacts(data: Any) -> jax.Array:
    """Return bool[], whether a store was too small for a robot's contacts; solvers may stop early, as in other backends."""
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    early = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS
    return (data._impl.overflow & ~int(early)) != 0

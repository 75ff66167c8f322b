"""MuJoCo's C engine behind the physics contract: a thread pool, reached from JAX by a callback.

The whole batch of robots crosses to the host once per control step. Robots that stand still are skipped, and
a diverged robot (MuJoCo resets it or stops it early) is recognised by its clock.
"""

import os
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.flatten_util import ravel_pytree
from mujoco import rollout

from fleetjax.physics.contract import PhysicsState, contain_divergence


def num_threads() -> int:
    """Return the number of simulation threads: `FLEETJAX_NUM_THREADS`, or the CPUs this process may use."""
    return int(os.environ.get("FLEETJAX_NUM_THREADS", 0)) or len(os.sched_getaffinity(0))


class _Simulator:
    """The host side: MuJoCo's thread pool and one `MjData` per thread."""

    def __init__(self, model: mujoco.MjModel, substeps: int):
        mujoco.set_mju_user_warning(lambda message: None)  # else divergence writes a log into the working folder
        model.vis.global_.bvactive = 0  # no bookkeeping for the viewer
        self.model, self.substeps = model, substeps
        threads = num_threads()
        self.data = [mujoco.MjData(model) for _ in range(threads)]
        self.pool = rollout.Rollout(nthread=threads)
        self.lock = threading.Lock()  # the pool serves one batch at a time

    def __call__(self, packed):
        """Step the active robots of a batch with any leading axes.

        Args:
            packed: f32[..., K], of each robot its state without `diverged`, then its control, then whether it is active.

        Returns:
            f32[..., K']: its state, then whether it failed.
        """
        flat = np.asarray(packed).reshape(-1, packed.shape[-1])
        rows = np.flatnonzero(flat[:, -1])
        after = np.concatenate([flat[:, : -1 - self.model.nu], np.zeros((len(flat), 1), np.float32)], axis=1)
        if rows.size:
            after[rows] = self._step(flat[rows].astype(np.float64))
        return after.reshape(*packed.shape[:-1], -1)

    def _step(self, robots):
        model, dt = self.model, self.model.opt.timestep
        nq, nv, na = model.nq, model.nv, model.na
        parts = np.cumsum([nq, nv, na, nv, model.nsensordata, 1, model.nu])
        qpos, qvel, act, warmstart, _, time, control, _ = np.split(robots, parts, axis=1)
        before = np.concatenate([time, qpos, qvel, act], axis=1)
        with self.lock:
            states, sensors = self.pool.rollout(
                self.model,
                self.data,
                before,
                np.repeat(control[:, None], self.substeps, axis=1),
                initial_warmstart=warmstart,
            )
        after = states[:, -1]
        previous = states[:, -2] if self.substeps > 1 else before
        velocity = slice(1 + nq, 1 + nq + nv)
        acceleration = (after[:, velocity] - previous[:, velocity]) / dt  # damping is explicit: exactly the solver's
        failed = np.abs(after[:, 0] - before[:, 0] - self.substeps * dt) > dt / 2
        return np.concatenate([after[:, 1:], acceleration, sensors[:, -1], after[:, :1], failed[:, None]], axis=1)


def make_step(model: mujoco.MjModel, substeps: int) -> Callable[[PhysicsState, jax.Array, jax.Array], PhysicsState]:
    """Return a control step of `substeps` MuJoCo steps, on the host.

    Raises:
        ValueError: if the model's integrator hides the solver's acceleration, which the warm start needs.
    """
    explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and (
        model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    )
    if not explicit:
        raise ValueError("integrator must be Euler with eulerdamp disabled, so that velocities give the warm start")
    simulator = _Simulator(model, substeps)

    def step(state: PhysicsState, control: jax.Array, active: jax.Array) -> PhysicsState:
        arrays = state._replace(diverged=())
        packed, unpack = ravel_pytree(arrays)  # one array each way: a callback costs time for every array
        packed = jnp.concatenate([packed, control, jnp.float32(active)[None]])
        result = jax.ShapeDtypeStruct((packed.size - model.nu,), jnp.float32)
        values = jax.pure_callback(simulator, result, packed, vmap_method="broadcast_all")
        after = unpack(values[:-1])._replace(diverged=state.diverged)
        after = contain_divergence(state, after, failed=values[-1] > 0)
        return after._replace(diverged=jnp.where(active, after.diverged, state.diverged))

    return step

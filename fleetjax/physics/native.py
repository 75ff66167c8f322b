"""MuJoCo's C engine behind the physics contract: a thread pool, reached from JAX by a callback.

The whole batch of robots crosses to the host once a control step. Robots that stand still are skipped, and
a diverged robot (MuJoCo resets it or stops it early) is recognised by its clock.
"""

import os
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from fleetjax.physics.contract import PhysicsState, contain_divergence


def num_threads() -> int:
    """Return the number of simulation threads: `FLEETJAX_NUM_THREADS`, or the CPUs this process may use."""
    return int(os.environ.get("FLEETJAX_NUM_THREADS", 0)) or len(os.sched_getaffinity(0))


class _Simulator:
    """The host side: MuJoCo's thread pool and one `MjData` a thread."""

    def __init__(self, model: mujoco.MjModel, substeps: int):
        mujoco.set_mju_user_warning(lambda message: None)  # else divergence writes a log into the working folder
        model.vis.global_.bvactive = 0  # no bookkeeping for the viewer
        self.model, self.substeps = model, substeps
        threads = num_threads()
        self.data = [mujoco.MjData(model) for _ in range(threads)]
        self.pool = rollout.Rollout(nthread=threads)
        self.lock = threading.Lock()  # the pool serves one batch at a time

    def __call__(self, qpos, qvel, act, warmstart, sensors, time, control, active):
        """Step the active robots of a batch with any leading axes; return the new values and who failed."""
        batch = np.shape(active)
        active = np.asarray(active).reshape(-1)
        rows = np.flatnonzero(active)
        flat = [np.array(x, np.float32).reshape(active.size, -1) for x in (qpos, qvel, act, warmstart, sensors, time)]
        failed = np.zeros(active.size, bool)
        if rows.size:
            control = np.asarray(control, np.float64).reshape(active.size, -1)[rows]
            before = np.concatenate([flat[5][rows], flat[0][rows], flat[1][rows], flat[2][rows]], axis=1, dtype=np.float64)
            results, failed[rows] = self._step(before, control, flat[3][rows].astype(np.float64))
            for values, result in zip(flat, results, strict=True):
                values[rows] = result
        return tuple(x.reshape(np.shape(y)) for x, y in zip(flat, (qpos, qvel, act, warmstart, sensors, time), strict=True)), (
            failed.reshape(batch)
        )

    def _step(self, before, control, warmstart):
        nq, nv, dt = self.model.nq, self.model.nv, self.model.opt.timestep
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
        return (
            after[:, 1 : 1 + nq],
            after[:, velocity],
            after[:, 1 + nq + nv :],
            acceleration,
            sensors[:, -1],
            after[:, :1],
        ), failed


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
        arrays = state[:-1]
        shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays)
        after, failed = jax.pure_callback(
            simulator, (shapes, jax.ShapeDtypeStruct((), bool)), *arrays, control, active, vmap_method="broadcast_all"
        )
        after = contain_divergence(state, PhysicsState(*after, diverged=state.diverged), failed=failed)
        return after._replace(diverged=jnp.where(active, after.diverged, state.diverged))

    return step

"""Humanoid: 21 torque motors, run forward without falling (paper, Section 5.1; 108 observations).

Differences from the Isaac Gym task, where a reading of it was unclear or mistaken: the angle to the target is
measured in the ground plane; the sensed joint force is that of motor, spring and damper; a foot sensor reads
the wrench between foot and shin.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import expert_records
from fleetjax.envs import base
from fleetjax.envs.rotation import rotation_matrix
from fleetjax.physics.base import Physics, PhysicsState, make_physics
from fleetjax.types import EnvState

HORIZON = 999
FALL_HEIGHT = 0.8  # m, of the torso
TARGET = (1000.0, 0.0)  # m, in the ground plane
SUBSTEPS = 3
SUCCESS_FLOOR = 6000.0  # episode return


def make_env(*, backend: str = "auto", success_return: float | None = None) -> base.Env:
    """Build the humanoid environment.

    Args:
        backend: physics backend.
        success_return: return above which an episode of full length succeeds; None takes the larger of 6000
            and 95 % of the shipped expert's mean return over episodes of full length.
    """
    if success_return is None:
        success_return = expert_records.success_return("humanoid", SUCCESS_FLOOR)
    physics = make_physics("humanoid.xml", substeps=SUBSTEPS, backend=backend)
    spec = base.EnvSpec(
        "humanoid",
        108,
        physics.model.nu,
        HORIZON,
        physics.control_step,
        supervisor="humanoid",
        success_return=success_return,
    )
    joints = _Joints(physics.model)

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del robot  # every robot starts from the same distribution
        noise = jax.random.uniform(key, (2, 21), minval=-1.0, maxval=1.0)
        angles = jnp.clip(0.2 * noise[0], joints.low, joints.high)
        body = physics.initial._replace(
            qpos=physics.initial.qpos.at[7:].set(angles), qvel=physics.initial.qvel.at[6:].set(0.1 * noise[1])
        )
        return base.begin(body, observe(joints, body, jnp.zeros(21)))

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del key  # deterministic
        action = jnp.clip(action, -1.0, 1.0)
        body = physics.step(state.physics, action, active)
        obs = observe(joints, body, jnp.nan_to_num(action))  # an action that is no number makes the body diverge
        violation = (body.qpos[2] < FALL_HEIGHT) | body.diverged
        reward = jnp.where(violation, -1.0, _reward(joints, physics, state.physics, body, obs, action))
        return base.proceed(
            state, physics=body, obs=obs, reward=reward, violation=violation, horizon=HORIZON, success_return=success_return
        )

    return base.Env(reset, step, spec, scene=base.Scene(physics.model, lambda state: (state.physics.qpos, jnp.zeros((0, 7)))))


class _Joints:
    """Limits, gears, springs and dampers of the 21 hinges, in action order."""

    def __init__(self, model):
        self.low, self.high = (np.asarray(x, np.float32) for x in model.jnt_range[1:].T)
        self.gear = np.asarray(model.actuator_gear[:, 0], np.float32)
        self.stiffness = np.asarray(model.jnt_stiffness[1:], np.float32)
        self.damping = np.asarray(model.dof_damping[6:], np.float32)
        self.effort = self.gear / self.gear.max()


def observe(joints: _Joints, body: PhysicsState, action: jax.Array) -> jax.Array:
    """Return the observation f32[108] of a body to which `action` f32[21] was last applied.

    Entries: 0 height (m); 1-3 linear velocity (m/s) and 4-6 angular velocity (rad/s, x 0.25) in the torso
    frame; 7 yaw, 8 roll, 9 angle to the target (rad); 10 up projection; 11 heading projection; 12-32 joint angles, limits
    at -1 and 1; 33-53 joint velocities (rad/s, x 0.1); 54-74 joint torques (N m, x 0.01); 75-86 right, then left
    foot's force and torque (N, N m, x 0.01); 87-107 the action.
    """
    angles, velocities = body.qpos[7:], body.qvel[6:]
    rotation = rotation_matrix(body.qpos[3:7])
    yaw = jnp.arctan2(rotation[1, 0], rotation[0, 0])
    roll = jnp.arctan2(rotation[2, 1], rotation[2, 2])
    to_target = jnp.asarray(TARGET) - body.qpos[:2]
    bearing = jnp.arctan2(to_target[1], to_target[0]) - yaw
    bearing = jnp.arctan2(jnp.sin(bearing), jnp.cos(bearing))
    heading = rotation[:2, 0] @ to_target / jnp.linalg.norm(to_target)
    torques = action * joints.gear - joints.stiffness * angles - joints.damping * velocities
    return jnp.concatenate(
        [
            body.qpos[2:3],
            rotation.T @ body.qvel[:3],
            0.25 * body.qvel[3:6],
            jnp.stack([yaw, roll, bearing, rotation[2, 2], heading]),
            (2 * angles - joints.high - joints.low) / (joints.high - joints.low),
            0.1 * velocities,
            0.01 * torques,
            0.01 * body.sensors,
            action,
        ]
    )


def forward_speed(state: EnvState) -> jax.Array:
    """Return the torso's velocity along the axis to the target, f32[] (m/s)."""
    return state.physics.qvel[0]


def _reward(joints: _Joints, physics: Physics, before: PhysicsState, after: PhysicsState, obs, action) -> jax.Array:
    """Return the reward of a step that did not end in a fall."""
    x0, y0, x1, y1 = *before.qpos[:2], *after.qpos[:2]
    far0, far1 = jnp.hypot(TARGET[0] - x0, y0), jnp.hypot(TARGET[0] - x1, y1)
    # far0 - far1 by the difference of squares: two nearly equal kilometres cancel badly in float32.
    progress = ((x1 - x0) * (2 * TARGET[0] - x0 - x1) + (y0 - y1) * (y0 + y1)) / (far0 + far1)
    heading = jnp.where(obs[11] > 0.8, 1.0, obs[11] / 0.8)
    at_limit = jnp.maximum(jnp.abs(obs[12:33]) - 0.98, 0.0) / 0.02
    return (
        progress / physics.control_step
        + 2.0
        + jnp.where(obs[10] > 0.93, 0.1, 0.0)
        + 0.5 * heading
        - 0.01 * jnp.sum(action**2)
        - 0.05 * jnp.sum(jnp.abs(action * obs[33:54]) * joints.effort)
        - 0.25 * jnp.sum(at_limit * joints.effort)
    )

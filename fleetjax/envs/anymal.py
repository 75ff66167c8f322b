"""ANYmal: a quadruped with 12 position servos walks as it is told (paper, Section 5.1; 48 observations).

Differences from the Isaac Gym task, where a reading of it was unclear or mistaken: gravity is rotated into the base's
frame by the inverse of the base's orientation; the torques that the reward punishes are the servos', not readings that
are always zero; a contact is felt where the floor pushes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import expert_records
from fleetjax.envs import base
from fleetjax.envs.rotation import rotation_matrix
from fleetjax.physics.base import PhysicsState, make_physics
from fleetjax.types import EnvState

HORIZON = 2501
SUBSTEPS = 4
SUCCESS_FLOOR = 60.0  # episode return; 75 is ideal
CONTACT_FORCE = 1.0  # N, above which the floor's push on base or thigh is a violation
DEFAULT_ANGLES = np.array([0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8], np.float32)  # rad
ACTION_SCALE = 0.5  # rad
COMMAND_RANGE = np.array([2.0, 1.0, 1.0], np.float32)  # m/s forward, m/s to the left, rad/s about the vertical
STIFFNESS, DAMPING, LARGEST_TORQUE = 85.0, 2.0, 80.0  # N m/rad, N m s/rad, N m
SPREAD = 0.25  # of the tracking rewards, (m/s)^2 and (rad/s)^2


class Walker(NamedTuple):
    """A robot's body and what it is told to do.

    Attributes:
        body: the simulated robot.
        command: f32[3] velocity forward and to the left (m/s), yaw rate (rad/s); the same for a whole episode.
    """

    body: PhysicsState
    command: jax.Array


def make_env(*, backend: str = "auto", success_return: float | None = None) -> base.Env:
    """Build the ANYmal environment.

    Args:
        backend: physics backend.
        success_return: return above which an episode of full length succeeds; None takes the larger of 60
            and 95 % of the shipped expert's mean return over episodes of full length.
    """
    if success_return is None:
        success_return = expert_records.success_return("anymal", SUCCESS_FLOOR)
    physics = make_physics("anymal.xml", substeps=SUBSTEPS, backend=backend)
    spec = base.EnvSpec(
        "anymal",
        48,
        physics.model.nu,
        HORIZON,
        physics.control_step,
        supervisor="anymal",
        success_return=success_return,
    )

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del robot  # every robot starts from the same distribution
        draw = jax.random.uniform(key, (27,))
        angles, speeds, command = (
            DEFAULT_ANGLES * (0.5 + draw[:12]),
            0.2 * draw[12:24] - 0.1,
            (2 * draw[24:] - 1) * COMMAND_RANGE,
        )
        body = physics.initial._replace(
            qpos=physics.initial.qpos.at[7:].set(angles), qvel=physics.initial.qvel.at[6:].set(speeds)
        )
        walker = Walker(body, command)
        return base.begin(walker, observe(walker, jnp.zeros(12)))

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del key  # deterministic
        action = jnp.clip(action, -1.0, 1.0)
        target = targets(action)
        walker = state.physics._replace(body=physics.step(state.physics.body, target, active))
        violation = jnp.any(walker.body.sensors > CONTACT_FORCE) | walker.body.diverged
        return base.proceed(
            state,
            physics=walker,
            obs=observe(walker, jnp.nan_to_num(action)),  # an action that is no number makes the body diverge
            reward=jnp.where(walker.body.diverged, 0.0, physics.control_step * _reward(walker, target)),
            violation=violation,
            horizon=HORIZON,
            success_return=success_return,
        )

    return base.Env(
        reset, step, spec, scene=base.Scene(physics.model, lambda state: (state.physics.body.qpos, jnp.zeros((0, 7))))
    )


def targets(action: jax.Array) -> jax.Array:
    """Return the angles f32[12] (rad) that the servos hold for an action f32[12] in [-1, 1]."""
    return jnp.asarray(DEFAULT_ANGLES) + ACTION_SCALE * action


def base_velocity(body: PhysicsState) -> tuple[jax.Array, jax.Array]:
    """Return linear (m/s) and angular (rad/s) velocity f32[3] of the base, in its own frame."""
    return rotation_matrix(body.qpos[3:7]).T @ body.qvel[:3], body.qvel[3:6]


def tracking_error(state: EnvState) -> jax.Array:
    """Return by how much the base misses the commanded velocity in the plane, f32[] (m/s)."""
    linear, _ = base_velocity(state.physics.body)
    return jnp.linalg.norm(linear[:2] - state.physics.command[:2])


def observe(walker: Walker, action: jax.Array) -> jax.Array:
    """Return the observation f32[48] of a robot to which `action` f32[12] was last applied, clipped to [-5, 5].

    Entries: 0-2 linear velocity (m/s, x 2) and 3-5 angular velocity (rad/s, x 0.25) and 6-8 the direction of gravity, all
    in the base's frame; 9-11 the command (x 2, 2, 0.25); 12-23 joint angles, less the default ones (rad); 24-35 joint
    velocities (rad/s, x 0.05); 36-47 the action.
    """
    body = walker.body
    linear, angular = base_velocity(body)
    entries = [
        2.0 * linear,
        0.25 * angular,
        -rotation_matrix(body.qpos[3:7])[2],
        walker.command * jnp.array([2.0, 2.0, 0.25]),
        body.qpos[7:] - DEFAULT_ANGLES,
        0.05 * body.qvel[6:],
        action,
    ]
    return jnp.clip(jnp.concatenate(entries), -5.0, 5.0)


def _reward(walker: Walker, target: jax.Array) -> jax.Array:
    """Return the reward per second."""
    body = walker.body
    linear, angular = base_velocity(body)
    missed = jnp.sum((linear[:2] - walker.command[:2]) ** 2)
    turned = (angular[2] - walker.command[2]) ** 2
    torques = jnp.clip(STIFFNESS * (target - body.qpos[7:]) - DAMPING * body.qvel[6:], -LARGEST_TORQUE, LARGEST_TORQUE)
    reward = jnp.exp(-missed / SPREAD) + 0.5 * jnp.exp(-turned / SPREAD) - 2.5e-5 * jnp.sum(torques**2)
    return jnp.maximum(reward, 0.0)

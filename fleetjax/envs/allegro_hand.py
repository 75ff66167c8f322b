"""Allegro hand: 16 position servos turn a cube to random orientations, one goal after the other (paper, Section 5.1).

An action changes the angles that the servos hold. The Isaac Gym task has this as an option (`useRelativeControl`), off by
default; policies that set the angles themselves cannot be cloned from a few episodes. Other differences from that task, where a
reading of it was unclear or mistaken: joint torques are the servos', not readings that are always zero; no joint starts outside
its limits; an episode starts with the cube at rest in the hand.
"""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.envs import base
from fleetjax.envs.rotation import angle_between, conjugate, multiply, rotation_matrix, sine_of_half_angle
from fleetjax.physics.base import MODELS, PhysicsState, make_physics
from fleetjax.types import EnvState

HORIZON = 600
SUBSTEPS = 4
LARGEST_CHANGE = 0.3  # of a target in a control step, in halves of its joint's range
GOAL_POSITION = np.array([0.0, -0.2, 0.52], np.float32)  # m
SHOWN_AT = np.array([-0.16, -0.2, 0.6], np.float32)  # m, where pictures show the goal
TOLERANCE = 0.1  # rad, within which a goal is reached
DROP_DISTANCE = 0.24  # m from the goal's position, at which the cube counts as dropped
STIFFNESS, DAMPING, LARGEST_TORQUE = 3.0, 0.1, 0.5  # N m/rad, N m s/rad, N m
QUADRUPLES = np.array(list(itertools.combinations_with_replacement(range(3), 4)))  # of axes, whose products are moments
SETTLED = MODELS / "allegro_hand_settled.npz"  # written by experiments/settle_cubes.py


class Hand(NamedTuple):
    """Hand and cube, and the orientation that the cube is to be turned to.

    Attributes:
        body: the simulated hand (joints 0 to 15) and cube (a free joint).
        goal: f32[4] unit quaternion.
        target: f32[16] what the servos hold, the joints' limits at -1 and 1.
    """

    body: PhysicsState
    goal: jax.Array
    target: jax.Array


def make_env(*, backend: str = "auto", tolerance: float = TOLERANCE) -> base.Env:
    """Build the environment of hand and cube.

    Args:
        backend: physics backend.
        tolerance: rad, within which a goal is reached.
    """
    physics = make_physics("allegro_hand.xml", substeps=SUBSTEPS, backend=backend)
    spec = base.EnvSpec(
        "allegro_hand", 88, physics.model.nu, HORIZON, physics.control_step, has_goal=True, supervisor="allegro_hand"
    )
    low, high = (jnp.asarray(x, jnp.float32) for x in physics.model.jnt_range[:16].T)
    with np.load(SETTLED, allow_pickle=False) as arrays:
        settled = jnp.asarray(arrays["qpos"])

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del robot  # every robot starts from the same distribution
        key_start, key_goal = jax.random.split(key)
        start = settled[jax.random.randint(key_start, (), 0, settled.shape[0])]
        target = jnp.clip(2 * (start[:16] - low) / (high - low) - 1, -1.0, 1.0)  # holds the fingers where they are
        hand = Hand(physics.initial._replace(qpos=start), draw_orientation(key_goal), target)
        return base.begin(hand, observe(hand, low, high))

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del key  # deterministic
        action = jnp.clip(action, -1.0, 1.0)
        target = jnp.clip(state.physics.target + LARGEST_CHANGE * action, -1.0, 1.0)
        body = physics.step(state.physics.body, angles(target, low, high), active)
        hand = state.physics._replace(body=body, target=jnp.nan_to_num(target))  # a NaN action makes the body diverge
        distance = jnp.linalg.norm(hand.body.qpos[16:19] - GOAL_POSITION)
        violation = (distance >= DROP_DISTANCE) | hand.body.diverged
        angle = angle_between(hand.body.qpos[19:23], hand.goal)
        success = angle <= tolerance
        reward = -10.0 * distance + 1.0 / (angle + 0.1) - 2e-4 * jnp.sum(action**2) + jnp.where(success, 250.0, 0.0)
        return base.proceed(
            state,
            physics=hand,
            obs=observe(hand, low, high),
            reward=jnp.where(hand.body.diverged, 0.0, reward),
            violation=violation,
            success=success,
            horizon=HORIZON,
        )

    def next_goal(state: EnvState, key: jax.Array) -> EnvState:
        hand = state.physics._replace(goal=draw_orientation(key))
        return state._replace(physics=hand, obs=observe(hand, low, high))

    def pose(state: EnvState) -> tuple[jax.Array, jax.Array]:
        return state.physics.body.qpos, jnp.concatenate([SHOWN_AT, state.physics.goal])[None]

    def success_margin(state: EnvState) -> jax.Array:
        return 1.0 - sine_of_half_angle(state.physics.body.qpos[19:23], state.physics.goal) / np.sin(tolerance / 2)

    return base.Env(reset, step, spec, next_goal, base.Scene(physics.model, pose), success_margin=success_margin)


def angles(target: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the angles f32[16] (rad) that a target f32[16] in [-1, 1] stands for, given the joints' limits."""
    return low + (target + 1) / 2 * (high - low)


def draw_orientation(key: jax.Array) -> jax.Array:
    """Return a random orientation f32[4]: a turn about the world's y, then one about its x, each uniform in [-pi, pi]."""
    half = jnp.pi / 2 * jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
    zero = jnp.zeros(())
    about_x = jnp.stack([jnp.cos(half[0]), jnp.sin(half[0]), zero, zero])
    about_y = jnp.stack([jnp.cos(half[1]), zero, jnp.sin(half[1]), zero])
    return multiply(about_x, about_y)


def observe(hand: Hand, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the observation f32[88] of a hand, given its joints' limits (rad), clipped to [-5, 5].

    Entries: 0-15 joint angles, limits at -1 and 1; 16-31 joint velocities (rad/s, x 0.2); 32-47 the servos' torques (N m,
    x 10); cube: 48-50 position (m), 51-54 orientation (x, y, z, w), 55-57 velocity (m/s), 58-60 angular velocity (rad/s,
    x 0.2), both in the world's frame; goal: 61-63 position (m), 64-67 orientation; 68-71 the turn from goal to cube; 72-87
    the servos' targets.
    """
    body = hand.body
    joints, velocities, orientation = body.qpos[:16], body.qvel[:16], body.qpos[19:23]
    torques = jnp.clip(
        STIFFNESS * (angles(hand.target, low, high) - joints) - DAMPING * velocities, -LARGEST_TORQUE, LARGEST_TORQUE
    )
    entries = [
        (2 * joints - high - low) / (high - low),
        0.2 * velocities,
        10.0 * jnp.clip(torques, -LARGEST_TORQUE, LARGEST_TORQUE),
        body.qpos[16:19],
        _scalar_last(orientation),
        body.qvel[16:19],
        0.2 * rotation_matrix(orientation) @ body.qvel[19:22],
        jnp.asarray(GOAL_POSITION),
        _scalar_last(hand.goal),
        _scalar_last(multiply(orientation, conjugate(hand.goal))),
        hand.target,
    ]
    return jnp.clip(jnp.concatenate(entries), -5.0, 5.0)


@functools.partial(jnp.vectorize, signature="(88)->(85)")
def view(obs: jax.Array) -> jax.Array:
    """Return what the expert sees f32[..., 85] of an observation f32[..., 88].

    A cube that is turned onto itself lies in the hand as before, and what is left to turn does not change: of its
    orientation only how edges lie matters, not which face is where. So a policy that sees the turn to the goal in the
    world's frame, and edges without names, knows what to do for 24 orientations once it knows it for one.

    Entries: 0-31 joint angles and velocities; 32-34 the cube's distance from the goal's position; 35-49 fourth moments of its
    edges' directions; 50-55 the edge nearest to the world's x and the one nearest to its z, each as a unit vector; 56-61
    velocity and angular velocity; 62-64 the turn that is left as a rotation vector (rad), 65 its angle; 66-68 the same vector
    on a scale on which the last tenth of a radian is half of all; 69-84 the servos' targets.
    """
    orientation, missing = jnp.roll(obs[51:55], 1), conjugate(jnp.roll(obs[68:72], 1))
    edges = rotation_matrix(orientation)  # in columns
    moments = jnp.sum(jnp.prod(edges[QUADRUPLES], axis=1), axis=1)
    upright = jnp.argmax(jnp.abs(edges[2]))
    sideways = jnp.argmax(jnp.where(jnp.arange(3) == upright, -1.0, jnp.abs(edges[0])))
    along_z = edges[:, upright] * jnp.sign(edges[2, upright])
    along_x = edges[:, sideways] * jnp.sign(edges[0, sideways])
    turn = missing[1:] * jnp.where(missing[0] < 0, -1.0, 1.0)
    sine = jnp.minimum(1.0, jnp.linalg.norm(turn))
    angle = 2.0 * jnp.arcsin(sine)
    turn = turn / jnp.maximum(sine, 1e-6) * angle
    position = obs[48:51] - obs[61:64]
    fine = turn / (angle + TOLERANCE)
    return jnp.concatenate([obs[:32], position, moments, along_x, along_z, obs[55:61], turn, angle[None], fine, obs[72:]])


def _scalar_last(quaternion: jax.Array) -> jax.Array:
    return jnp.roll(quaternion, -1)

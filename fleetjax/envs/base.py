"""The contract that every environment meets, and the registry of environments."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from fleetjax.types import EnvState


class EnvSpec(NamedTuple):
    """What the fleet must know of an environment before it runs.

    Attributes:
        name: the registered name, or any name for an unregistered environment.
        observation_size: O.
        action_size: A; for discrete actions the number of choices (actions are then one-hot f32[A]).
        horizon: control steps after which an episode times out.
        control_step: seconds between two actions.
        discrete: whether actions are choices rather than vectors in [-1, 1].
        has_goal: whether `success` means that a goal was reached, so that a goal critic can learn from it.
        supervisor: registered name of the supervisor that helps by default.
        image_shape: height, width and channels if the observation is an image: its pixel values, whole numbers from 0 to
            255, row by row; None if it is not.
        success_return: the default of the configuration's field of that name: the return above which an episode of full length
            succeeds; None if the environment says itself what a success is.
    """

    name: str
    observation_size: int
    action_size: int
    horizon: int
    control_step: float
    discrete: bool = False
    has_goal: bool = False
    supervisor: str = ""
    image_shape: tuple[int, int, int] | None = None
    success_return: float | None = None


class Scene(NamedTuple):
    """How an environment is drawn.

    Attributes:
        model: MuJoCo model with a camera named `track`.
        pose: `EnvState -> (f32[nq], f32[nmocap, 7])`, positions of its joints, and of what is only shown.
    """

    model: mujoco.MjModel
    pose: Callable[[EnvState], tuple[jax.Array, jax.Array]]


class Env(NamedTuple):
    """Pure functions of one robot's task. It never resets itself. Robots compete for the humans who reset them.

    Attributes:
        reset: `(key, robot i32[]) -> EnvState`, a draw from the initial distribution of that robot.
        step: `(EnvState, action f32[A], active bool[], key) -> EnvState`. What it returns for an inactive robot is
            ignored; a physics backend may skip the work.
        spec: static facts.
        next_goal: `(EnvState, key) -> EnvState` draws a new goal after a success and lets the episode go on;
            None if a success ends the episode.
        scene: how to draw its bodies; None if there are none.
        picture: `EnvState -> u8[H, W, 3]`, what people see of it where there is no scene; None if nothing.
        success_margin: `EnvState -> f32[]` how far a step went beyond success, in units of its tolerance: positive where
            `success`, negative elsewhere; None if the environment judges by returns, or success cannot be relaxed.
    """

    reset: Callable[[jax.Array, jax.Array], EnvState]
    step: Callable[[EnvState, jax.Array, jax.Array, jax.Array], EnvState]
    spec: EnvSpec
    next_goal: Callable[[EnvState, jax.Array], EnvState] | None = None
    scene: Scene | None = None
    picture: Callable[[EnvState], jax.Array] | None = None
    success_margin: Callable[[EnvState], jax.Array] | None = None


def begin(physics: Any, obs: jax.Array) -> EnvState:
    """Return the first state of an episode.

    Args:
        physics: the environment's inner state.
        obs: f32[O] its observation.
    """
    no, zero = jnp.zeros((), bool), jnp.zeros((), jnp.float32)
    return EnvState(physics, obs, zero, no, no, no, zero, jnp.zeros((), jnp.int32))


def proceed(
    state: EnvState,
    *,
    physics: Any,
    obs: jax.Array,
    reward: jax.Array,
    violation: jax.Array,
    horizon: int,
    success: jax.Array | None = None,
    success_return: float | None = None,
) -> EnvState:
    """Return the successor of `state`, with the episode's accounts brought up to date.

    A violation beats success and time-out. Locomotion passes `success_return`: success is then judged on the
    step that reaches the horizon.

    Args:
        state: the state that was stepped.
        physics: the successor's inner state.
        obs: f32[O] the successor's observation.
        reward: f32[] reward of the step.
        violation: bool[] whether the successor violates the constraint.
        horizon: control steps in an episode.
        success: bool[] whether the step completed the task.
        success_return: the undiscounted return above which an episode of full length succeeds.
    """
    episode_return = state.episode_return + reward
    episode_step = state.episode_step + 1
    timeout = (episode_step >= horizon) & ~violation
    if success is None:
        needed = jnp.inf if success_return is None else success_return
        succeeded = timeout & (episode_return > jnp.float32(needed))
    else:
        succeeded = success & ~violation
    return EnvState(physics, obs, reward, violation, succeeded, timeout, episode_return, episode_step)

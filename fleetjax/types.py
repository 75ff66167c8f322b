"""The pytrees that cross module borders.

Shapes are of one robot, human or timestep; inside the fleet loop they carry leading axes N or M, after a
scan T. All are NamedTuples: immutable, with `_replace`.
"""

from typing import Any, NamedTuple

import jax


class EnvState(NamedTuple):
    """State of one robot's Markov decision process (paper, Section 3).

    Attributes:
        physics: whatever the environment needs to go on.
        obs: f32[O] observation of the present state.
        reward: f32[] reward of the last step, 0 after a reset.
        violation: bool[] the constraint indicator c(s); only a hard reset ends it.
        success: bool[] the last step completed the task.
        timeout: bool[] the last step reached the horizon without violation.
        episode_return: f32[] undiscounted sum of rewards since the reset.
        episode_step: i32[] control steps since the reset.
    """

    physics: Any
    obs: jax.Array
    reward: jax.Array
    violation: jax.Array
    success: jax.Array
    timeout: jax.Array
    episode_return: jax.Array
    episode_step: jax.Array


class HumanState(NamedTuple):
    """Whom each human helps.

    Attributes:
        robot: i32[M] index of the robot, -1 = free.
        duration: i32[M] timesteps of the ongoing intervention completed so far.
    """

    robot: jax.Array
    duration: jax.Array


class Signals(NamedTuple):
    """What a priority function may look at, for each robot.

    Attributes:
        violation: bool[N] the constraint indicator c(s).
        uncertainty: f32[N] disagreement of the policy ensemble, in [0, 1].
        risk: f32[N] probability of a constraint violation by the safety critic; 0 without one.
        goal: f32[N] probability of success by the goal critic; 0 without one.
        timestep: i32[] timesteps since the fleet started.
    """

    violation: jax.Array
    uncertainty: jax.Array
    risk: jax.Array
    goal: jax.Array
    timestep: jax.Array

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
    """What a rule may look at, for each robot.

    Attributes:
        violation: bool[N] the constraint indicator c(s).
        uncertainty: f32[N] disagreement of the policy ensemble, in [0, 1]; entropy in nats where actions are discrete.
        risk: f32[N] the safety critic's estimate, in [0, 1], of how near a violation is: discounted, and higher than the true
            probability; 0 without one.
        goal: f32[N] probability of success by the goal critic; 0 without one.
        timestep: i32[] timesteps since the fleet started.
        estimates: f32[N] of each estimator that the algorithm names, by name.
        obs: f32[N, O] what the robots see.
        robot_action: f32[N, A] what the robots' policy would do.
        helped: bool[N] whether a human helped the robot at the last timestep.
        help_time: i32[N] timesteps of that help so far; 0 without help.
        given: bool[N] whether a human's action was done at the last timestep. A human may help and not act: in a hard reset,
            before it has taken over, or over a link that does not work.
        correction: f32[N] mean squared difference between the human's and the robot's action, if the robot was teleoperated
            at the last timestep; else 0. It is also 0 where both did the same, as discrete actions often are.
        human_action: f32[N, A] what the supervisor would do; None unless the algorithm has `sees_supervisor`.
        link: f32[N] chance that the link to each robot works at this timestep; 1 with `link_model = "perfect"`.
        episode_step: i32[N] control steps of the robot since its reset.
    """

    violation: jax.Array
    uncertainty: jax.Array
    risk: jax.Array
    goal: jax.Array
    timestep: jax.Array
    estimates: Any = None
    obs: Any = None
    robot_action: Any = None
    helped: Any = None
    help_time: Any = None
    given: Any = None
    correction: Any = None
    human_action: Any = None
    link: Any = None
    episode_step: Any = None


class Plan(NamedTuple):
    """Which human helps which robot at this timestep.

    Attributes:
        signals: Signals[N] that the scores were made from.
        robot_action: f32[N, A] what the robots' policy would do.
        score: f32[N] priorities.
        humans: HumanState[M], the allocation; `duration` counts the timesteps before this one.
        teleoperated: bool[N] robots that a human teleoperates.
        resetting: bool[N] robots that a human resets.
        weight: f32[N] how much of a human each robot gets, in the soft allocation; None in the hard one.
    """

    signals: Signals
    robot_action: jax.Array
    score: jax.Array
    humans: HumanState
    teleoperated: jax.Array
    resetting: jax.Array
    weight: Any = None


class Interventions(NamedTuple):
    """Whom each human teleoperates at a timestep, and what came of it; [M], after a run [T, M].

    Attributes:
        robot: i32 index of the robot, -1 = the human teleoperates nobody, and the rest is of no meaning.
        priority: f32 the robot's score.
        step: i32 its control steps since its reset, before this one.
        obs: f32[O] what the human and the robot's policy saw.
        robot_action: f32[A] what the policy would have done.
        human_action: f32[A] what was done.
        next_obs: f32[O] after it, before any reset or new goal.
        reward: f32 of that step.
        violation: bool whether it led to a violation.
        success: bool whether it completed the task.
        timeout: bool whether it reached the horizon.
    """

    robot: jax.Array
    priority: jax.Array
    step: jax.Array
    obs: jax.Array
    robot_action: jax.Array
    human_action: jax.Array
    next_obs: jax.Array
    reward: jax.Array
    violation: jax.Array
    success: jax.Array
    timeout: jax.Array

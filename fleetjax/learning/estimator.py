"""What an estimator is: a number that is learnt for each robot while the fleet runs, for rules to look at."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from fleetjax.learning.imitation import HumanData, PolicyState


class Step(NamedTuple):
    """One step of every robot; every array has a leading axis N.

    Attributes:
        obs: f32[O] before the step.
        action: f32[A] what was done.
        next_obs: f32[O] after it, before any reset or new goal.
        violation: bool[] whether it led to a violation.
        success: bool[] whether it completed the task.
        robot_action: f32[A] what the robot's policy would have done.
        given: bool[] whether a human did it.
    """

    obs: jax.Array
    action: jax.Array
    next_obs: jax.Array
    violation: jax.Array
    success: jax.Array
    robot_action: jax.Array
    given: jax.Array


class Estimator(NamedTuple):
    """Pure functions of one number that is learnt.

    Attributes:
        init: `(key, HumanData, PolicyState) -> state`, at t = 0, pre-trained if it needs that.
        value: `(state, PolicyState, obs f32[N, O], robot_action f32[N, A]) -> f32[N]`.
        append: `(state, Step[N], moving bool[N]) -> state` takes in the steps of the robots that moved.
        update: `(state, PolicyState, HumanData, key) -> state`, one gradient step.
    """

    init: Callable[[jax.Array, HumanData, PolicyState], Any]
    value: Callable[[Any, PolicyState, jax.Array, jax.Array], jax.Array]
    append: Callable[[Any, Step, jax.Array], Any]
    update: Callable[[Any, PolicyState, HumanData, jax.Array], Any]

"""Numbers that are learnt for each robot while the fleet runs, for rules to look at: risk, chance of the goal, and others."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.learning import critic, pretraining
from fleetjax.learning.imitation import HumanData, Learner, PolicyState
from fleetjax.registry import Registry
from fleetjax.supervisors import Supervisor
from fleetjax.types import EnvState


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


ESTIMATORS: Registry[Callable[[Config, Env, Learner, Supervisor], Estimator]] = Registry("estimator")


def register_estimator(name: str, make_estimator: Callable[[Config, Env, Learner, Supervisor], Estimator]) -> None:
    """Make an estimator available to algorithms, which name it in `Algorithm.estimators`.

    Args:
        name: its key in `Signals.estimates`.
        make_estimator: `(config, env, learner, supervisor) -> Estimator`.

    Raises:
        ValueError: if the name is taken.
    """
    ESTIMATORS.register(name, make_estimator)


def _of_critic(kind: str) -> Callable[[Config, Env, Learner, Supervisor], Estimator]:
    """Return the maker of an estimator by a twin critic.

    Offline, the cloned policy acts for the safety critic, and the supervisor acts for the goal critic.

    Reference: paper, Section 4.2 and Appendix (training critic Q-functions).
    """

    def make(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
        twins = critic.make_critic(kind, config, env.spec, learner)

        def init(key: jax.Array, data: HumanData, policy: PolicyState) -> critic.CriticState:
            del data

            def act(state: EnvState, key: jax.Array) -> jax.Array:
                if kind == "safety":
                    return learner.predict(policy, state.obs)[0]
                return jax.vmap(supervisor.act)(state, jax.random.split(key, state.obs.shape[0]))

            key_networks, key_transitions, key_train = jax.random.split(key, 3)
            store = twins.init(key_networks)
            store = pretraining.collect_transitions(config, env, act, twins.append, store, key_transitions)
            return critic.train(twins, store, policy, config.critic_pretraining_steps, key_train)

        def value(state: critic.CriticState, policy: PolicyState, obs: jax.Array, robot_action: jax.Array) -> jax.Array:
            return twins.value(state, policy.normalizer, obs, robot_action)

        def append(state: critic.CriticState, steps: Step, moving: jax.Array) -> critic.CriticState:
            return twins.append(state, critic.Transition(*steps[: len(critic.Transition._fields)]), moving)

        def update(state: critic.CriticState, policy: PolicyState, data: HumanData, key: jax.Array) -> critic.CriticState:
            del data
            return twins.update(state, policy, key)

        return Estimator(init, value, append, update)

    return make


for _kind in ("safety", "goal"):
    register_estimator(_kind, _of_critic(_kind))

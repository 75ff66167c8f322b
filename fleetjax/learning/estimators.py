"""Estimators by name, and those of the paper: risk and chance of the goal, by critics."""

from collections.abc import Callable

import jax

from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.learning import critic, help, novelty, pretraining
from fleetjax.learning.estimator import Estimator, Step
from fleetjax.learning.imitation import HumanData, Learner, PolicyState
from fleetjax.registry import Registry
from fleetjax.supervisors import Supervisor
from fleetjax.types import EnvState

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


_SHIPPED = {
    "safety": _of_critic("safety"),
    "goal": _of_critic("goal"),
    "discrepancy": help.make_discrepancy,
    "mean_discrepancy": help.make_mean_discrepancy,
    "intervention": help.make_intervention,
    "divergence": help.make_divergence,
    "novelty": novelty.make_novelty,
}
for _name, _make in _SHIPPED.items():
    register_estimator(_name, _make)

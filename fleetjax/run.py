"""A whole experiment: pre-train, then one scan over the fleet's timesteps; and the evaluation of what was learnt."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fleetjax import envs, priority
from fleetjax.config import Config, validate
from fleetjax.fleet import Fleet, FleetState, Interventions, make_fleet
from fleetjax.learning.imitation import LearnerState, create_data
from fleetjax.learning.pretraining import pretrain
from fleetjax.metrics import Metrics
from fleetjax.types import HumanState


class Result(NamedTuple):
    """What a run gives.

    Attributes:
        metrics: Metrics[T], one row a timestep.
        state: FleetState after the last timestep.
    """

    metrics: Metrics
    state: FleetState


def prepare(config: Config, key: jax.Array, env: envs.Env | None = None) -> FleetState:
    """Return the fleet at t = 0: demonstrations collected, policy and critics pre-trained, robots at their start.

    Args:
        config: configuration.
        key: random key; `run(config, key)` starts from `prepare(config, key)`.
        env: the environment, if it is not the registered one that the configuration names.

    Raises:
        ValueError: if the configuration is not valid.

    Reference: paper, Section 5.2.
    """
    validate(config, env)
    env = env or envs.make(config.environment, config.backend)

    def start(config: Config, key: jax.Array) -> FleetState:
        key_pretrain, key_reset = jax.random.split(key)
        policy, data, critics = pretrain(config, env, key_pretrain)
        return _start(config, env, key_reset, policy, data, critics)

    key_prepare, _ = jax.random.split(key)
    return _one_by_one(start)(config, key_prepare)


def _one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """On a CPU, let `vmap` call a function on one run after the other.

    Side by side, matrix products would be rounded differently, and a last bit decides who is helped. A run that has the
    CPU's cores to itself is no slower. `vmap` of anything else, and runs on other devices, go side by side.
    """
    return jax.custom_batching.sequential_vmap(function) if jax.default_backend() == "cpu" else function


def _start(config: Config, env: envs.Env, key: jax.Array, policy: LearnerState, data, critics) -> FleetState:
    """Return the state at t = 0: robots freshly reset, humans free."""
    robots = jnp.arange(config.num_robots)
    return FleetState(
        timestep=jnp.zeros((), jnp.int32),
        env=jax.vmap(env.reset)(jax.random.split(key, config.num_robots), robots),
        humans=HumanState(jnp.full(config.num_humans, -1, jnp.int32), jnp.zeros(config.num_humans, jnp.int32)),
        resetting=jnp.zeros(config.num_robots, bool),
        learner=policy,
        human_data=data,
        critics=critics,
        priority=priority.get_algorithm(config.algorithm).make_priority(config).init(),
    )


def run(config: Config, key: jax.Array, state: FleetState | None = None, env: envs.Env | None = None) -> Result:
    """Run a fleet for `config.num_steps` timesteps.

    Pure: `jax.jit`, `jax.vmap` over keys and over configs, and so on. Timestep t uses `fold_in(key, t)`, so that a run
    continued from a state of it, with the same key, is the same run.

    Args:
        config: configuration.
        key: random key.
        state: where to start; None pre-trains first.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        Result: metrics [T] and the last state.

    Raises:
        ValueError: if the configuration is not valid.

    Reference: paper, Sections 3 and 4.
    """
    metrics, last = _run(config, key, state, env, lambda fleet: fleet.step)
    return Result(metrics, last)


def run_logged(
    config: Config, key: jax.Array, state: FleetState | None = None, env: envs.Env | None = None
) -> tuple[Result, Interventions]:
    """Run a fleet as `run` does, and log what each human who teleoperates saw and did.

    Args:
        config: configuration.
        key: random key.
        state: where to start; None pre-trains first.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        The Result of `run`, and Interventions[T, M].

    Raises:
        ValueError: if the configuration is not valid.
    """
    (metrics, interventions), last = _run(config, key, state, env, lambda fleet: fleet.logged_step)
    return Result(metrics, last), interventions


def _run(
    config: Config, key: jax.Array, state: FleetState | None, env: envs.Env | None, choose: Callable[[Fleet], Any]
) -> tuple[Any, FleetState]:
    """Scan over the fleet's step that is chosen; return what it gives [T, ...] and the last state."""
    validate(config, env)
    env = env or envs.make(config.environment, config.backend)
    start = prepare(config, key, env) if state is None else state

    def operate(config: Config, key: jax.Array, start: FleetState) -> tuple[Any, FleetState]:
        step = choose(make_fleet(config, env))

        def timestep(state: FleetState, _: None) -> tuple[FleetState, Any]:
            return step(state, jax.random.fold_in(key, state.timestep))

        last, given = jax.lax.scan(timestep, start, length=config.num_steps)
        return given, last

    _, key_steps = jax.random.split(key)
    return _one_by_one(operate)(config, key_steps, start)


def evaluate(config: Config, key: jax.Array, learner: LearnerState, env: envs.Env | None = None) -> Result:
    """Run a trained policy without teleoperation: fresh episodes, hard resets for robots in violation, no updates.

    Args:
        config: configuration that the policy was trained with; `num_steps` timesteps are run.
        key: random key.
        learner: the trained policy, `result.state.learner`.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        Result: metrics [T] and the last state.

    Raises:
        ValueError: if the configuration is not valid.

    Reference: paper, Appendix (evaluating trained simulation policies).
    """
    validate(config, env)
    env = env or envs.make(config.environment, config.backend)
    config = config.replace(algorithm="constraint")
    key_reset, _ = jax.random.split(key)
    members = jax.tree.leaves(learner.params)[0].shape[0]
    nothing = create_data(env.spec, ensemble_size=members, capacity=1)
    state = _start(config, env, key_reset, learner, nothing, {})
    return run(config, key, state, env)

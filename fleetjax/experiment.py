"""A whole experiment: pre-train, then one scan over the fleet's timesteps; and the evaluation of what was learnt."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fleetjax import envs, sharding
from fleetjax.checks import check_key, check_kind, check_run
from fleetjax.config import Config
from fleetjax.distribute import alone, place, spread
from fleetjax.field import FIELDS, OF_HUMANS, OF_LINKS
from fleetjax.fleet import FleetState, init, logged_step, make_parts
from fleetjax.keys import key_at
from fleetjax.learning.imitation import PolicyState, create_data
from fleetjax.learning.pretraining import pretrain
from fleetjax.metrics import Metrics
from fleetjax.precision import in_32_bits
from fleetjax.types import Interventions


class Result(NamedTuple):
    """What a run gives.

    Attributes:
        metrics: Metrics[T], one row per timestep.
        state: FleetState after the last timestep.
    """

    metrics: Metrics
    state: FleetState


@in_32_bits
def prepare(config: Config, key: jax.Array, env: envs.Env | None = None, mesh: Mesh | None = None) -> FleetState:
    """Return the fleet at t = 0: demonstrations collected, policy and critics pre-trained, robots at their start.

    Args:
        config: configuration.
        key: random key; `run(config, key)` starts from `prepare(config, key)`.
        env: the environment, if it is not the registered one that the configuration names.
        mesh: devices among which to divide the robots; None = all on one. Each device does all the pre-training itself.

    Collecting whole episodes takes loops whose length depends on what happens in them, so only forward-mode differentiation
    works through this function. `run` from a given state supports both modes where the physics does.

    Raises:
        ValueError: if the configuration is not valid, or the run cannot fit the memory.

    Reference: paper, Section 5.2.
    """
    with sharding.over(mesh, config.num_humans):
        return spread(_prepare(config, key, env))


def _prepare(config: Config, key: jax.Array, env: envs.Env | None) -> FleetState:
    """Return the fleet at t = 0, before it is divided."""
    check_key(key)
    env = check_run(config, env)
    key_policy, key_estimators, key_reset = jax.random.split(key_at(key, -1), 3)
    parts = make_parts(config, env)

    def learn() -> tuple[Any, ...]:
        policy, data = pretrain(config, env, parts.learner, parts.supervisor, key_policy)
        estimators = {
            name: estimator.init(jax.random.fold_in(key_estimators, i), data, policy)
            for i, (name, estimator) in enumerate(parts.estimators.items())
        }
        return policy, data, estimators

    return init(parts, key_reset, *alone(learn))


def extend(state: FleetState, num_pairs: int) -> FleetState:
    """Return the same state with room for more human data, for runs that continue from it.

    Args:
        state: of one fleet, or of several under `vmap`.
        num_pairs: number of additional pairs to make room for; each augmented copy counts as one.

    Raises:
        ValueError: if `num_pairs` is not a whole number of at least 0, or the room would exceed 32 bits.

    >>> from fleetjax import make_config
    >>> state = jax.eval_shape(lambda: prepare(make_config("navigation", "uc", num_steps=10), jax.random.key(0)))
    >>> state.human_data.pairs.capacity, jax.eval_shape(lambda s: extend(s, 100), state).human_data.pairs.capacity
    (600, 700)
    """
    data = state.human_data
    if isinstance(num_pairs, bool) or not isinstance(num_pairs, (int, np.integer)) or num_pairs < 0:
        raise ValueError(f"num_pairs = {num_pairs!r} must be a whole number of at least 0")
    axis = data.pairs.added.ndim  # behind those of several fleets
    if data.resample.shape[axis] + num_pairs >= 2**31:
        raise ValueError(f"num_pairs = {num_pairs} exceeds 32 bits with the {data.resample.shape[axis]} there is room for")

    def grow(rows: jax.Array) -> jax.Array:
        return jnp.pad(rows, [(0, int(num_pairs) if i == axis else 0) for i in range(rows.ndim)])

    pairs = data.pairs._replace(rows=jax.tree.map(grow, data.pairs.rows))
    weight = None if data.weight is None else grow(data.weight)
    return state._replace(human_data=data._replace(pairs=pairs, resample=grow(data.resample), weight=weight))


def run(
    config: Config,
    key: jax.Array,
    state: FleetState | None = None,
    env: envs.Env | None = None,
    mesh: Mesh | None = None,
) -> Result:
    """Run a fleet for `config.num_steps` timesteps.

    Pure, so you can use `jax.jit`, and `jax.vmap` over keys and configs. Each timestep derives its key from `key`, so a run
    continued from one of its own states, with the same key, gives the same result. `jax.vmap` computes runs side by side and
    rounds matrix products differently; a last bit can decide who is helped. With `jax.lax.map` each run gives exactly the
    result of a single run.

    Args:
        config: configuration.
        key: random key.
        state: where to start; None pre-trains first.
        env: the environment, if it is not the registered one that the configuration names.
        mesh: devices among which to divide the robots, in equal parts; None = all on one. See docs/scale.md.

    Returns:
        Result: metrics [T] and the last state, on a mesh divided over it.

    Raises:
        ValueError: if the configuration is not valid, the run cannot fit the memory, the number of robots is not a multiple of
            that of devices, or the state does not fit the configuration: it is another environment's or fleet's, its layout
            differs (other networks, estimators or memory of the rule), or it has no room for the pairs that humans can give
            (`extend` makes room; where the state's numbers are traced, `Metrics.dropped` counts what was lost).

    Reference: paper, Sections 3 and 4.
    """
    return simulate(config, key, state, env, mesh, logged=False)[0]


def run_logged(
    config: Config,
    key: jax.Array,
    state: FleetState | None = None,
    env: envs.Env | None = None,
    mesh: Mesh | None = None,
) -> tuple[Result, Interventions]:
    """Run a fleet as `run` does, and log what each human who teleoperates saw and did.

    Args:
        config: configuration.
        key: random key.
        state: where to start; None pre-trains first.
        env: the environment, if it is not the registered one that the configuration names.
        mesh: devices among which to divide the robots; None = all on one.

    Returns:
        The Result of `run`, and Interventions[T, M].

    Raises:
        ValueError: as `run` does.
    """
    return simulate(config, key, state, env, mesh, logged=True)


@in_32_bits
def simulate(
    config: Config,
    key: jax.Array,
    state: FleetState | None = None,
    env: envs.Env | None = None,
    mesh: Mesh | None = None,
    *,
    logged: bool,
) -> tuple[Result, Any]:
    """Return the Result of `run` and, if `logged`, the Interventions[T, M] of `run_logged`; else None."""
    check_key(key)
    if logged and config.allocation == "soft":
        raise ValueError("allocation = 'soft' blends actions, so no human's action can be logged; use allocation = 'hard'")
    with sharding.over(mesh, config.num_humans):
        env = check_run(config, env, state)
        start = spread(_prepare(config, key, env) if state is None else state)
        parts = make_parts(config, env)

        def timestep(state: FleetState, _: None) -> tuple[FleetState, Any]:
            after, outputs = logged_step(parts, state, key_at(key, state.timestep))
            counts, interventions = sharding.everywhere(outputs)
            return place(after), (counts, interventions if logged else None)

        scan = scan_in_blocks if config.allocation == "soft" else jax.lax.scan
        last, (metrics, interventions) = scan(timestep, start, length=config.num_steps)
        return Result(metrics, last), interventions


def step_once(config: Config, env: envs.Env, state: FleetState, key: jax.Array) -> FleetState:
    """Return the state after a run's next timestep."""
    return logged_step(make_parts(config, env), state, key_at(key, state.timestep))[0]


def scan_in_blocks(step: Callable[[Any, None], tuple[Any, Any]], carry: Any, *, length: int) -> tuple[Any, Any]:
    """Scan as `jax.lax.scan` does, with memory for reverse-mode differentiation that grows with the root of the length.

    Only the carries between blocks of about sqrt(length) steps are kept; a block is computed again when its turn comes.
    """
    size = math.isqrt(length)
    number, rest = divmod(length, size)

    def block(carry: Any, _: None) -> tuple[Any, Any]:
        return jax.lax.scan(step, carry, length=size)

    carry, outputs = jax.lax.scan(jax.checkpoint(block), carry, length=number)
    carry, last = jax.lax.scan(jax.checkpoint(step), carry, length=rest)
    return carry, jax.tree.map(lambda x, y: jnp.concatenate([x.reshape(-1, *x.shape[2:]), y]), outputs, last)


@in_32_bits
def evaluate(config: Config, key: jax.Array, policy: PolicyState, env: envs.Env | None = None) -> Result:
    """Run a trained policy without teleoperation: fresh episodes, hard resets for robots in violation, no updates.

    Args:
        config: configuration that the policy was trained with; `num_steps` timesteps are run.
        key: random key.
        policy: the trained policy, `result.state.policy`.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        Result: metrics [T] and the last state.

    Raises:
        ValueError: if the configuration is not valid, or the policy does not fit it.

    Reference: paper, Appendix (evaluating trained simulation policies).
    """
    check_key(key)
    check_kind("policy", policy, PolicyState, "the policy of a run's state, result.state.policy")
    members = jax.tree.leaves(policy.params)[0].shape[0]
    config = without_teleoperation(config).replace(ensemble_size=members)
    env = check_run(config, env)
    nothing = create_data(env.spec, ensemble_size=members, capacity=1)
    return run(config, key, init(make_parts(config, env), key_at(key, -1), policy, nothing, {}), env)


def without_teleoperation(config: Config) -> Config:
    """Return a configuration in which humans only reset robots in violation, and nothing is learnt."""
    neutral = {name: FIELDS[name].default for name in (*OF_HUMANS, *OF_LINKS)}
    return config.replace(algorithm="constraint", allocation="hard", human_model="perfect", link_model="perfect", **neutral)

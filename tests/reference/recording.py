"""Runs a fleet, writes down what the NumPy oracle must be told, and compares the two step by step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import allocation, priority, supervisors
from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.fleet import Fleet, FleetState, make_fleet
from fleetjax.keys import split_keys
from fleetjax.learning import critic, imitation
from fleetjax.learning.networks import Normalizer
from fleetjax.metrics import Metrics, rohe
from fleetjax.types import EnvState, HumanState, Plan
from reference import oracle

# Bound here, so that a fault seeded in the fleet's own tie-breaking does not reach what is recorded.
draw_order = allocation.tie_order


class Trace(NamedTuple):
    """A run as the fleet saw it: what the oracle is told [T], what the fleet planned and counted [T], and its states."""

    recorded: dict[str, Any]
    plan: Plan
    metrics: Metrics
    env: EnvState  # after each timestep
    humans: HumanState  # after each timestep
    stored: dict[str, jax.Array]  # rows stored and gradient steps taken so far, after each timestep
    first: FleetState
    last: FleetState


def start(config: Config, env: Env, key: jax.Array) -> FleetState:
    """Return a fleet at t = 0 with untrained networks and no data."""
    key_env, key_policy, *keys_critics = jax.random.split(key, 4)
    algorithm = priority.get_algorithm(config.algorithm)
    learner = imitation.make_learner(config, env.spec)
    size = env.spec.observation_size
    critics = {kind: critic.make_critic(kind, config, env.spec, learner) for kind in algorithm.estimators}
    return make_fleet(config, env).init(
        key_env,
        learner.init(key_policy, Normalizer(jnp.zeros(size), jnp.ones(size), jnp.float32(10))),
        imitation.create_data(env.spec, ensemble_size=config.ensemble_size, capacity=config.human_capacity),
        {kind: parts.init(key) for (kind, parts), key in zip(critics.items(), keys_critics, strict=False)},
    )


def record(
    config: Config, env: Env, fleet: Fleet, state: FleetState, key: jax.Array, absence: Any = 0.0, silence: Any = 0.0
) -> Trace:
    """Run `config.num_steps` timesteps and write everything down.

    Args:
        config: configuration.
        env: environment that answers to either action, also where the fleet took the other one.
        fleet: the fleet under test.
        state: where it starts.
        key: random key of the run.
        absence: chance that a human is not there.
        silence: chance that a teleoperator gives no action.
    """
    n, m = config.num_robots, config.num_humans
    learner = imitation.make_learner(config, env.spec)
    supervisor = supervisors.make(config.supervisor or env.spec.supervisor, env)
    kinds = priority.get_algorithm(config.algorithm).estimators
    critics = {kind: critic.make_critic(kind, config, env.spec, learner) for kind in kinds}

    def timestep(state: FleetState, _: None):
        key_t = jax.random.fold_in(key, state.timestep)
        keys = split_keys(key_t, n)
        key_available, key_present = jax.random.split(jax.random.fold_in(key_t, 1))

        robot_action = learner.predict(state.policy, state.env.obs)[0]
        human_action = jax.vmap(supervisor.act)(state.env, keys.human)
        chance = {
            kind: parts.value(state.estimators[kind], state.policy.normalizer, state.env.obs, robot_action)
            for kind, parts in critics.items()
        }
        outcomes = {
            name: jax.vmap(env.step)(state.env, action, jnp.ones(n, bool), keys.env)
            for name, action in {"robot": robot_action, "human": human_action}.items()
        }
        recorded = {
            "uncertainty": learner.predict(state.policy, state.env.obs)[1],
            "risk": chance.get("safety", jnp.zeros(n)),
            "goal": chance.get("goal", jnp.zeros(n)),
            "uniform": jax.random.uniform(keys.score, (n,)),
            "tie_order": draw_order(keys.ties, n),
            "resample_bits": jax.random.bits(keys.data, (state.human_data.resample.shape[1], n)),
            "available": jax.random.uniform(key_available, (m,)) >= absence,
            "present": jax.random.uniform(key_present, (n,)) >= silence,
            "robot_action": robot_action,
            "human_action": human_action,
            "fresh": jax.vmap(env.reset)(keys.reset, jnp.arange(n)),
        }
        for name, outcome in outcomes.items():
            recorded[f"after_{name}"] = recorded[f"renewed_{name}"] = outcome
            if env.next_goal:
                recorded[f"renewed_{name}"] = jax.vmap(env.next_goal)(outcome, keys.goal)

        planned, plan = fleet.plan(state, key_t, recorded["available"])
        after, metrics = fleet.advance(planned, plan, human_action, recorded["present"], key_t)

        return after, (recorded, plan, metrics, after.env, after.humans, count_stored(after))

    last, rows = jax.lax.scan(timestep, state, length=config.num_steps)
    return Trace(*rows, first=state, last=last)


def count_stored(state: FleetState) -> dict[str, jax.Array]:
    """Return how many rows every buffer was given, and how many gradient steps the policy took."""
    counts = {"human data": state.human_data.pairs.added, "gradient steps": state.policy.opt_state.count}
    for kind, c in state.estimators.items():
        counts |= {f"{kind} critic's positives": c.positives.added, f"{kind} critic's negatives": c.negatives.added}
    return counts


def problem_of(config: Config, env: Env) -> oracle.Problem:
    """Return what the oracle must know of a configuration."""
    algorithm = priority.get_algorithm(config.algorithm)
    rings = (max(config.num_robots, config.critic_capacity // 10), config.critic_capacity)
    return oracle.Problem(
        num_robots=config.num_robots,
        num_humans=config.num_humans,
        priority=config.algorithm,
        min_teleop_time=int(config.min_teleop_time),
        hard_reset_time=int(config.hard_reset_time),
        initial_period=int(config.initial_period),
        uncertainty_threshold=float(config.uncertainty_threshold),
        risk_threshold=float(config.risk_threshold),
        random_threshold=float(config.parameters.get("random_threshold", np.nan)),
        thrifty_weight=float(config.parameters.get("thrifty_weight", np.nan)),
        thrifty_threshold=float(config.parameters.get("thrifty_threshold", np.nan)),
        learns=algorithm.updates,
        gradient_steps=config.gradient_steps,
        ring_sizes=dict.fromkeys(algorithm.estimators, rings),
        new_goals=env.next_goal is not None,
    )


def state_of(env_state: EnvState) -> oracle.State:
    """Return an EnvState[N] as the oracle holds it: a dictionary of arrays."""
    fields = env_state._asdict()
    inner = {f"physics {k}": leaf for k, leaf in enumerate(jax.tree.leaves(fields.pop("physics")))}
    return {name: np.asarray(value) for name, value in (fields | inner).items()}


def compare(config: Config, env: Env, trace: Trace) -> list[oracle.Outcome]:
    """Replay a trace with the oracle and compare everything at every timestep; return what the oracle saw.

    Raises:
        AssertionError: naming the timestep and the quantity that differs first.
    """
    problem = problem_of(config, env)
    trace = jax.tree.map(np.asarray, trace)
    fleet = oracle.start(problem, state_of(trace.first.env), trace.first.human_data.resample.shape[1])
    effort, outcomes = np.asarray(rohe(trace.metrics, config)), []
    for t in range(trace.metrics.idle.shape[0]):
        row = jax.tree.map(lambda x, t=t: x[t], trace._replace(first=None, last=None))
        recorded: dict[str, Any] = {k: state_of(x) if isinstance(x, EnvState) else x for k, x in row.recorded.items()}
        fleet, outcome = oracle.timestep(problem, fleet, oracle.Recorded(**recorded))
        _compare_plan(row.plan, outcome, t)
        _compare_after(row, fleet, outcome, t)
        same("ROHE", t, effort[t], outcome.rohe)
        outcomes.append(outcome)
    _compare_data(trace.last, fleet)
    return outcomes


def _compare_plan(plan: Plan, outcome: oracle.Outcome, t: int) -> None:
    same("scores", t, plan.score, outcome.score)
    same("allocation", t, matrix(plan.humans.robot, len(outcome.score)), outcome.alpha)
    same("durations", t, plan.humans.duration, by_human(outcome.alpha, outcome.duration_before))
    same("robots under hard reset", t, plan.resetting, [kind == oracle.HARD_RESET for kind in outcome.type])
    same("robots teleoperated", t, plan.teleoperated, [kind == oracle.TELEOP for kind in outcome.type])


def _compare_after(row: Trace, fleet: oracle.Fleet, outcome: oracle.Outcome, t: int) -> None:
    for name, expected in outcome.metrics.items():
        same(f"metric {name}", t, getattr(row.metrics, name), expected)
    same("metric reward", t, row.metrics.reward, outcome.reward)
    for name, expected in fleet.state.items():
        same(f"state {name}", t, state_of(row.env)[name], expected)
    same("allocation kept", t, matrix(row.humans.robot, len(outcome.score)), fleet.alpha)
    same("durations kept", t, row.humans.duration, by_human(fleet.alpha, fleet.duration))
    expected = {"human data": len(fleet.data), "gradient steps": fleet.gradient_steps}
    for kind, c in fleet.critics.items():
        expected |= {f"{kind} critic's positives": c.stored[0], f"{kind} critic's negatives": c.stored[1]}
    for name, number in expected.items():
        same(f"number of {name}", t, row.stored[name], number)


def _compare_data(last: FleetState, fleet: oracle.Fleet) -> None:
    t, pairs = fleet.t - 1, last.human_data.pairs
    size = len(fleet.data)
    for k, name in enumerate(("obs", "action")):
        same(f"human data: {name}", t, getattr(pairs.rows, name)[:size], rows_of(fleet.data, k, getattr(pairs.rows, name)))
    same("resampled pairs", t, last.human_data.resample[:size].T, fleet.resample)
    for kind, c in fleet.critics.items():
        for label in ("positives", "negatives"):
            ring, expected = getattr(last.estimators[kind], label), getattr(c, label)
            place = (int(ring.added) - len(expected) + np.arange(len(expected))) % ring.capacity
            for k, field in enumerate(ring.rows._fields):
                stored = getattr(ring.rows, field)
                same(f"{kind} critic's {label}: {field}", t, stored[place], rows_of(expected, k, stored))


def rows_of(items: list[tuple], k: int, like: np.ndarray) -> np.ndarray:
    """Return entry k of every item as an array with the row shape of `like`."""
    return np.array([item[k] for item in items], like.dtype).reshape(-1, *like.shape[1:])


def matrix(robot: Any, num_robots: int) -> np.ndarray:
    """Return alpha, 0 and 1 [N, M], from the robot i32[M] of each human."""
    return (np.arange(num_robots)[:, None] == robot[None, :]).astype(int)


def by_human(alpha: np.ndarray, duration: list[int]) -> np.ndarray:
    """Return durations of interventions by human instead of by robot, 0 for humans who are free."""
    return np.array(duration) @ alpha


def same(name: str, t: int, actual: Any, expected: Any) -> None:
    """Raise an AssertionError that names the quantity unless both agree: floats to 1e-5, all else exactly."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    agree = (
        np.allclose(actual, expected, rtol=1e-5, atol=1e-5) if actual.dtype.kind == "f" else np.array_equal(actual, expected)
    )
    assert agree, f"{name} differs at t = {t}:\nfleet  {actual}\noracle {expected}"

"""The fleet's timestep: signals, priorities, allocation, actions, physics, data, resets, learning (paper, Section 3).

`Fleet.plan` says which human helps which robot, `Fleet.advance` does the rest, and `Fleet.step` puts the simulated supervisor
between them. This module maps environment, supervisor and physics over the robots.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from fleetjax import humans, metrics, priority, sharding, soft, supervisors
from fleetjax.allocation import Allocator, helper_of
from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.humans import HumanModel, Links
from fleetjax.keys import Keys, key_of_links, key_of_people, key_of_presence, split_keys
from fleetjax.learning import buffer, imitation
from fleetjax.learning.critic import CriticState
from fleetjax.learning.estimator import Estimator, Step
from fleetjax.learning.estimators import ESTIMATORS
from fleetjax.learning.imitation import HumanData, Learner, Pair, PolicyState
from fleetjax.metrics import Metrics
from fleetjax.precision import in_32_bits
from fleetjax.priority import Algorithm, Priority
from fleetjax.supervisors import Supervisor
from fleetjax.tree import finite, take, where
from fleetjax.types import EnvState, HumanState, Interventions, Plan, Signals


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Origin:
    """The names of the environment and the algorithm that a state was prepared for; "" = not known."""

    environment: str
    algorithm: str


class FleetState(NamedTuple):
    """All that the next timestep needs.

    Attributes:
        timestep: i32[] timesteps completed.
        env: EnvState[N].
        humans: HumanState[M] at the end of the last timestep.
        resetting: bool[N] whether a human was resetting the robot at the last timestep.
        given: bool[N] whether a human's action was done at the last timestep.
        correction: f32[N] see `Signals`.
        policy: what the robots have learnt.
        human_data: what they learn from.
        estimators: state of each estimator that the algorithm names, by name.
        priority: the priority's own memory.
        origin: what it was prepared for.
        weight: f32[N] how much of a human each robot had at the last timestep, in the soft allocation; None in the hard one.
        people: what the human model carries; nothing for perfect humans.
        links: PerRobot of `humans.Lines`, the robots' connections; nothing if all always work.
    """

    timestep: jax.Array
    env: EnvState
    humans: HumanState
    resetting: jax.Array
    given: jax.Array
    correction: jax.Array
    policy: PolicyState
    human_data: HumanData
    estimators: dict[str, Any]
    priority: Any
    origin: Origin = Origin("", "")
    weight: Any = None
    people: Any = ()
    links: Any = ()

    @property
    def learner(self) -> PolicyState:
        """The policy, by its name in version 0.1."""
        return self.policy


class Parts(NamedTuple):
    """What a fleet is made of."""

    config: Config
    env: Env
    algorithm: Algorithm
    rule: Priority
    binding: Priority  # by whose scores humans are assigned: the rule, as it is in a hard fleet
    allocate: Allocator
    supervisor: Supervisor
    learner: Learner
    estimators: dict[str, Estimator]
    people: HumanModel | None = None
    links: Links | None = None


class Fleet(NamedTuple):
    """Pure functions of a fleet. Each timestep has its own key, which `plan` and `advance` share.

    Attributes:
        init: `(key, PolicyState, HumanData, estimators' states) -> FleetState` at t = 0.
        plan: `(state, key, available bool[M] | None) -> (state, Plan)`.
        advance: `(state, Plan, human_action f32[N, A], given bool[N], key) -> (state, Metrics)`. `given` marks robots whose
            supervisor really gave that action; on other robots the policy acts, and nothing is recorded.
        step: `(state, key) -> (state, Metrics)`, with the simulated supervisor.

    With `allocation = "soft"` there is no `advance`, and `plan` takes all humans.
    """

    init: Callable[..., FleetState]
    plan: Callable[..., tuple[FleetState, Plan]]
    advance: Callable[..., tuple[FleetState, Metrics]]
    step: Callable[[FleetState, jax.Array], tuple[FleetState, Metrics]]


@in_32_bits
def make_parts(config: Config, env: Env) -> Parts:
    """Make what a configuration names."""
    algorithm = priority.get_algorithm(config.algorithm)
    supervisor = supervisors.make(config.supervisor or env.spec.supervisor, env)
    learner = imitation.make_learner(config, env.spec)
    learnt = priority.estimators_of(algorithm, env.spec)
    estimators = {name: ESTIMATORS.get(name)(config, env, learner, supervisor) for name in learnt}
    rule, allocator = algorithm.make_priority(config), algorithm.make_allocate(config)
    binding = algorithm.make_priority(config.replace(allocation="hard")) if config.allocation == "soft" else rule
    make_people, make_links = humans.HUMAN_MODELS.get(config.human_model), humans.LINK_MODELS.get(config.link_model)
    people = make_people(config, env.spec) if make_people else None
    links = make_links(config) if make_links else None
    return Parts(config, env, algorithm, rule, binding, allocator, supervisor, learner, estimators, people, links)


def make_fleet(config: Config, env: Env) -> Fleet:
    """Compose environment, policy, estimators, priority, allocator and supervisor into the timestep of a fleet."""
    parts, n = make_parts(config, env), config.num_robots

    def plan_(state: FleetState, key: jax.Array, available: jax.Array | None = None) -> tuple[FleetState, Plan]:
        if available is not None and config.allocation == "soft":
            raise ValueError("allocation = 'soft' shares all humans; omit available, or use allocation = 'hard'")
        return plan(parts, state, split_keys(key, n), available)

    def advance(
        state: FleetState, plan: Plan, human_action: jax.Array, given: jax.Array, key: jax.Array
    ) -> tuple[FleetState, Metrics]:
        if config.allocation == "soft":
            raise ValueError("allocation = 'soft' takes a share of the human's action on every robot; use step, or 'hard'")
        return act(parts, state, plan, human_action, given, split_keys(key, n))[:2]

    def step(state: FleetState, key: jax.Array) -> tuple[FleetState, Metrics]:
        after, (counts, _) = logged_step(parts, state, key)
        return after, counts

    return Fleet(in_32_bits(partial(init, parts)), in_32_bits(plan_), in_32_bits(advance), in_32_bits(step))


def init(parts: Parts, key: jax.Array, policy: PolicyState, data: HumanData, estimators: dict[str, Any]) -> FleetState:
    """Return the state at t = 0: robots freshly reset, humans free."""
    config, n, m = parts.config, parts.config.num_robots, parts.config.num_humans
    return FleetState(
        timestep=jnp.zeros((), jnp.int32),
        env=reset_robots(parts, jax.random.split(key, n)),
        humans=HumanState(jnp.full(m, -1, jnp.int32), jnp.zeros(m, jnp.int32)),
        resetting=jnp.zeros(n, bool),
        given=jnp.zeros(n, bool),
        correction=jnp.zeros(n, jnp.float32),
        policy=policy,
        human_data=data,
        estimators=estimators,
        priority=parts.rule.init(),
        origin=Origin(parts.env.spec.name, config.algorithm),
        weight=jnp.zeros(n, jnp.float32) if config.allocation == "soft" else None,
        people=parts.people.init(config, key_of_people(key)) if parts.people else (),
        links=priority.PerRobot(parts.links.init(key_of_links(key))) if parts.links else (),
    )


def logged_step(parts: Parts, state: FleetState, key: jax.Array) -> tuple[FleetState, tuple[Metrics, Interventions]]:
    """Take a timestep with the simulated supervisor; return also what each human who teleoperated saw and did."""
    keys = split_keys(key, parts.config.num_robots)
    there = parts.people.available(state.people, key_of_presence(key)) if parts.people else None
    state, planned = plan(parts, state, keys, there)
    human_action, given = supervise(parts, state.env, keys), planned.teleoperated
    people, links = state.people, state.links
    if parts.people:
        people, human_action, given = parts.people.act(people, planned, human_action, key_of_people(key))
    if parts.links:
        works = humans.draw(planned.signals.link, key_of_links(key))
        given, links = given & works, priority.PerRobot(links.values._replace(works=works))
    after, counts, stepped = act(parts, state, planned, human_action, given, keys)
    after = after._replace(people=people, links=links)
    return after, (counts, watch(state.env, planned._replace(teleoperated=given), human_action, stepped))


def plan(parts: Parts, state: FleetState, keys: Keys, available: jax.Array | None = None) -> tuple[FleetState, Plan]:
    """Decide which human helps which robot: signals, scores, allocation (paper, Section 4)."""
    config = parts.config
    signals = observe(parts, state, keys)
    score, memory = parts.rule.score(signals, state.priority, keys.score)
    late = unready(parts, state)
    min_teleop_time = jnp.minimum(config.min_teleop_time, jnp.iinfo(jnp.int32).max - late) + late
    min_time = jnp.where(state.resetting, config.hard_reset_time, min_teleop_time)
    binding = score if state.weight is None else parts.binding.score(signals, state.priority, keys.score)[0]
    humans = parts.allocate(binding, state.humans, min_time, keys.ties, available, signals)
    helped = helper_of(humans, config.num_robots) >= 0
    resetting, teleoperated = helped & signals.violation, helped & ~signals.violation
    humans = restart_clocks(humans, state.resetting, resetting, config.hard_reset_time)
    weight = None if state.weight is None else soft.share(config, state.humans, state.weight, score, min_time)
    return state._replace(priority=memory), Plan(signals, signals.robot_action, score, humans, teleoperated, resetting, weight)


def act(
    parts: Parts, state: FleetState, planned: Plan, human_action: jax.Array, given: jax.Array, keys: Keys
) -> tuple[FleetState, Metrics, EnvState]:
    """Do what was planned; return also the robots' states after their step, before resets and new goals."""
    chex.assert_shape(human_action, (parts.config.num_robots, parts.env.spec.action_size))
    given, moving = given & planned.teleoperated, ~state.env.violation
    if planned.weight is None:
        action = jnp.where(given[:, None], human_action, planned.robot_action)
    else:
        action = soft.blend(planned, human_action)
    stepped, sound = step_robots(parts, state.env, action, moving, keys)
    steps = Step(state.env.obs, action, stepped.obs, stepped.violation, stepped.success, planned.robot_action, given)
    humans = planned.humans._replace(duration=jnp.where(planned.humans.robot >= 0, planned.humans.duration + 1, 0))
    correction = jnp.where(given & sound, jnp.mean((human_action - planned.robot_action) ** 2, axis=-1), 0.0)
    taught = Pair(state.env.obs, human_action)
    before, state = state, remember(parts, state, planned, steps, taught, given & sound, moving & sound, keys)
    renewed, reset_done = renew(parts, stepped, planned, humans, moving, keys)
    state, loss = learn(parts, state, keys)
    state = state._replace(
        timestep=before.timestep + 1,
        env=renewed,
        humans=humans,
        resetting=planned.resetting,
        given=given & sound,
        correction=correction,
        weight=planned.weight,
    )
    dropped = state.human_data.dropped - jnp.where(before.timestep > 0, before.human_data.dropped, 0)
    learnt = (reset_done, dropped, find_divergence(state), loss)
    counts = metrics.measure(parts.config, planned, before.humans, stepped, moving, *learnt)
    if planned.weight is not None:
        counts = soft.relax(parts.config, parts.env, counts, planned.weight, stepped, moving)
    return state, counts, stepped


def unready(parts: Parts, state: FleetState) -> jax.Array | int:
    """Return i32[N], for how many timesteps of the help that each robot has its human was not ready to act."""
    if not parts.people or not parts.people.unready:
        return 0
    helper = helper_of(state.humans, parts.config.num_robots)
    return jnp.where(helper >= 0, parts.people.unready(state.people)[helper], 0)


def observe(parts: Parts, state: FleetState, keys: Keys) -> Signals:
    """Return what rules may look at. What is not finite is 0: one robot must not spoil the ranks."""
    n, obs = parts.config.num_robots, state.env.obs
    action, uncertainty = parts.learner.predict(state.policy, obs)
    estimates = {
        name: estimator.value(state.estimators[name], state.policy, obs, action) for name, estimator in parts.estimators.items()
    }
    uncertainty, estimates = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), (uncertainty, estimates))
    helper, never = helper_of(state.humans, n), jnp.zeros(n, jnp.float32)
    return Signals(
        violation=state.env.violation,
        uncertainty=uncertainty,
        risk=estimates.get("safety", never),
        goal=estimates.get("goal", never),
        timestep=state.timestep,
        estimates=estimates,
        obs=obs,
        robot_action=action,
        helped=helper >= 0,
        help_time=jnp.where(helper >= 0, state.humans.duration[helper], 0),
        given=state.given,
        correction=state.correction,
        human_action=supervise(parts, state.env, keys) if parts.algorithm.sees_supervisor else None,
        link=parts.links.quality(state.links.values, state.timestep) if parts.links else jnp.ones(n, jnp.float32),
        episode_step=state.env.episode_step,
    )


def supervise(parts: Parts, env: EnvState, keys: Keys) -> jax.Array:
    """Return f32[N, A], what the simulated supervisor would do on each robot."""
    return sharding.vmap(parts.supervisor.act, env, keys.human)


def reset_robots(parts: Parts, keys: jax.Array) -> EnvState:
    """Return EnvState[N], each robot drawn from its own initial distribution by its key of `keys` [N]."""
    return sharding.vmap(parts.env.reset, keys, jnp.arange(parts.config.num_robots))


def step_robots(parts: Parts, env: EnvState, action: jax.Array, moving: jax.Array, keys: Keys) -> tuple[EnvState, jax.Array]:
    """Step the robots that move; return EnvState[N], and bool[N] whose numbers are finite. The others are in violation."""
    stepped = sharding.vmap(parts.env.step, env, action, moving, keys.env)
    if parts.env.spec.success_return is not None:
        stepped = stepped._replace(success=stepped.timeout & (stepped.episode_return > parts.config.success_return))
    stepped = where(moving, stepped, env)
    sound = finite((env.obs, action, stepped.obs, stepped.reward))
    return contain(stepped, sound), sound


def remember(
    parts: Parts,
    state: FleetState,
    planned: Plan,
    steps: Step,
    pairs: Pair,
    taught: jax.Array,
    moved: jax.Array,
    keys: Keys,
) -> FleetState:
    """Record what humans did where they `taught` bool[N], and what happened where robots `moved` bool[N]."""
    data = state.human_data
    if parts.algorithm.updates:
        choice = None
        if sharding.division():  # only the rows of humans leave their device
            choice = imitation.Choice(teaching(planned.humans, taught), parts.config.num_robots)
            pairs, taught = sharding.everywhere(take(pairs, choice.rows)), choice.rows < choice.number
        before, data = data, parts.learner.append(data, pairs, taught, keys.data, choice)
        if planned.weight is not None:
            data = imitation.weigh(before, data, planned.weight, taught)
    estimators = {name: estimator.append(state.estimators[name], steps, moved) for name, estimator in parts.estimators.items()}
    return state._replace(human_data=data, estimators=estimators)


def teaching(humans: HumanState, taught: jax.Array) -> jax.Array:
    """Return i32[M], the robots among `taught` bool[N] that humans help, in order, then N."""
    return jnp.sort(jnp.where((humans.robot >= 0) & taught[humans.robot], humans.robot, taught.size))


def renew(
    parts: Parts, stepped: EnvState, planned: Plan, humans: HumanState, moving: jax.Array, keys: Keys
) -> tuple[EnvState, jax.Array]:
    """Complete hard resets, reset whose episode ended, and draw new goals; return EnvState[N] and bool[N] hard resets."""
    n, next_goal = parts.config.num_robots, parts.env.next_goal
    reset_done = planned.resetting & (humans.duration[helper_of(humans, n)] >= parts.config.hard_reset_time)
    ended = stepped.timeout if next_goal else stepped.timeout | stepped.success
    after = where(reset_done | (moving & ended), reset_robots(parts, keys.reset), stepped)
    if next_goal:
        with_goal = sharding.vmap(next_goal, after, keys.goal)
        after = where(moving & stepped.success & ~ended, with_goal, after)
    return after, reset_done


def learn(parts: Parts, state: FleetState, keys: Keys) -> tuple[FleetState, jax.Array]:
    """Take the timestep's gradient steps, policy first; return also the mean imitation loss f32[]."""
    if not parts.algorithm.updates:
        return state, jnp.zeros((), jnp.float32)
    number, data = parts.config.gradient_steps, state.human_data

    def gradient_step(carry: tuple[PolicyState, dict[str, Any]], keys: jax.Array):
        policy, states = carry
        policy, loss = parts.learner.update(policy, data, keys[0])
        states = {
            name: estimator.update(states[name], policy, data, key)
            for (name, estimator), key in zip(parts.estimators.items(), keys[1:], strict=True)
        }
        return (policy, states), loss

    carry = (state.policy, state.estimators)
    steps = jax.random.split(keys.learn, (number, 1 + len(parts.estimators)))
    (policy, estimators), losses = jax.lax.scan(gradient_step, carry, steps)
    return state._replace(policy=policy, estimators=estimators), jnp.sum(losses) / max(number, 1)


def watch(before: EnvState, planned: Plan, human_action: jax.Array, stepped: EnvState) -> Interventions:
    """Return what each human did in a timestep that led the robots from `before` to `stepped`."""
    robot = planned.humans.robot
    actions = (planned.robot_action, human_action)
    outcome = (stepped.obs, stepped.reward, stepped.violation, stepped.success, stepped.timeout)
    score, step, obs, (proposed, done), result = take(
        (planned.score, before.episode_step, before.obs, actions, outcome), jnp.maximum(robot, 0)
    )
    robot = jnp.where((robot >= 0) & planned.teleoperated[robot], robot, -1)
    return Interventions(robot, score, step, obs, proposed, done, *result)


def restart_clocks(
    humans: HumanState, was_resetting: jax.Array, resetting: jax.Array, hard_reset_time: jax.Array | int
) -> HumanState:
    """Return `humans` with duration 0 where the kind of intervention changed, or the last hard reset is completed."""
    changed = was_resetting[humans.robot] != resetting[humans.robot]
    completed = was_resetting[humans.robot] & (humans.duration >= hard_reset_time)
    return humans._replace(duration=jnp.where(changed | completed, 0, humans.duration))


def contain(env: EnvState, sound: jax.Array) -> EnvState:
    """Return EnvState[N] in which robots that are not `sound` bool[N] are in violation, and show nothing that is not finite."""
    obs, reward, episode_return = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (env.obs, env.reward, env.episode_return))
    return env._replace(
        obs=obs,
        reward=reward,
        episode_return=episode_return,
        violation=env.violation | ~sound,
        success=env.success & sound,
        timeout=env.timeout & sound,
    )


def find_divergence(state: FleetState) -> jax.Array:
    """Return i32[], the sum of the bits of what in `metrics.LEARNT` is not finite; what buffers hold is left out."""
    others = [learnt for name, learnt in state.estimators.items() if name not in ("safety", "goal")]
    safety, goal = (_networks(state.estimators.get(name)) for name in ("safety", "goal"))
    flags = [~_all_finite(part) for part in (state.policy.params, safety, goal, state.priority, others)]
    return sum((flag.astype(jnp.int32) << bit for bit, flag in enumerate(flags)), jnp.int32(0))


def _networks(critic: CriticState | None) -> Any:
    return (critic.params, critic.target) if critic else ()


def _all_finite(learnt: Any) -> jax.Array:
    leaves = jax.tree.leaves(learnt, is_leaf=buffer.is_buffer)
    numbers = [x for x in leaves if not isinstance(x, buffer.Buffer) and jnp.issubdtype(x.dtype, jnp.floating)]
    return sum((jnp.sum(x - x) for x in numbers), jnp.float32(0)) == 0  # inf - inf is NaN; it compiles to little

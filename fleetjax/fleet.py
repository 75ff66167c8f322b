"""The fleet's timestep: signals, priorities, allocation, actions, physics, data, resets, learning (paper, Section 3).

`Fleet.plan` says who needs whom, `Fleet.advance` does the rest, and `Fleet.step` puts the simulated supervisor between
them. This is the only module that maps over robots.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from fleetjax import priority, supervisors, tree
from fleetjax.allocation import allocate, helper_of
from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.learning import critic, imitation
from fleetjax.metrics import Metrics
from fleetjax.precision import in_32_bits
from fleetjax.types import EnvState, HumanState, Signals

CRITICS = ("safety", "goal")  # in the order of `metrics.LEARNT`


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
        resetting: bool[N] type of each robot's last intervention: hard reset, or teleoperation.
        learner: the robots' policy.
        human_data: what it learns from.
        critics: `CriticState` by kind, those that the algorithm needs.
        priority: the priority's own memory.
        origin: what it was prepared for.
    """

    timestep: jax.Array
    env: EnvState
    humans: HumanState
    resetting: jax.Array
    learner: imitation.LearnerState
    human_data: imitation.HumanData
    critics: dict[str, critic.CriticState]
    priority: Any
    origin: Origin = Origin("", "")


class Plan(NamedTuple):
    """Who needs whom at this timestep.

    Attributes:
        signals: Signals[N] that the scores were made from.
        robot_action: f32[N, A] what the robots' policy would do.
        score: f32[N] priorities.
        humans: HumanState[M], the allocation; `duration` counts the timesteps before this one.
        teleoperated: bool[N] robots that a human teleoperates.
        resetting: bool[N] robots that a human resets.
    """

    signals: Signals
    robot_action: jax.Array
    score: jax.Array
    humans: HumanState
    teleoperated: jax.Array
    resetting: jax.Array


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


class Fleet(NamedTuple):
    """Pure functions of a fleet. Keys: one a timestep, `fold_in(key, t)`.

    Attributes:
        plan: `(state, key, available bool[M] | None) -> (state, Plan)`.
        advance: `(state, Plan, human_action f32[N, A], given bool[N], key) -> (state, Metrics)`. `given` marks robots whose
            supervisor really gave that action; on other robots the policy acts, and nothing is recorded.
        step: `(state, key) -> (state, Metrics)`, with the simulated supervisor.
        logged_step: `(state, key) -> (state, (Metrics, Interventions[M]))`, the same and what the supervisor did.
    """

    plan: Callable[..., tuple[FleetState, Plan]]
    advance: Callable[..., tuple[FleetState, Metrics]]
    step: Callable[[FleetState, jax.Array], tuple[FleetState, Metrics]]
    logged_step: Callable[[FleetState, jax.Array], tuple[FleetState, tuple[Metrics, Interventions]]]


def init_state(
    config: Config,
    env: Env,
    key: jax.Array,
    policy: imitation.LearnerState,
    data: imitation.HumanData,
    critics: dict[str, critic.CriticState],
) -> FleetState:
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
        origin=Origin(env.spec.name, config.algorithm),
    )


@in_32_bits
def make_fleet(config: Config, env: Env) -> Fleet:
    """Compose environment, policy, critics, priority and supervisor into the timestep of a fleet."""
    algorithm = priority.get_algorithm(config.algorithm)
    rule = algorithm.make_priority(config)
    supervisor = supervisors.make(config.supervisor or env.spec.supervisor, env)
    learner = imitation.make_learner(config, env.spec)
    critics = {kind: critic.make_critic(kind, config, env.spec, learner) for kind in algorithm.critics}
    learn = _make_learning(config, learner, critics)
    num_robots = config.num_robots
    robots = jnp.arange(num_robots)

    def observe(state: FleetState) -> tuple[Signals, jax.Array]:
        """Return the signals and what the robots' policy would do."""
        obs = state.env.obs
        action, uncertainty = learner.predict(state.learner, obs)
        chance = {kind: c.value(state.critics[kind], state.learner.normalizer, obs, action) for kind, c in critics.items()}
        never = jnp.zeros(num_robots)
        signals = (uncertainty, chance.get("safety", never), chance.get("goal", never))
        uncertainty, risk, goal = (jnp.where(jnp.isfinite(x), x, 0.0) for x in signals)  # one robot must not spoil the ranks
        return Signals(state.env.violation, uncertainty, risk, goal, state.timestep), action

    def plan(state: FleetState, key: jax.Array, available: jax.Array | None = None) -> tuple[FleetState, Plan]:
        key_score, key_ties = jax.random.split(key)
        signals, robot_action = observe(state)
        score, memory = rule.score(signals, state.priority, key_score)
        min_time = jnp.where(state.resetting, config.hard_reset_time, config.min_teleop_time)
        humans = allocate(score, state.humans, min_time, key_ties, available)
        helped = helper_of(humans, num_robots) >= 0
        resetting, teleoperated = helped & signals.violation, helped & ~signals.violation
        humans = _restart_clocks(humans, state.resetting, resetting, config.hard_reset_time)
        return state._replace(priority=memory), Plan(signals, robot_action, score, humans, teleoperated, resetting)

    def advance(
        state: FleetState, plan: Plan, human_action: jax.Array, given: jax.Array, key: jax.Array
    ) -> tuple[FleetState, Metrics]:
        state, metrics, _ = act(state, plan, human_action, given, key)
        return state, metrics

    def act(
        state: FleetState, plan: Plan, human_action: jax.Array, given: jax.Array, key: jax.Array
    ) -> tuple[FleetState, Metrics, EnvState]:
        """Do what `advance` does; return also the robots' states after their step, before resets and new goals."""
        chex.assert_shape(human_action, (num_robots, env.spec.action_size))
        key_env, key_reset, key_goal, key_data, key_learn = jax.random.split(key, 5)
        given = given & plan.teleoperated
        moving = ~state.env.violation
        obs = state.env.obs
        action = jnp.where(given[:, None], human_action, plan.robot_action)

        keys = jax.random.split(key_env, num_robots)
        stepped = tree.where(moving, jax.vmap(env.step)(state.env, action, moving, keys), state.env)
        sound = tree.finite((obs, action, stepped.obs, stepped.reward))
        stepped = _contain(stepped, sound)
        humans = plan.humans._replace(duration=jnp.where(plan.humans.robot >= 0, plan.humans.duration + 1, 0))

        human_data, critic_states = state.human_data, state.critics
        if algorithm.updates:
            human_data = learner.append(human_data, imitation.Pair(obs, human_action), given & sound, key_data)
        steps = critic.Transition(obs, action, stepped.obs, stepped.violation, stepped.success)
        critic_states = {kind: c.append(critic_states[kind], steps, moving & sound) for kind, c in critics.items()}

        helper = helper_of(humans, num_robots)
        reset_done = plan.resetting & (humans.duration[helper] >= config.hard_reset_time)
        ended = stepped.timeout if env.next_goal else stepped.timeout | stepped.success
        fresh = jax.vmap(env.reset)(jax.random.split(key_reset, num_robots), robots)
        after = tree.where(reset_done | (moving & ended), fresh, stepped)
        if env.next_goal:
            renewed = jax.vmap(env.next_goal)(after, jax.random.split(key_goal, num_robots))
            after = tree.where(moving & stepped.success & ~ended, renewed, after)

        policy, loss = state.learner, jnp.zeros(())
        if algorithm.updates:
            policy, critic_states, loss = learn(policy, human_data, critic_states, key_learn)

        diverged = _diverged(policy, critic_states, state.priority)
        dropped = human_data.dropped - jnp.where(state.timestep > 0, state.human_data.dropped, 0)
        metrics = _measure(config, state, plan, stepped, moving, reset_done, dropped, diverged, loss)
        state = state._replace(
            timestep=state.timestep + 1,
            env=after,
            humans=humans,
            resetting=plan.resetting,
            learner=policy,
            human_data=human_data,
            critics=critic_states,
        )
        return state, metrics, stepped

    def logged_step(state: FleetState, key: jax.Array) -> tuple[FleetState, tuple[Metrics, Interventions]]:
        key_plan, key_human, key_advance = jax.random.split(key, 3)
        state, plan_ = plan(state, key_plan)
        human_action = jax.vmap(supervisor.act)(state.env, jax.random.split(key_human, num_robots))
        after, metrics, stepped = act(state, plan_, human_action, plan_.teleoperated, key_advance)
        return after, (metrics, _watch(state.env, plan_, human_action, stepped))

    def step(state: FleetState, key: jax.Array) -> tuple[FleetState, Metrics]:
        after, (metrics, _) = logged_step(state, key)
        return after, metrics

    return Fleet(in_32_bits(plan), in_32_bits(advance), in_32_bits(step), in_32_bits(logged_step))


def _make_learning(config: Config, learner: imitation.Learner, critics: dict[str, critic.Critic]) -> Callable[..., Any]:
    """Return `(LearnerState, HumanData, critics' states, key) -> (LearnerState, critics' states, loss f32[])`."""

    def learn(policy, human_data, critic_states, key):
        """Take the timestep's gradient steps, policy first."""

        def gradient_step(carry, key):
            policy, states = carry
            key_policy, key_critics = jax.random.split(key)
            policy, loss = learner.update(policy, human_data, key_policy)
            states = {kind: c.update(states[kind], policy, key_critics) for kind, c in critics.items()}
            return (policy, states), loss

        keys = jax.random.split(key, config.gradient_steps)
        (policy, critic_states), losses = jax.lax.scan(gradient_step, (policy, critic_states), keys)
        return policy, critic_states, jnp.sum(losses) / max(config.gradient_steps, 1)

    return learn


def _watch(before: EnvState, plan: Plan, human_action: jax.Array, stepped: EnvState) -> Interventions:
    """Return what each human did in a timestep that led the robots from `before` to `stepped`."""
    robot = plan.humans.robot
    actions = (plan.robot_action, human_action)
    outcome = (stepped.obs, stepped.reward, stepped.violation, stepped.success, stepped.timeout)
    score, step, obs, (planned, done), result = tree.take(
        (plan.score, before.episode_step, before.obs, actions, outcome), jnp.maximum(robot, 0)
    )
    robot = jnp.where((robot >= 0) & plan.teleoperated[robot], robot, -1)
    return Interventions(robot, score, step, obs, planned, done, *result)


def _restart_clocks(
    humans: HumanState, was_resetting: jax.Array, resetting: jax.Array, hard_reset_time: jax.Array | int
) -> HumanState:
    """Return `humans` with duration 0 where the kind of intervention changed, or the last hard reset is completed."""
    changed = was_resetting[humans.robot] != resetting[humans.robot]
    completed = was_resetting[humans.robot] & (humans.duration >= hard_reset_time)
    return humans._replace(duration=jnp.where(changed | completed, 0, humans.duration))


def _contain(env: EnvState, sound: jax.Array) -> EnvState:
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


def _diverged(policy: imitation.LearnerState, critics: dict[str, critic.CriticState], memory: Any) -> jax.Array:
    """Return i32[], the bits of what in `LEARNT` is not finite."""
    learnt = [policy.params, *((critics[k].params, critics[k].target) if k in critics else () for k in CRITICS), memory]
    flags = [~jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(part)])) for part in learnt]
    return sum((flag.astype(jnp.int32) << bit for bit, flag in enumerate(flags)), jnp.int32(0))


def _measure(
    config: Config,
    state: FleetState,
    plan: Plan,
    stepped: EnvState,
    moving: jax.Array,
    reset_done: jax.Array,
    dropped: jax.Array,
    diverged: jax.Array,
    loss: jax.Array,
) -> Metrics:
    """Count what happened in a timestep that began in `state` and led to `stepped`, before resets."""

    def count(mask: jax.Array) -> jax.Array:
        return jnp.sum(mask, dtype=jnp.int32)

    helper = helper_of(plan.humans, config.num_robots)
    switched = helper != helper_of(state.humans, config.num_robots)
    chosen = switched & (helper >= 0)
    certain = plan.signals.uncertainty < config.uncertainty_threshold
    at_risk = plan.signals.risk >= config.risk_threshold
    return Metrics(
        successes=count(moving & stepped.success),
        violations=count(moving & stepped.violation),
        hard_resets=count(reset_done),
        idle=count(~moving),
        human_steps=count(helper >= 0),
        teleop_steps=count(plan.teleoperated),
        switches=count(switched),
        moving=count(moving),
        choices=count(chosen),
        risk_choices=count(chosen & moving & certain & at_risk),
        dropped=dropped,
        diverged=diverged,
        reward=jnp.sum(jnp.where(moving, stepped.reward, 0.0)),
        uncertainty=jnp.sum(jnp.where(moving, plan.signals.uncertainty, 0.0))
        / jnp.maximum(count(moving), 1).astype(jnp.float32),
        policy_loss=loss,
    )

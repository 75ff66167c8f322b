"""Twin critics of what the robots' policy will run into: a violation (safety) or the goal.

Reference: paper, Section 4.2 and Appendix (training critic Q-functions).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.learning import buffer
from fleetjax.learning.imitation import Learner, PolicyState, stored_obs
from fleetjax.learning.networks import ADAM, Normalizer, descend, make_network
from fleetjax.tree import where

TWINS = 2


class Transition(NamedTuple):
    """A step of a moving robot.

    Attributes:
        obs: f32[O] before the step.
        action: f32[A] what was done.
        next_obs: f32[O] after it, before any reset or new goal.
        violation: bool[] whether it led to a violation.
        success: bool[] whether it completed the task.
    """

    obs: jax.Array
    action: jax.Array
    next_obs: jax.Array
    violation: jax.Array
    success: jax.Array


class CriticState(NamedTuple):
    """Parameters [2, ...], their slow copy, the optimizer's state, and rings of positives and of negatives."""

    params: Any
    target: Any
    opt_state: Any
    positives: buffer.Buffer
    negatives: buffer.Buffer


class Critic(NamedTuple):
    """Pure functions of one critic.

    Attributes:
        init: `key -> CriticState`.
        value: `(CriticState, Normalizer, obs f32[..., O], action f32[..., A]) -> f32[...]`, the pessimistic twin:
            the larger for risk, the smaller for the goal.
        append: `(CriticState, Transition[K], mask bool[K]) -> CriticState`.
        update: `(CriticState, PolicyState, key) -> CriticState`, one gradient step.
    """

    init: Callable[[jax.Array], CriticState]
    value: Callable[[CriticState, Normalizer, jax.Array, jax.Array], jax.Array]
    append: Callable[[CriticState, Transition, jax.Array], CriticState]
    update: Callable[[CriticState, PolicyState, jax.Array], CriticState]


def make_critic(kind: str, config: Config, spec: EnvSpec, learner: Learner) -> Critic:
    """Build the `"safety"` or the `"goal"` critic.

    Targets, with c', g' violation and success of the step and s' its successor before resets:

        safety: c' + (1 - c') risk_discount max_k Q_k(s', policy(s'))
        goal:   g' + (1 - g') (1 - c') goal_discount min_k Q_k(s', policy(s'))
    """
    safety = kind == "safety"
    discount = config.risk_discount if safety else config.goal_discount
    pessimistic = jnp.max if safety else jnp.min
    network = make_network(spec, config.hidden_sizes, 1)

    def init(key: jax.Array) -> CriticState:
        inputs = jnp.zeros(spec.observation_size + spec.action_size)
        params = jax.vmap(lambda k: network.init(k, inputs))(jax.random.split(key, TWINS))
        flag, obs = jnp.zeros((), bool), stored_obs(spec)
        example = Transition(obs, jnp.zeros(spec.action_size), obs, flag, flag)
        few = max(config.num_robots, config.critic_capacity // 10)
        return CriticState(
            params=params,
            target=jax.tree.map(jnp.copy, params),  # its own memory: both may be donated
            opt_state=ADAM.init(params),
            positives=buffer.create(example, few),
            negatives=buffer.create(example, config.critic_capacity),
        )

    def twins(params: Any, normalizer: Normalizer, obs: jax.Array, action: jax.Array) -> jax.Array:
        """f32[2, ...] probabilities."""
        inputs = jnp.concatenate([normalizer(obs), action], axis=-1)
        return jax.nn.sigmoid(jax.vmap(network.apply, in_axes=(0, None))(params, inputs)[..., 0])

    def value(state: CriticState, normalizer: Normalizer, obs: jax.Array, action: jax.Array) -> jax.Array:
        return pessimistic(twins(state.params, normalizer, obs, action), axis=0)

    def append(state: CriticState, steps: Transition, mask: jax.Array) -> CriticState:
        positive = steps.violation if safety else steps.success
        return state._replace(
            positives=buffer.append(state.positives, steps, mask & positive, overwrite=True),
            negatives=buffer.append(state.negatives, steps, mask & ~positive, overwrite=True),
        )

    def sample(state: CriticState, key: jax.Array) -> tuple[Transition, jax.Array]:
        """A batch with `positive_fraction` positives as far as there are any, and bool[B] whether a row holds data."""
        sizes = jnp.stack([state.positives.size, state.negatives.size])
        index = buffer.draw_index(key, (2, config.batch_size), sizes[:, None])
        wanted = jnp.arange(config.batch_size) < jnp.round(config.positive_fraction * config.batch_size).astype(jnp.int32)
        positive = (wanted & (state.positives.size > 0)) | (state.negatives.size == 0)
        batch = where(positive, buffer.read(state.positives, index[0]), buffer.read(state.negatives, index[1]))
        return batch, jnp.where(positive, *sizes) > 0

    def update(state: CriticState, policy: PolicyState, key: jax.Array) -> CriticState:
        batch, valid = sample(state, key)
        next_action, _ = learner.predict(policy, batch.next_obs)
        next_value = twins(state.target, policy.normalizer, batch.next_obs, next_action)
        reached = batch.violation if safety else batch.success
        ahead = jnp.where(batch.violation, 0.0, discount * pessimistic(next_value, axis=0))
        target = jnp.where(reached, 1.0, ahead)

        def loss(params: Any) -> jax.Array:
            error = twins(params, policy.normalizer, batch.obs, batch.action) - target
            return jnp.mean(jnp.where(valid, jnp.sum(error**2, axis=0), 0.0))

        params, opt_state = descend(state.params, jax.grad(loss)(state.params), state.opt_state, config.learning_rate)
        slow = optax.incremental_update(params, state.target, config.target_rate)
        return state._replace(params=params, target=slow, opt_state=opt_state)

    return Critic(init, value, append, update)


def train(critic: Critic, state: CriticState, policy: PolicyState, steps: jax.Array | int, key: jax.Array) -> CriticState:
    """Take gradient steps; the rings stay out of the loop's carry, which a sweep would copy at each turn."""
    rings = {"positives": state.positives, "negatives": state.negatives}

    def body(i, nets):
        params, target, opt_state = nets
        before = CriticState(params, target, opt_state, **rings)
        after = critic.update(before, policy, jax.random.fold_in(key, i))
        return after.params, after.target, after.opt_state

    nets = jax.lax.fori_loop(0, steps, body, (state.params, state.target, state.opt_state))
    return CriticState(*nets, **rings)

"""The robots' policy: an ensemble that imitates human data, each member its own bootstrap (paper, Sections 3 and 4.2).

Continuous actions: members regress the action and act with their mean; uncertainty is their variance. Discrete
actions: one classifier; uncertainty is its entropy.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec

from fleetjax import sharding
from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.learning import buffer
from fleetjax.learning.augmentation import augment
from fleetjax.learning.networks import ADAM, Normalizer, descend, make_network
from fleetjax.tree import take


class Pair(NamedTuple):
    """An observation f32[O] and what a human did there, action f32[A]."""

    obs: jax.Array
    action: jax.Array


class HumanData(NamedTuple):
    """All human data so far.

    Attributes:
        pairs: Buffer of `Pair`.
        resample: i32[capacity, E] for each member, the pairs that it learns from; `pairs.size` of them count.
        dropped: i32[] pairs so far for which there was no room.
        weight: f32[capacity] how much each pair counts, in the soft allocation; None in the hard one, where all count alike.
    """

    pairs: buffer.Buffer
    resample: jax.Array
    dropped: jax.Array
    weight: Any = None


class PolicyState(NamedTuple):
    """Parameters [E, ...] and optimizer state of the ensemble, and the normalizer of observations."""

    params: Any
    opt_state: Any
    normalizer: Normalizer


def num_members(spec: EnvSpec, ensemble_size: int) -> int:
    """Return how many networks the policy has: one classifier where actions are discrete."""
    return 1 if spec.discrete else ensemble_size


def create_data(spec: EnvSpec, *, ensemble_size: int, capacity: int, weighted: bool = False) -> HumanData:
    """Return an empty data set, in which pairs may have weights; those of demonstrations are 1."""
    example = Pair(stored_obs(spec), jnp.zeros(spec.action_size))
    resample = jnp.zeros((capacity, num_members(spec, ensemble_size)), jnp.int32)
    weight = jnp.ones(capacity, jnp.float32) if weighted else None
    return HumanData(buffer.create(example, capacity), resample, jnp.zeros((), jnp.int32), weight)


def data_of(config: Config, spec: EnvSpec) -> HumanData:
    """Return the empty data set of a run."""
    soft = config.allocation == "soft"
    return create_data(spec, ensemble_size=config.ensemble_size, capacity=config.human_capacity, weighted=soft)


def stored_obs(spec: EnvSpec) -> jax.Array:
    """Return an observation [O] of the type that buffers keep: pixel values need a byte each."""
    return jnp.zeros(spec.observation_size, jnp.uint8 if spec.image_shape else jnp.float32)


class Choice(NamedTuple):
    """Rows that were chosen from others.

    Attributes:
        rows: i32[K] which they are; `number` for none.
        number: how many there were.
    """

    rows: jax.Array
    number: int


def append(data: HumanData, pairs: Pair, mask: jax.Array, key: jax.Array, choice: Choice | None = None) -> HumanData:
    """Add the pairs [K] where `mask` bool[K] holds. For each, every member resamples one of all pairs so far.

    Pairs that are a `choice` draw what they would draw among all.

    Reference: paper, Section 4.2 (ensemble bootstrapped on subsets of the training data).
    """
    grown = buffer.append(data.pairs, pairs, mask, overwrite=False)
    among = mask.shape[0] if choice is None else choice.number
    draws = buffer.draw_index(key, (data.resample.shape[1], among), grown.size)
    draws = draws if choice is None else sharding.pin(draws, PartitionSpec(None, sharding.ROBOTS))[:, choice.rows]
    index = buffer.append(buffer.Buffer(data.resample, data.pairs.added), draws.T, mask, overwrite=False)
    added = grown.added - data.pairs.added
    return HumanData(grown, index.rows, data.dropped + jnp.sum(mask, dtype=jnp.int32) - added, data.weight)


def weigh(before: HumanData, after: HumanData, weight: jax.Array, mask: jax.Array) -> HumanData:
    """Return the data in which the pairs that led from `before` to `after`, where `mask` bool[K], count by `weight` f32[K]."""
    known = buffer.append(buffer.Buffer(before.weight, before.pairs.added), weight, mask, overwrite=False)
    return after._replace(weight=known.rows)


def append_augmented(
    data: HumanData,
    pairs: Pair,
    mask: jax.Array,
    key: jax.Array,
    choice: Choice | None = None,
    *,
    image_shape: tuple[int, int, int],
    copies: int,
) -> HumanData:
    """Add pairs as `append` does, each in several copies whose images are augmented.

    Reference: paper, Appendix (physical experiment protocol).
    """

    def add(data: HumanData, entry: tuple[Pair, jax.Array, jax.Array]) -> tuple[HumanData, None]:
        (obs, action), wanted, key = entry
        key_images, key_data = jax.random.split(key)

        def variants() -> jax.Array:
            keys = jax.random.split(key_images, copies)
            return jax.vmap(augment, in_axes=(None, 0))(obs.reshape(image_shape), keys).reshape(copies, -1)

        images = jax.lax.cond(wanted, variants, lambda: jnp.zeros((copies, obs.size)))
        same = Pair(images, jnp.broadcast_to(action, (copies, *action.shape)))
        return append(data, same, jnp.broadcast_to(wanted, copies), key_data), None

    keys = jax.random.split(key, mask.shape[0] if choice is None else choice.number)
    return jax.lax.scan(add, data, (pairs, mask, keys if choice is None else keys[choice.rows]))[0]


class Learner(NamedTuple):
    """Pure functions of the ensemble.

    Attributes:
        init: `(key, Normalizer) -> PolicyState`.
        predict: `(PolicyState, obs f32[..., O]) -> (action f32[..., A], uncertainty f32[...])`; the uncertainty lies in
            [0, 1] (discrete: entropy in nats).
        update: `(PolicyState, HumanData, key) -> (PolicyState, loss f32[])`, one gradient step.
        append: `(HumanData, Pair[K], mask bool[K], key, Choice | None) -> HumanData` adds pairs, in `augmented_copies` if so
            configured.
    """

    init: Callable[[jax.Array, Normalizer], PolicyState]
    predict: Callable[[PolicyState, jax.Array], tuple[jax.Array, jax.Array]]
    update: Callable[[PolicyState, HumanData, jax.Array], tuple[PolicyState, jax.Array]]
    append: Callable[..., HumanData] = append


def make_learner(config: Config, spec: EnvSpec) -> Learner:
    """Build the ensemble for a configuration and an environment."""
    members = num_members(spec, config.ensemble_size)
    network = make_network(spec, config.hidden_sizes, spec.action_size)

    def init(key: jax.Array, normalizer: Normalizer) -> PolicyState:
        params = jax.vmap(lambda k: network.init(k, normalizer.mean))(jax.random.split(key, members))
        return PolicyState(params, ADAM.init(params), normalizer)

    def outputs(params: Any, obs: jax.Array) -> jax.Array:
        """f32[E, ..., A] actions, or logits of the classifier; `obs` is normalised."""
        raw = jax.vmap(network.apply, in_axes=(0, None))(params, obs)
        return raw if spec.discrete else jnp.tanh(raw)

    def predict(state: PolicyState, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        answers = outputs(state.params, state.normalizer(obs))
        if spec.discrete:
            log_p = jax.nn.log_softmax(answers[0])
            return jax.nn.one_hot(jnp.argmax(log_p, axis=-1), spec.action_size), -jnp.sum(jnp.exp(log_p) * log_p, axis=-1)
        return jnp.mean(answers, axis=0), jnp.mean(jnp.var(answers, axis=0), axis=-1)  # on [-1, 1] no variance exceeds 1

    def loss(params: Any, obs: jax.Array, action: jax.Array, weight: jax.Array | None) -> jax.Array:
        answer = network.apply(params, obs)
        if spec.discrete:
            return jnp.mean(optax.softmax_cross_entropy(answer, action))
        error = (jnp.tanh(answer) - action) ** 2
        return jnp.mean(error if weight is None else weight[:, None] * error)

    def update(state: PolicyState, data: HumanData, key: jax.Array) -> tuple[PolicyState, jax.Array]:
        draw = buffer.draw_index(key, (members, config.batch_size), data.pairs.size)
        index = data.resample[draw, jnp.arange(members)[:, None]]
        batch = take(data.pairs.rows, index)
        weight = None if data.weight is None else data.weight[index]
        losses, grads = jax.vmap(jax.value_and_grad(loss))(state.params, state.normalizer(batch.obs), batch.action, weight)
        params, opt_state = descend(state.params, grads, state.opt_state, config.learning_rate)
        return state._replace(params=params, opt_state=opt_state), jnp.mean(losses)

    add = append
    if spec.image_shape and config.augmented_copies > 1:
        add = functools.partial(append_augmented, image_shape=spec.image_shape, copies=config.augmented_copies)
    return Learner(init, predict, update, add)

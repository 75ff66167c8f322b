"""How far a robot is from what humans have seen: distance to the K-th nearest state in which a human acted."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.field import PARAMETERS
from fleetjax.learning import buffer
from fleetjax.learning.estimator import Estimator
from fleetjax.learning.imitation import HumanData, Learner, PolicyState
from fleetjax.priority.learnt import NEIGHBOURS
from fleetjax.supervisors import Supervisor

REFERENCES, REFERENCE_IMAGES = 1024, 256  # states that stand for all human data
REPLACED = 4  # of them at each gradient step


class Seen(NamedTuple):
    """States in which humans acted.

    Attributes:
        states: [R, O] a sample of them, in the type that buffers keep.
        source: i32[R] the pair that each comes from, no two the same; -1 = there was none left.
        radius: f32[] what distances are measured in.
    """

    states: jax.Array
    source: jax.Array
    radius: jax.Array


def distance_to(obs: jax.Array, states: jax.Array, known: jax.Array, place: int) -> jax.Array:
    """Return f32[K], from each row of `obs` f32[K, O] the root mean squared distance to its `place`-th nearest of f32[R, O].

    Only states that are `known` bool[R] count; infinite if they are fewer than `place`.
    """
    squares = jnp.sum(obs**2, axis=1)[:, None] + jnp.sum(states**2, axis=1) - 2.0 * obs @ states.T
    squares = jnp.where(known, squares, jnp.inf)
    for _ in range(place - 1):  # several times as fast as `top_k` on a CPU
        squares = jnp.where(jax.nn.one_hot(jnp.argmin(squares, axis=1), states.shape[0], dtype=bool), jnp.inf, squares)
    return jnp.sqrt(jnp.maximum(jnp.min(squares, axis=1), 0.0) / obs.shape[1])


def make_novelty(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
    """Distance to the 5th nearest of 1,024 states (256 images) in which humans acted, in units of a radius.

    Distances are root mean squares of normalised observations. The radius is the quantile at level 1 - `crsail_rate` of this
    distance among the demonstrations, each state's own left out, and stays as it is. The states are drawn from the
    demonstrations without replacement, all of them if they are no more; each gradient step puts 4 drawn from all human data
    in the place of 4 others, or of none where there is room. So their density, on which distances depend, stays the same while
    data grow. Augmented copies of an image count as states of their own.

    Reference: CRSAIL, 2025 (arXiv 2512.00453); reimplemented from the text.
    """
    del learner, supervisor
    rate = config.parameters.get("crsail_rate", PARAMETERS["crsail"]["crsail_rate"].default)
    number = REFERENCE_IMAGES if env.spec.image_shape else REFERENCES

    def init(key: jax.Array, data: HumanData, policy: PolicyState) -> Seen:
        pairs = jnp.arange(data.pairs.capacity)
        order = jnp.where(pairs < data.pairs.size, jax.random.uniform(key, pairs.shape), -1.0)
        best, index = jax.lax.top_k(order, min(number, pairs.size))
        index = jnp.pad(jnp.where(best >= 0, index, -1), (0, number - index.size), constant_values=-1)
        states, known = data.pairs.rows.obs[index], index >= 0
        scaled = policy.normalizer(states)
        among = jnp.where(known, distance_to(scaled, scaled, known, NEIGHBOURS + 1), jnp.nan)
        return Seen(states, index, jnp.maximum(jnp.nanquantile(among, 1.0 - rate), 1e-6))

    def value(state: Seen, policy: PolicyState, obs: jax.Array, robot_action: jax.Array) -> jax.Array:
        del robot_action
        states = policy.normalizer(state.states)
        return distance_to(policy.normalizer(obs), states, state.source >= 0, NEIGHBOURS) / state.radius

    def update(state: Seen, policy: PolicyState, data: HumanData, key: jax.Array) -> Seen:
        del policy
        key_place, key_new = jax.random.split(key)
        free = (state.source < 0).astype(jnp.float32)
        place = jax.lax.top_k(free + jax.random.uniform(key_place, (number,)), REPLACED)[1]  # no two the same
        drawn = buffer.draw_index(key_new, (REPLACED,), data.pairs.size)
        earlier = jnp.tril(drawn[:, None] == drawn, k=-1).any(axis=1)
        new = ~earlier & ~jnp.isin(drawn, state.source) & (data.pairs.size > 0)
        place = jnp.where(new, place, number)  # beyond the last: dropped
        return state._replace(
            states=state.states.at[place].set(data.pairs.rows.obs[drawn], mode="drop"),
            source=state.source.at[place].set(drawn, mode="drop"),
        )

    return Estimator(init, value, lambda state, steps, moving: state, update)

"""Where a run's randomness comes from: the key of each timestep, and the keys of all that happens in it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fleetjax import sharding


class Keys(NamedTuple):
    """The keys of one timestep.

    Attributes:
        score: for the rule.
        ties: for the allocator.
        data: for recording human data.
        learn: for the gradient steps.
        human: key[N], for the supervisor.
        env: key[N], for the robots' steps.
        reset: key[N], for their resets.
        goal: key[N], for their new goals.
    """

    score: jax.Array
    ties: jax.Array
    data: jax.Array
    learn: jax.Array
    human: jax.Array
    env: jax.Array
    reset: jax.Array
    goal: jax.Array


def key_at(key: jax.Array, timestep: jax.Array | int) -> jax.Array:
    """Return the key of a timestep in the run that has `key`; timestep -1 stands for all that comes before the first.

    A run resumed at any timestep therefore draws what it would have drawn.
    """
    return jax.random.fold_in(key, timestep + 1)


def key_of_people(key: jax.Array) -> jax.Array:
    """Return the key of the human model, at the timestep whose key is given; `split_keys` has other ones."""
    return jax.random.fold_in(key, 2**31 - 1)


def key_of_presence(key: jax.Array) -> jax.Array:
    """Return the key of who is there, at the timestep whose key is given."""
    return jax.random.fold_in(key, 2**31 - 3)


def key_of_links(key: jax.Array) -> jax.Array:
    """Return the key of the links, at the timestep whose key is given."""
    return jax.random.fold_in(key, 2**31 - 2)


def split_keys(key: jax.Array, num_robots: int) -> Keys:
    """Return the keys of the timestep whose key is given, by a single split, which compiles and runs fastest."""
    if sharding.division() is None:
        keys = jax.random.split(key, 4 * (1 + num_robots))
        return Keys(*keys[:4], *keys[4:].reshape(4, num_robots))
    fold = jax.vmap(jax.random.fold_in, (None, 0))  # the same keys: each device makes those of its own robots alone
    robot = jnp.arange(num_robots, dtype=jnp.uint32)
    own = [sharding.pin(fold(key, 4 + kind * num_robots + robot), sharding.DIVIDED) for kind in range(4)]
    return Keys(*fold(key, jnp.arange(4, dtype=jnp.uint32)), *own)

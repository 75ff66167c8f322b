"""Who helps whom: Fleet-DAgger's allocation of humans to robots (paper, Algorithm 1)."""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from fleetjax import sharding
from fleetjax.types import HumanState, Signals

# `(score f32[N], humans HumanState[M], min_time i32[N], key, available bool[M] | None, signals | None) -> HumanState[M]`.
# It keeps humans who are bound, as `allocate` does, and helps nobody whose score is 0.
Allocator = Callable[..., HumanState]


def allocate(
    score: jax.Array,
    humans: HumanState,
    min_time: jax.Array,
    key: jax.Array,
    available: jax.Array | None = None,
    signals: Signals | None = None,
) -> HumanState:
    """Assign humans to the robots with the highest positive scores.

    A human whose intervention is younger than its minimum time is bound: it stays, and its robot leaves the
    competition. The other robots with positive scores get the other humans, highest score first. A human whose robot is
    chosen again stays with it; the rest of the chosen robots go to the rest of the humans in order. Ties are broken at random.

    Args:
        score: f32[N] priority of each robot; 0 or NaN = no help.
        humans: HumanState[M] at the end of the last timestep.
        min_time: i32[N] shortest intervention on each robot (timesteps).
        key: random key, for ties.
        available: bool[M] humans who are there; None = all.
        signals: Signals[N], for allocators that look at more than scores; this one does not.

    Returns:
        HumanState[M]: `duration` is unchanged for a human that stays and 0 for one newly assigned or free.

    >>> idle = HumanState(robot=jnp.full(2, -1), duration=jnp.zeros(2, jnp.int32))
    >>> allocate(jnp.array([0.0, 2.0, 1.0, 3.0]), idle, jnp.full(4, 5), jax.random.key(0)).robot.tolist()
    [3, 1]

    Reference: Fleet-DAgger, Section 4.1 and Appendix (Algorithm 1).
    """
    del signals
    num_robots, num_humans = score.shape[0], humans.robot.shape[0]
    chex.assert_shape([score, min_time], (num_robots,))
    chex.assert_shape([humans.robot, humans.duration], (num_humans,))
    if available is None:
        available = jnp.ones(num_humans, bool)
    nobody = -jnp.ones((), humans.robot.dtype)

    assigned = available & (humans.robot >= 0)
    bound = available & is_bound(humans, min_time)
    unlocked = available & ~bound

    competing = jnp.where(score > 0, score, 0.0)  # a NaN is not > 0
    competing = sharding.put(competing, jnp.where(bound, humans.robot, num_robots), 0.0)
    best, chosen = choose(competing, key, min(num_humans, num_robots))
    is_chosen = (best > 0) & (jnp.arange(chosen.size) < jnp.sum(unlocked))

    chosen_robots = sharding.put(jnp.zeros(num_robots, bool), chosen, is_chosen)
    stays = unlocked & assigned & chosen_robots[humans.robot]
    kept_robots = sharding.put(jnp.zeros(num_robots, bool), jnp.where(stays, humans.robot, num_robots), True)

    is_new = is_chosen & ~kept_robots[chosen]
    place = jnp.where(is_new, jnp.cumsum(is_new) - 1, num_humans)
    queue = jnp.full(num_humans, nobody).at[place].set(chosen.astype(nobody.dtype), mode="drop")
    waiting = unlocked & ~stays
    turn = jnp.cumsum(waiting) - 1

    keeps = bound | stays
    robot = jnp.where(keeps, humans.robot, jnp.where(waiting, queue[turn], nobody))
    return HumanState(robot=robot, duration=jnp.where(keeps, humans.duration, 0))


def is_bound(humans: HumanState, min_time: jax.Array) -> jax.Array:
    """Return bool[M], the humans whose intervention is younger than the minimum time i32[N] of its robot."""
    return (humans.robot >= 0) & (humans.duration < min_time[humans.robot])


def choose(score: jax.Array, key: jax.Array, number: int) -> tuple[jax.Array, jax.Array]:
    """Return f32[K] the highest scores of f32[N] in falling order, and i32[K] whose they are; ties are in random order.

    On a mesh each device chooses among its own robots; the choice among these is the choice among all.
    """
    n = score.shape[0]
    if sharding.division() is None:
        order = tie_order(key, n)
        best, rank = jax.lax.top_k(score[order], number)
        return best, order[rank]

    def best_of(score: jax.Array, bits: jax.Array, robot: jax.Array) -> tuple[jax.Array, ...]:
        order = jnp.argsort(bits)
        best, rank = jax.lax.top_k(score[order], min(number, score.size))
        return best, bits[order[rank]], robot[order[rank]]

    def best_of_all(*own: jax.Array) -> tuple[jax.Array, jax.Array]:
        best, _, robot = best_of(*sharding.gather(best_of(*own)))
        return best, robot

    everyone = (score, jax.random.bits(key, (n,)), jnp.arange(n))
    return sharding.on_each(best_of_all, sharding.EVERYWHERE, *everyone)


def tie_order(key: jax.Array, num_robots: int) -> jax.Array:
    """Return i32[N], the robots in random order."""
    return jnp.argsort(jax.random.bits(key, (num_robots,)))  # one draw, where `jax.random.permutation` splits the key first


def helper_of(humans: HumanState, num_robots: int) -> jax.Array:
    """Return i32[N], the human that helps each robot, -1 = none."""
    num_humans = humans.robot.shape[0]
    place = jnp.where(humans.robot >= 0, humans.robot, num_robots)
    return sharding.put(jnp.full(num_robots, -1, jnp.int32), place, jnp.arange(num_humans, dtype=jnp.int32))

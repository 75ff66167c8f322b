"""The soft fleet: robots get shares of humans, so that derivatives exist (`allocation = "soft"`).

As the temperature falls to 0, it becomes the hard fleet of the paper. What stays hard: violations, resets, the ends of
episodes, which pairs are stored and drawn, and who is bound to whom.
"""

import jax
import jax.numpy as jnp

from fleetjax.allocation import helper_of, is_bound
from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.metrics import Metrics
from fleetjax.types import EnvState, HumanState, Plan


def share(config: Config, humans: HumanState, weight: jax.Array, score: jax.Array, min_time: jax.Array) -> jax.Array:
    """Return f32[N], how much of a human each robot gets: what it had, if its human is bound to it.

    Args:
        config: configuration.
        humans: HumanState[M] at the end of the last timestep.
        weight: f32[N] how much each robot had then.
        score: f32[N] priorities.
        min_time: i32[N] shortest intervention on each robot.
    """
    helper = helper_of(humans, config.num_robots)
    bound = (helper >= 0) & is_bound(humans, min_time)[helper]
    free = config.num_humans - jnp.sum(bound)
    return jnp.where(bound, weight, soft_top_k(jnp.where(bound, 0.0, score), free, config.temperature))


def blend(planned: Plan, human_action: jax.Array) -> jax.Array:
    """Return f32[N, A], what robots do: their policy's action, moved towards the human's by their weight."""
    return planned.robot_action + planned.weight[:, None] * (human_action - planned.robot_action)


def relax(config: Config, env: Env, counts: Metrics, weight: jax.Array, stepped: EnvState, moving: jax.Array) -> Metrics:
    """Return the metrics with human time by weights f32[N], and successes by sigmoids of how far robots are beyond success."""
    if env.success_margin:
        margin = jax.vmap(env.success_margin)(stepped)
        judged = moving & ~stepped.violation
    else:  # by returns, at the end of an episode
        margin = (stepped.episode_return - config.success_return) / jnp.maximum(jnp.abs(config.success_return), 1.0)
        judged = moving & stepped.timeout
    reached = jnp.where(judged, jax.nn.sigmoid(margin / config.temperature), 0.0)
    teleoperated = jnp.where(moving, weight, 0.0)
    return counts._replace(successes=jnp.sum(reached), human_steps=jnp.sum(weight), teleop_steps=jnp.sum(teleoperated))


def soft_top_k(score: jax.Array, k: jax.Array, temperature: jax.Array | float) -> jax.Array:
    """Return f32[N], how much of a human each robot gets, at most `k` in total: a relaxation of the `k` highest scores.

    The share of a robot with score s is tanh(s / temperature) sigmoid((s - level) / temperature): 0 for score 0, and about 1
    well above the level, the lowest at which the total is at most `k`. As the temperature falls to 0, shares become 1 for
    the robots that `allocate` helps when all humans are free, and 0 for the others. Robots with equal scores have equal shares.

    Args:
        score: f32[N] priority of each robot, >= 0; 0 or NaN = no help.
        k: i32[] or f32[], number of humans.
        temperature: f32[] > 0, in units of scores.

    The level is found by bisection. A Newton step at the end, whose value is 0, gives it the derivative that the implicit
    function theorem gives, in both modes of differentiation.
    """
    score = jnp.where(score > 0, score, 0.0)  # a NaN is not > 0
    k, temperature = (jnp.asarray(x, score.dtype) for x in (k, temperature))
    sought = jnp.tanh(score / temperature)

    def shares(level: jax.Array, score: jax.Array, sought: jax.Array, temperature: jax.Array) -> jax.Array:
        return sought * jax.nn.sigmoid((score - level) / temperature)

    fixed = jax.lax.stop_gradient((score, sought, temperature))
    lowest, highest = -40.0 * fixed[2], jnp.max(fixed[0]) + 40.0 * fixed[2]  # there sigmoids are 1 and 0 to rounding

    def halve(_: int, bounds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bounds
        middle = (low + high) / 2
        too_many = jnp.sum(shares(middle, *fixed)) > k
        return jnp.where(too_many, middle, low), jnp.where(too_many, high, middle)

    level = jax.lax.fori_loop(0, 40, halve, (lowest, highest))[1]
    at_level = shares(level, *fixed)
    slope = -jnp.sum(at_level * (1.0 - at_level / jnp.maximum(fixed[1], 1e-30))) / fixed[2]
    total = jnp.sum(shares(level, score, sought, temperature))
    newton = level - (total - jax.lax.stop_gradient(total)) / jnp.minimum(slope, -1e-12)
    scarce = jnp.sum(fixed[1]) > k  # else the level stays below all scores
    return shares(jnp.where(scarce, newton, lowest), score, sought, temperature)

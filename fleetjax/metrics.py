"""What is counted in a timestep, and the return on human effort (paper, Sections 3 and 5.1)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import sharding
from fleetjax.allocation import helper_of
from fleetjax.config import Config
from fleetjax.types import EnvState, HumanState, Plan

LEARNT = (
    "policy",
    "safety critic",
    "goal critic",
    "priority",
    "another estimator",
)  # what can diverge, in the order of its bits


class Metrics(NamedTuple):
    """Counts of one timestep over the fleet, not cumulative; [T] after a run. i32 unless said otherwise.

    Attributes:
        successes: robots whose step completed the task.
        violations: moving robots whose step led to a violation (the paper's "hard resets").
        hard_resets: hard resets completed.
        idle: robots in violation at the start of the timestep, waiting or being reset.
        human_steps: humans assigned.
        teleop_steps: humans teleoperating.
        switches: robots whose human differs from the last timestep's, starts and ends included.
        moving: robots that acted.
        choices: robots newly given to a human.
        risk_choices: those of them chosen for their risk alone: no violation, uncertainty below its threshold.
        dropped: pairs of human data for which there was no room; at t = 0 also those of the demonstrations.
        diverged: what of `LEARNT` is not finite, the sum of 1, 2, 4, 8 and 16 for each; see `first_divergence`.
        reward: f32 sum of rewards over moving robots.
        uncertainty: f32 mean over moving robots.
        policy_loss: f32 mean imitation loss of the timestep's gradient steps.
    """

    successes: jax.Array
    violations: jax.Array
    hard_resets: jax.Array
    idle: jax.Array
    human_steps: jax.Array
    teleop_steps: jax.Array
    switches: jax.Array
    moving: jax.Array
    choices: jax.Array
    risk_choices: jax.Array
    dropped: jax.Array
    diverged: jax.Array
    reward: jax.Array
    uncertainty: jax.Array
    policy_loss: jax.Array


def rohe(metrics: Metrics, config: Config, time_unit: float = 100) -> jax.Array:
    """Return on human effort, cumulative at every timestep: (M / N) successes / (1 + human_steps / time_unit).

    Args:
        metrics: counts [..., T].
        config: gives N and M.
        time_unit: timesteps that count as one unit of human time; the paper counts in hundreds.

    Returns:
        f32[..., T].

    Reference: paper, Equation 2 and Section 5.1.
    """
    # f32 is exact up to 2^24, and beyond i32 there are fleets that count on.
    successes, human_steps = (jnp.cumsum(x, axis=-1, dtype=jnp.float32) for x in (metrics.successes, metrics.human_steps))
    return (config.num_humans / config.num_robots) * successes / (1.0 + human_steps / time_unit)


def first_divergence(metrics: Metrics) -> tuple[int, tuple[str, ...]] | None:
    """Return the first timestep with NaN or infinity in something learnt, and its names; None if there was none.

    Args:
        metrics: counts [T] of one run, as they come out of it.
    """
    diverged = np.asarray(metrics.diverged)
    if not diverged.any():
        return None
    first = int(np.argmax(diverged != 0))
    return first, tuple(name for bit, name in enumerate(LEARNT) if diverged[first] >> bit & 1)


def measure(
    config: Config,
    planned: Plan,
    before: HumanState,
    stepped: EnvState,
    moving: jax.Array,
    reset_done: jax.Array,
    dropped: jax.Array,
    diverged: jax.Array,
    loss: jax.Array,
) -> Metrics:
    """Count what happened in a timestep.

    Args:
        config: configuration.
        planned: who helped whom.
        before: HumanState[M] at the end of the timestep before.
        stepped: EnvState[N] after the step, before resets and new goals.
        moving: bool[N] robots that acted.
        reset_done: bool[N] hard resets completed.
        dropped: i32[] pairs without room.
        diverged: i32[] see `Metrics`.
        loss: f32[] mean imitation loss.
    """

    def count(mask: jax.Array) -> jax.Array:
        return jnp.sum(mask, dtype=jnp.int32)

    helper = helper_of(planned.humans, config.num_robots)
    switched = helper != helper_of(before, config.num_robots)
    chosen = switched & (helper >= 0)
    certain = planned.signals.uncertainty < config.uncertainty_threshold
    at_risk = planned.signals.risk >= config.risk_threshold
    return Metrics(
        successes=count(moving & stepped.success),
        violations=count(moving & stepped.violation),
        hard_resets=count(reset_done),
        idle=count(~moving),
        human_steps=count(helper >= 0),
        teleop_steps=count(planned.teleoperated),
        switches=count(switched),
        moving=count(moving),
        choices=count(chosen),
        risk_choices=count(chosen & moving & certain & at_risk),
        dropped=dropped,
        diverged=diverged,
        reward=sharding.total(jnp.where(moving, stepped.reward, 0.0)),
        uncertainty=sharding.total(jnp.where(moving, planned.signals.uncertainty, 0.0))
        / jnp.maximum(count(moving), 1).astype(jnp.float32),
        policy_loss=loss,
    )

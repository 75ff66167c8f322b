"""What a timestep is worth: counts over the fleet, and the return on human effort (paper, Sections 3 and 5.1)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax.config import Config

LEARNT = ("policy", "safety critic", "goal critic", "priority")  # what can diverge, in the order of its bits


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
        risk_choices: those of them that only their risk spoke for: no violation, uncertainty below its threshold.
        dropped: pairs of human data for which there was no room; at t = 0 also those of the demonstrations.
        diverged: what of `LEARNT` holds numbers that are not finite, the sum of 1, 2, 4 and 8 for each; see `first_divergence`.
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
    """Return the first timestep after which something learnt was not finite, and what; None if all was always finite.

    Args:
        metrics: counts [T] of one run, as they come out of it.
    """
    diverged = np.asarray(metrics.diverged)
    if not diverged.any():
        return None
    first = int(np.argmax(diverged != 0))
    return first, tuple(name for bit, name in enumerate(LEARNT) if diverged[first] >> bit & 1)

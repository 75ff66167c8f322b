"""Four scripted robots and two humans, played for twelve timesteps with given scores: what happens is known by heart."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_envs
from compiling import compiled

import fleetjax
from fleetjax import priority
from fleetjax.learning import imitation
from fleetjax.priority import Algorithm, Priority
from reference import recording

N, M, T, HORIZON = 4, 2, 12, 10
TINY = {"hidden_sizes": (2,), "ensemble_size": 2, "batch_size": 4, "num_demonstrations": 4, "critic_capacity": 100}
NOBODY = [0, 0, 0, 0]


@functools.cache
def program(*, new_goals: bool = False, gradient_steps: int = 0) -> Any:
    """Return a compiled `(scores[T, N], falls_at[N], succeeds_at[N], timing, silence) -> Trace`; all of these are traced."""

    def run(scores, falls_at, succeeds_at, timing: dict[str, int], silence):
        rule = Priority(lambda: (), lambda signals, aux, key: (scores[signals.timestep], aux))
        env = toy_envs.scripted(falls_at, succeeds_at, horizon=HORIZON, new_goals=new_goals)
        sizes = {"num_robots": N, "num_humans": M, "num_steps": T, "gradient_steps": gradient_steps}
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(
                priority.ALGORITHMS.entries, "scripted", Algorithm(lambda config: rule, estimators=("safety", "goal"))
            )
            config = fleetjax.make_config(env, "scripted", **sizes, **TINY).replace(**timing)
            start = recording.start(config, env, jax.random.key(1))
            fleet = fleetjax.make_fleet(config, env)
            return recording.record(config, env, fleet, start, jax.random.key(0), silence=silence)

    return compiled(run)


def play(
    scores: Sequence[Sequence[float]], *, falls_at=NOBODY, succeeds_at=NOBODY, t_T=5, t_R=5, silence=0.0, **static: Any
) -> recording.Trace:
    """Play a scenario; the last row of scores goes on to the end."""
    table = np.array([*scores, *[scores[-1]] * (T - len(scores))], np.float32)
    timing = {"min_teleop_time": t_T, "hard_reset_time": t_R}
    trace = program(**static)(table, np.array(falls_at), np.array(succeeds_at), timing, silence)
    return jax.tree.map(np.asarray, trace)


class Counter(NamedTuple):
    """An optimizer state that only counts."""

    count: jax.Array  # pyright: ignore[reportIncompatibleMethodOverride]


def make_counting_learner(config, spec) -> imitation.Learner:
    """A policy whose action and uncertainty are the number of pairs that it has seen, by hundreds."""

    def update(state, data, key):
        seen = data.pairs.size.astype(jnp.float32) / 100
        return state._replace(params=seen, opt_state=Counter(state.opt_state.count + 1)), seen

    return imitation.Learner(
        init=lambda key, normalizer: imitation.PolicyState(jnp.zeros(()), Counter(jnp.int32(0)), normalizer),
        predict=lambda state, obs: (
            jnp.broadcast_to(state.params, (*obs.shape[:-1], spec.action_size)),
            jnp.broadcast_to(state.params, obs.shape[:-1]),
        ),
        update=update,
    )

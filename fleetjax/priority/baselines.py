"""Rules to compare with: help for violations alone, random help, help for everyone."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from fleetjax.environments import CUR_HUMAN_TIME
from fleetjax.field import PARAMETERS
from fleetjax.priority.base import Algorithm, Priority, stateless
from fleetjax.priority.ranks import above


def constraint(config) -> Priority:
    """C: robots in violation, all alike (paper, Section 4.2, Constraint)."""
    del config
    return stateless(lambda signals, key: signals.violation.astype(jnp.float32))


def everyone(config) -> Priority:
    """All robots alike; with as many humans as robots this is full teleoperation (paper, Appendix, Expert)."""
    del config
    return stateless(lambda signals, key: jnp.ones_like(signals.uncertainty))


def uniform(config) -> Priority:
    """Random: U(0, 1) for each robot and timestep, 0 below `random_threshold` (paper, Section 4.2, Random)."""

    def score(signals, key):
        return above(jax.random.uniform(key, signals.uncertainty.shape), config.parameters["random_threshold"])

    return stateless(score)


def as_many_demonstrations(config) -> Mapping[str, Any]:
    """Give C.U.R.'s human time on this environment as extra demonstrations (paper, Section 5.1, Constraint)."""
    return {"extra_demonstrations": CUR_HUMAN_TIME.get(config.environment, 0)}


def as_many_gradient_steps(config) -> Mapping[str, Any]:
    """Give, in addition, as many gradient steps as the online algorithms take in total."""
    steps = config.pretraining_steps + config.num_steps * config.gradient_steps
    return {**as_many_demonstrations(config), "pretraining_steps": steps}


def as_many_humans(config) -> Mapping[str, Any]:
    """Give every robot its human."""
    return {"num_humans": config.num_robots}


BASELINES: dict[str, Algorithm] = {
    "constraint": Algorithm(constraint, updates=False, defaults=as_many_demonstrations),
    "constraint_trained": Algorithm(constraint, updates=False, defaults=as_many_gradient_steps),
    "random": Algorithm(uniform, parameters=PARAMETERS["random"]),
    "expert": Algorithm(everyone, pretrains=False, updates=False, defaults=as_many_humans),
}

"""The environments by name, and the defaults that each changes.

Their modules are imported when they are made, so that the help of the command line can name them without loading JAX.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from fleetjax.registry import Registry

# Human timesteps, hard resets included, that C.U.R. asked for in a run with default settings; the `constraint` baseline gets as
# many extra demonstrations. Means of three seeds, measured by `python experiments/human_time.py RUN...`, which
# also prints the `random_threshold` that asks for as much.
CUR_HUMAN_TIME: dict[str, int] = {
    "allegro_hand": 20996,
    "anymal": 16435,
    "block_push": 306,
    "humanoid": 8695,
    "navigation": 19424,
}


class Entry(NamedTuple):
    """A registered environment.

    Attributes:
        make_env: `backend -> Env`.
        defaults: what it changes, by the name of the parameter.
    """

    make_env: Callable[[str], Any]
    defaults: Mapping[str, Any]


def _robot(name: str) -> Callable[[str], Any]:
    def make_env(backend: str) -> Any:
        return importlib.import_module(f"fleetjax.envs.{name}").make_env(backend=backend)

    return make_env


def _pure(name: str) -> Callable[[str], Any]:
    def make_env(backend: str) -> Any:
        del backend  # pure JAX
        return importlib.import_module(f"fleetjax.envs.{name}").make_env()

    return make_env


_SHIPPED: dict[str, Entry] = {
    "humanoid": Entry(_robot("humanoid"), {"uncertainty_threshold": 0.05, "random_threshold": 0.99825, "initial_period": 1000}),
    "anymal": Entry(_robot("anymal"), {"uncertainty_threshold": 0.05, "random_threshold": 0.99668, "initial_period": 250}),
    "allegro_hand": Entry(
        _robot("allegro_hand"), {"uncertainty_threshold": 0.15, "random_threshold": 0.99575, "initial_period": 2500}
    ),
    "block_push": Entry(
        _pure("block_push"),
        {
            "num_robots": 4,
            "num_humans": 2,
            "num_steps": 250,
            "min_teleop_time": 3,
            "hidden_sizes": (128,),
            "batch_size": 64,
            "gradient_steps": 2,
            "uncertainty_threshold": 0.9,
            "random_threshold": 0.844,
            "num_demonstrations": 375,
            "augmented_copies": 10,
            "critic_capacity": 4000,
            "num_critic_transitions": 2000,
            "critic_pretraining_steps": 500,
        },
    ),
    "navigation": Entry(
        _pure("navigation"),
        {
            "hidden_sizes": (64, 64),
            "num_steps": 2000,
            "uncertainty_threshold": 0.03,
            "random_threshold": 0.959,
            "initial_period": 500,
            "num_demonstrations": 500,
            "batch_size": 128,
            "gradient_steps": 4,
            "learning_rate": 1e-3,
            "critic_capacity": 50_000,
        },
    ),
}


ENVIRONMENTS: Registry[Entry] = Registry("environment")
for _name, _entry in _SHIPPED.items():
    ENVIRONMENTS.register(_name, _entry)


def list_envs() -> tuple[str, ...]:
    """Return the registered names."""
    return ENVIRONMENTS.names()


def get_defaults(name: str) -> Mapping[str, Any]:
    """Return the defaults that an environment changes.

    Raises:
        ValueError: if there is none of that name; the message has the closest ones.
    """
    return ENVIRONMENTS.get(name).defaults

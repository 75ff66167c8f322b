"""Environments: the contract, the registry, and the environments that ship."""

import functools
import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from fleetjax.envs.adapters import from_brax, from_playground
from fleetjax.envs.base import Env, EnvSpec, Scene, begin, proceed
from fleetjax.registry import Registry

__all__ = [
    "Env",
    "EnvSpec",
    "Scene",
    "begin",
    "from_brax",
    "from_playground",
    "get_defaults",
    "list_envs",
    "make",
    "proceed",
    "register_env",
]

# Human timesteps, hard resets included, that C.U.R. asked for in a run with default settings; the `constraint` baseline gets
# as many extra demonstrations. Means of three seeds (block_push, navigation), two (humanoid) and one (the others), measured by
# `python experiments/human_time.py RUN...`, which also prints the `random_threshold` that asks for as much.
CUR_HUMAN_TIME: dict[str, int] = {
    "allegro_hand": 2228,
    "anymal": 10618,
    "block_push": 306,
    "humanoid": 9684,
    "navigation": 19424,
}


class _Entry(NamedTuple):
    make_env: Callable[..., Env]
    defaults: Mapping[str, Any]


def _robot(name: str) -> Callable[[str], Env]:
    def make_env(backend: str) -> Env:
        return importlib.import_module(f"fleetjax.envs.{name}").make_env(backend=backend)

    return make_env


def _pure(name: str) -> Callable[[str], Env]:
    def make_env(backend: str) -> Env:
        del backend  # pure JAX
        return importlib.import_module(f"fleetjax.envs.{name}").make_env()

    return make_env


_SHIPPED: dict[str, _Entry] = {
    "humanoid": _Entry(
        _robot("humanoid"), {"uncertainty_threshold": 0.05, "random_threshold": 0.99807, "initial_period": 1000}
    ),
    "anymal": _Entry(_robot("anymal"), {"uncertainty_threshold": 0.05, "random_threshold": 0.99788, "initial_period": 250}),
    "allegro_hand": _Entry(
        _robot("allegro_hand"), {"uncertainty_threshold": 0.15, "random_threshold": 0.99958, "initial_period": 2500}
    ),
    "block_push": _Entry(
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
    "navigation": _Entry(
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


ENVIRONMENTS: Registry[_Entry] = Registry("environment")
for _name, _entry in _SHIPPED.items():
    ENVIRONMENTS.register(_name, _entry)


def register_env(name: str, make_env: Callable[[str], Env], *, defaults: Mapping[str, Any] | None = None) -> None:
    """Make an environment available to `make_config` under `name`.

    Args:
        name: what users call it.
        make_env: `backend -> Env`; called once for each backend.
        defaults: `Config` fields, and algorithms' own parameters, whose default it changes.

    Raises:
        ValueError: if the name is taken.
    """
    ENVIRONMENTS.register(name, _Entry(make_env, dict(defaults or {})))


def list_envs() -> tuple[str, ...]:
    """Return the registered names."""
    return ENVIRONMENTS.names()


def get_defaults(name: str) -> Mapping[str, Any]:
    """Return the defaults that an environment changes.

    Raises:
        ValueError: if there is none of that name; the message has the closest ones.
    """
    return ENVIRONMENTS.get(name).defaults


def make(name: str, backend: str = "auto") -> Env:
    """Return a registered environment; the same object for the same arguments.

    Args:
        name: registered name.
        backend: physics backend; environments without MuJoCo ignore it.

    Raises:
        ValueError: if a name is unknown.
    """
    return _make(name, backend)


@functools.cache  # by position: a cached function would keep a default apart from the same value given
def _make(name: str, backend: str) -> Env:
    make_env = ENVIRONMENTS.get(name).make_env
    with jax.ensure_compile_time_eval(), jax.enable_x64(False):  # constants must outlive the trace that may be running
        return make_env(backend)

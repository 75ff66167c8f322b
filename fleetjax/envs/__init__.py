"""Environments: the contract, the registered ones, and adapters for those of other libraries."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax

from fleetjax.environments import ENVIRONMENTS, Entry, get_defaults, list_envs
from fleetjax.envs.adapters import from_brax, from_playground
from fleetjax.envs.base import Env, EnvSpec, Scene, begin, proceed

__all__ = [
    "ENVIRONMENTS",
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


def register_env(name: str, make_env: Callable[[str], Env], *, defaults: Mapping[str, Any] | None = None) -> None:
    """Make an environment available to `make_config` under `name`.

    Args:
        name: what users call it.
        make_env: `backend -> Env`; called once for each backend.
        defaults: `Config` fields, and algorithms' own parameters, whose default it changes.

    Raises:
        ValueError: if the name is taken.
    """
    ENVIRONMENTS.register(name, Entry(make_env, dict(defaults or {})))


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

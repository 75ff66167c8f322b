"""Environments of brax and of MuJoCo Playground behind fleetjax's contract.

The raw environment is used, without the wrappers that reset it by themselves or cut its episodes: `done` then means an
unhealthy end, which is a violation here; the horizon is ours. Pass what these functions return to `run(..., env=env)`.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from fleetjax.envs import base
from fleetjax.precision import in_32_bits
from fleetjax.types import EnvState


@in_32_bits
def from_brax(
    name: str, *, supervisor: str, horizon: int = 1000, success_return: float | None = None, **kwargs: Any
) -> base.Env:
    """Build an environment from one that brax registers.

    Args:
        name: brax's name, such as `"ant"`.
        supervisor: registered name of the supervisor that helps by default.
        horizon: control steps after which an episode times out.
        success_return: undiscounted return above which an episode of full length succeeds; None = never.
        **kwargs: arguments of brax's environment, such as `backend="generalized"`.

    Raises:
        ValueError: if brax has no environment of that name.
    """
    importlib.import_module("fleetjax.physics.mjx")  # brax imports MJX, which prints unless it was imported there before
    from brax import envs as brax_envs

    known = brax_envs._envs  # brax lists its environments nowhere else
    if name not in known:
        raise ValueError(f"brax environment = {name!r} is unknown; choose one of {', '.join(sorted(known))}")
    raw = brax_envs.get_environment(name, **kwargs).unwrapped
    return _adapt(raw, f"brax/{name}", supervisor=supervisor, horizon=horizon, success_return=success_return)


@in_32_bits
def from_playground(
    name: str, *, supervisor: str, horizon: int = 1000, success_return: float | None = None, **overrides: Any
) -> base.Env:
    """Build an environment from one of MuJoCo Playground's, on MJX's JAX backend.

    Args:
        name: Playground's name, such as `"CartpoleBalance"`.
        supervisor: registered name of the supervisor that helps by default.
        horizon: control steps after which an episode times out.
        success_return: undiscounted return above which an episode of full length succeeds; None = never.
        **overrides: entries of Playground's configuration of this environment, such as `sim_dt=0.005`.

    Raises:
        ImportError: if Playground is not installed.
        ValueError: if Playground has no environment of that name.
    """
    importlib.import_module("fleetjax.physics.mjx")  # as above
    try:
        registry = importlib.import_module("mujoco_playground").registry
    except ImportError as error:
        raise ImportError(
            f'from_playground needs MuJoCo Playground; run pip install ".[playground]" in the source folder ({error})'
        ) from error

    if name not in registry.ALL_ENVS:
        raise ValueError(f"playground environment = {name!r} is unknown; choose one of {', '.join(registry.ALL_ENVS)}")
    config = registry.get_default_config(name)
    if "impl" in config:
        config.impl = "jax"  # Warp's data do not split into robots
    raw = registry.load(name, config=config, config_overrides=overrides).unwrapped
    return _adapt(raw, f"playground/{name}", supervisor=supervisor, horizon=horizon, success_return=success_return)


def _adapt(raw: Any, name: str, *, supervisor: str, horizon: int, success_return: float | None) -> base.Env:
    """Wrap an object with brax's `reset(key) -> State` and `step(State, action) -> State`."""
    raw_reset, raw_step = map(_with_standard_promotion, (raw.reset, raw.step))
    first = jax.eval_shape(raw_reset, jax.random.PRNGKey(0))

    def settle(state: Any) -> Any:
        """Give every leaf the type it has after a reset; a Python float among them would change a scan's carry."""
        return jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), state, first)

    def reset(key: jax.Array, robot: jax.Array) -> EnvState:
        del robot  # every robot starts from the same distribution
        inner = settle(raw_reset(jax.random.key_data(key)))
        return base.begin(inner, _observation(inner.obs))

    def step(state: EnvState, action: jax.Array, active: jax.Array, key: jax.Array) -> EnvState:
        del active, key  # brax keeps its own key, where it needs one
        before = state.physics
        after = settle(raw_step(before, action))
        finite = jnp.all(jnp.isfinite(_observation(after.obs))) & jnp.isfinite(after.reward)
        inner = jax.tree.map(lambda old, new: jnp.where(finite, new, old), before, after)
        return base.proceed(
            state,
            physics=inner,
            obs=_observation(inner.obs),
            reward=jnp.where(finite, after.reward, 0.0),
            violation=(after.done > 0) | ~finite,
            horizon=horizon,
            success_return=success_return,
        )

    size = jax.eval_shape(_observation, first.obs).shape[-1]
    spec = base.EnvSpec(
        name, size, raw.action_size, horizon, float(raw.dt), supervisor=supervisor, success_return=success_return
    )
    return base.Env(reset, step, spec)


def _with_standard_promotion(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that may mix types, as brax does, also where the user asked JAX to be strict."""

    def wrapped(*args: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):
            return function(*args)

    return wrapped


def _observation(obs: jax.Array | Mapping[str, jax.Array]) -> jax.Array:
    """Return f32[O]: of a dictionary what the policy may see, not what only a critic may."""
    chosen = obs["state"] if isinstance(obs, Mapping) else obs
    return chosen.astype(jnp.float32)

"""What an author of an environment gets wrong, in words."""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import supervisors
from fleetjax.envs.base import Env
from fleetjax.precision import in_32_bits
from fleetjax.tree import where
from fleetjax.types import EnvState

NUM_ROBOTS, NUM_STEPS = 4, 50  # that are tried, with random actions
_SCALARS = {
    "reward": jnp.float32,
    "violation": jnp.bool_,
    "success": jnp.bool_,
    "timeout": jnp.bool_,
    "episode_return": jnp.float32,
    "episode_step": jnp.int32,
}


@in_32_bits
def check_env(env: Env) -> None:
    """Check that an environment meets the contract of `Env`: first its shapes and types, then some steps of it.

    Args:
        env: the environment; it need not be registered.

    Raises:
        ValueError: if it does not; the message says what is wrong, a line for each fault.

    >>> from fleetjax import envs
    >>> check_env(envs.make("navigation"))
    """
    faults = list(_static_faults(env)) or list(_faults_of_states(env)) or list(_faults_in_motion(env))
    if faults:
        raise ValueError("\n- ".join([f"environment = {env.spec.name!r} does not meet the contract:", *faults]))


def _static_faults(env: Env) -> Iterator[str]:
    """Yield what is wrong with the facts."""
    spec = env.spec
    for name in ("observation_size", "action_size", "horizon", "control_step"):
        if not getattr(spec, name) > 0:
            yield f"spec.{name} = {getattr(spec, name)} must be above 0"
    if spec.image_shape and math.prod(spec.image_shape) != spec.observation_size:
        yield f"spec.image_shape = {spec.image_shape} must have spec.observation_size = {spec.observation_size} pixel values"
    if env.next_goal and not spec.has_goal:
        yield "next_goal is given, so spec.has_goal must be True"


def _faults_of_states(env: Env) -> Iterator[str]:
    """Yield what is wrong with shapes and types; nothing is computed."""
    key, robot = jax.random.key(0), jax.ShapeDtypeStruct((), jnp.int32)
    action, active = jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32), jax.ShapeDtypeStruct((), jnp.bool_)
    try:
        first = jax.eval_shape(env.reset, key, robot)
    except Exception as error:  # whatever the author's code raises
        yield f"reset(key, robot) fails: {_first_line(error)}"
        return
    if not isinstance(first, EnvState):
        yield f"reset must return an EnvState, as envs.begin makes it, and returns {type(first).__name__}"
        return
    if (first.obs.shape, first.obs.dtype) != ((env.spec.observation_size,), jnp.float32):
        yield f"obs must be float32[{env.spec.observation_size}], by spec.observation_size, and is {_shown(first.obs)}"
    for name, dtype in _SCALARS.items():
        found = getattr(first, name)
        if (found.shape, found.dtype) != ((), dtype):
            yield f"{name} must be {jnp.dtype(dtype).name}[] after a reset, and is {_shown(found)}"
    calls: dict[str, tuple[Any, tuple[Any, ...]]] = {
        "step(state, action, active, key)": (env.step, (first, action, active, key))
    }
    if env.next_goal:
        calls["next_goal(state, key)"] = (env.next_goal, (first, key))
    for call, (function, arguments) in calls.items():
        try:
            after = jax.eval_shape(function, *arguments)
        except Exception as error:
            yield f"{call} fails: {_first_line(error)}"
            continue
        yield from (f"{call} {difference}" for difference in _differences(first, after))
    if env.spec.supervisor:
        try:
            supervisors.check(env.spec.supervisor, env)
        except ValueError as error:
            yield _first_line(error)


def _differences(first: EnvState, after: Any) -> Iterator[str]:
    """Yield in what a state differs from that after a reset, which must have the same structure, shapes and types."""
    if jax.tree.structure(first) != jax.tree.structure(after):
        yield f"must return a state of the structure that reset returns, and returns {jax.tree.structure(after)}"
        return
    leaves = jax.tree_util.tree_leaves_with_path(first)
    for (path, wanted), found in zip(leaves, jax.tree.leaves(after), strict=True):
        if (wanted.shape, wanted.dtype) != (found.shape, found.dtype):
            name = jax.tree_util.keystr(path).removeprefix(".")
            yield f"must keep shapes and types: {name} is {_shown(wanted)} after a reset, and {_shown(found)} then"


def _faults_in_motion(env: Env) -> Iterator[str]:
    """Yield what is wrong with some episodes under random actions."""
    played = jax.lax.map(lambda key: _play(env, key), jax.random.key(0)[None])  # as one program
    first, after, last, margin = jax.tree.map(lambda x: x[0], jax.device_get(played))
    moved = ~np.concatenate([first.violation[None], after.violation[:-1]])
    if any(np.any(getattr(first, name)) for name in ("reward", "success", "timeout", "episode_return", "episode_step")):
        yield "reset must set reward, success, timeout, episode_return and episode_step to 0, as envs.begin does"
    if not np.all(np.isfinite(first.obs)):
        yield "obs must be finite after a reset"
    if not np.all(np.isfinite(after.obs[moved])):
        yield "obs must stay finite; a state with NaN or infinite numbers must count as a violation"
    if env.spec.image_shape and not np.all((after.obs >= 0) & (after.obs <= 255) & (after.obs == np.round(after.obs))):
        yield "obs of images must be whole numbers from 0 to 255"
    steps = np.concatenate([first.episode_step[None], after.episode_step])
    if np.any(np.diff(steps, axis=0)[moved] != 1):
        yield "step must add 1 to episode_step, as envs.proceed does, and never reset by itself"
    for name in ("success", "timeout"):
        if np.any(getattr(after, name) & after.violation):
            yield f"a violation beats {name}: both must not be set at once"
    if margin is not None and np.any(((margin > 0) & ~after.violation) != after.success):
        yield "success_margin must be above 0 where a step set success, and nowhere else but in a violation"
    if not np.all(last.timeout | last.violation):
        yield f"the step that reaches spec.horizon = {env.spec.horizon} must set timeout, unless it violates the constraint"
    if np.any(after.timeout[moved & (after.episode_step < env.spec.horizon)]):
        yield f"timeout must not be set before spec.horizon = {env.spec.horizon} steps"


def _play(env: Env, key: jax.Array) -> tuple[EnvState, EnvState, EnvState, jax.Array | None]:
    """Return EnvState[N] at first, [T, N] under random actions, and [N] after a step that reaches the horizon.

    The last one is the success margin f32[T, N] under random actions, or None if the environment has none.
    """
    key_reset, key_steps, key_last = jax.random.split(key, 3)

    def step(state: EnvState, key: jax.Array) -> tuple[EnvState, EnvState]:
        key_action, key_env = jax.random.split(key)
        action = jax.random.uniform(key_action, (NUM_ROBOTS, env.spec.action_size), minval=-1.0, maxval=1.0)
        if env.spec.discrete:
            action = jax.nn.one_hot(jnp.argmax(action, axis=1), env.spec.action_size)
        active = ~state.violation
        after = jax.vmap(env.step)(state, action, active, jax.random.split(key_env, NUM_ROBOTS))
        after = where(active, after, state)
        return after, after

    first = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_ROBOTS), jnp.arange(NUM_ROBOTS))
    _, after = jax.lax.scan(step, first, jax.random.split(key_steps, min(NUM_STEPS, env.spec.horizon)))
    almost = first._replace(episode_step=jnp.full(NUM_ROBOTS, env.spec.horizon - 1, jnp.int32))
    margin = jax.vmap(jax.vmap(env.success_margin))(after) if env.success_margin else None
    return first, after, step(almost, key_last)[0], margin


def _shown(x: Any) -> str:
    return f"{x.dtype}{list(x.shape)}"


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]

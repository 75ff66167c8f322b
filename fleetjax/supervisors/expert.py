"""Expert policies that ship with the package: small networks trained in this physics.

Each expert is an npz, and a JSON of its measured returns (see `fleetjax.expert_records`); `experiments/train_expert.py` writes
both. The npz holds the mean and standard deviation of observations, and dense layers with ELU between them. Behind the last
stands tanh, or the bound at which it is clipped.
"""

import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from fleetjax import tree
from fleetjax.envs.base import Env
from fleetjax.expert_records import WEIGHTS
from fleetjax.types import EnvState


@functools.cache
def load_weights(name: str) -> dict[str, np.ndarray]:
    """Return the arrays of a shipped expert.

    Raises:
        FileNotFoundError: if no expert of that name ships.
    """
    with (WEIGHTS / f"{name}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


View = Callable[[jax.Array], jax.Array]  # f32[..., O] -> f32[..., V]: what a network sees of an observation


def everything(obs: jax.Array) -> jax.Array:
    """Return the observation as it is."""
    return obs


def policy(weights: Mapping[str, jax.Array | np.ndarray], obs: jax.Array, view: View = everything) -> jax.Array:
    """Return the deterministic action f32[..., A] for observations f32[..., O]."""
    x = (view(obs) - weights["obs_mean"]) / weights["obs_std"]
    layers = sum(name.startswith("kernel") for name in weights)
    for i in range(layers):
        x = x @ weights[f"kernel_{i}"] + weights[f"bias_{i}"]
        x = jax.nn.elu(x) if i < layers - 1 else x
    return jnp.clip(x, -weights["bound"], weights["bound"]) if "bound" in weights else jnp.tanh(x)


def score(
    env: Env,
    weights: Mapping[str, jax.Array | np.ndarray],
    measure: Callable[[EnvState], jax.Array],
    *,
    num_episodes: int,
    key: jax.Array,
    view: View = everything,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Run one episode per robot under an expert, as `run_episodes` does.

    Args:
        env: the environment.
        weights: arrays of the policy.
        measure: `EnvState -> f32[]`, what to add up over an episode's steps.
        num_episodes: robots that run side by side.
        key: random key.
        view: what the policy sees of an observation.
    """
    return run_episodes(env, lambda obs: policy(weights, obs, view), measure, num_episodes=num_episodes, key=key)


def run_episodes(
    env: Env,
    act: Callable[[jax.Array], jax.Array],
    measure: Callable[[EnvState], jax.Array],
    *,
    num_episodes: int,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Run one episode per robot under a policy.

    Args:
        env: the environment.
        act: `obs f32[num_episodes, O] -> action f32[num_episodes, A]`.
        measure: `EnvState -> f32[]`, what to add up over an episode's steps.
        num_episodes: robots that run side by side.
        key: random key.

    Returns:
        f32[num_episodes] undiscounted returns, i32[num_episodes] control steps before violation or horizon,
        f32[num_episodes] sums of the measure.
    """
    key_reset, key_step = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(key_reset, num_episodes), jnp.arange(num_episodes))

    def step(carry: tuple[EnvState, jax.Array], key: jax.Array) -> tuple[tuple[EnvState, jax.Array], None]:
        state, total = carry
        key_env, key_goal = jax.random.split(key)
        active = ~state.violation
        after = jax.vmap(env.step)(state, act(state.obs), active, jax.random.split(key_env, num_episodes))
        total += jnp.where(active, jax.vmap(measure)(after), 0.0)
        if env.next_goal:
            after = tree.where(after.success, jax.vmap(env.next_goal)(after, jax.random.split(key_goal, num_episodes)), after)
        return (tree.where(active, after, state), total), None

    keys = jax.random.split(key_step, env.spec.horizon)
    (state, total), _ = jax.lax.scan(step, (start, jnp.zeros(num_episodes)), keys)
    return state.episode_return, state.episode_step, total

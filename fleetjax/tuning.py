"""Ascent along `fleetjax.sensitivity`: tune thresholds, weights and rates of a fleet."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.core import Tracer

from fleetjax.config import Config, all_fields, get_value
from fleetjax.envs import Env
from fleetjax.experiment import prepare
from fleetjax.gradients import (
    STEPS,
    Objective,
    Values,
    check_request,
    final_return,
    is_finite,
    is_whole,
    make_gradient,
    within_range,
)
from fleetjax.precision import in_32_bits


class Tuned(NamedTuple):
    """What tuning came to.

    Attributes:
        config: the configuration with the tuned values: the mean over the last half of the steps.
        values: f32[steps + 1] by field, from the first values on.
        objective: f32[steps] before each step, its mean over keys.
    """

    config: Config
    values: Values
    objective: jax.Array


@in_32_bits
def tune(
    config: Config,
    keys: jax.Array,
    fields: str | Sequence[str],
    *,
    steps: int = 20,
    learning_rate: float = 0.1,
    objective: Objective | None = None,
    method: str = "smoothed",
    width: float | Mapping[str, float] | None = None,
    num_samples: int = 16,
    env: Env | None = None,
) -> Tuned:
    """Raise what a fleet is worth by gradient ascent with Adam on some of its parameters.

    Parameters move in units of their first values, so that a step changes each by about `learning_rate` of it. The fleets of
    all keys are prepared once; each step runs them with new randomness.

    Args:
        config: configuration to start from; a parameter that is 0 cannot move.
        keys: random key, or keys [S].
        fields: names of traced fields that hold real numbers, or of such parameters of the algorithm.
        steps: gradient steps.
        learning_rate: of Adam, in units of the first values.
        objective: see `sensitivity`.
        method: see `sensitivity`.
        width: see `sensitivity`.
        num_samples: see `sensitivity`; a step takes `S * (num_samples + 1)` runs with `"smoothed"`.
        env: the environment, if it is not the registered one that the configuration names.

    Returns:
        Tuned.

    Raises:
        ValueError: as `sensitivity`, and if a field is a whole number, or 0.
    """
    if not is_whole(steps) or steps < 1:
        raise ValueError(f"steps = {steps!r} must be a whole number, and at least 1")
    if not is_finite(learning_rate) or (not isinstance(learning_rate, Tracer) and learning_rate <= 0):
        raise ValueError(f"learning_rate = {learning_rate!r} must be a finite number above 0")
    request, hard = check_request(config, keys, fields, objective or final_return, method, width, num_samples, env), config
    config, env, names = request.config, request.env, request.names
    known = all_fields(config.algorithm)
    for name in names:
        value = get_value(config, name)
        if known[name].kind is not float:
            raise ValueError(f"{name} is a whole number and cannot be tuned; omit it")
        if not isinstance(value, Tracer) and float(value) == 0:
            raise ValueError(f"{name} = 0 cannot be tuned: steps are in units of the first value; start from another one")
    start = {name: jnp.float32(get_value(config, name)) for name in names}
    derive = make_gradient(config, env, objective or final_return, names, method, request.widths, num_samples)
    states = jax.lax.map(lambda key: prepare(config, key, env), request.keys)

    def gradient(ratios: Values, number: jax.Array) -> tuple[jax.Array, Values]:
        values = {name: ratios[name] * start[name] for name in names}
        keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, STEPS), number))(request.keys)
        worth, slopes, _ = jax.lax.map(lambda entry: derive(values, *entry), (keys, states))
        return jnp.mean(worth), {name: jnp.mean(slopes[name]) * start[name] for name in names}

    def within(ratios: Values) -> Values:
        return {n: within_range(known[n], ratios[n] * start[n]) / start[n] for n in names}

    ratios, worth = _climb(gradient, within, {name: jnp.ones(()) for name in names}, learning_rate, steps)
    values = {name: start[name] * ratios[name] for name in names}
    last = {name: jnp.mean(found[1 + steps // 2 :]) for name, found in values.items()}
    return Tuned(hard.replace(**last), values, worth)


def _climb(
    gradient: Callable[[Values, jax.Array], tuple[jax.Array, Values]],
    within: Callable[[Values], Values],
    start: Values,
    learning_rate: float,
    steps: int,
) -> tuple[Values, jax.Array]:
    """Return what Adam comes to: f32[steps + 1] by name from `start` on, and the objective f32[steps] before each step.

    Args:
        gradient: `(values, number of the step) -> (objective, gradient)`.
        within: brings values back into their ranges.
        start: first values.
        learning_rate: of Adam.
        steps: number of steps.
    """
    optimizer = optax.adam(learning_rate)

    def step(carry: tuple[Values, optax.OptState], number: jax.Array):
        values, memory = carry
        worth, slopes = gradient(values, number)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies its i32 count and floats, which "strict" forbids
            change, memory = optimizer.update(jax.tree.map(jnp.negative, slopes), memory)
        values = within(jax.tree.map(jnp.add, values, change))
        return (values, memory), (values, worth)

    _, (path, worth) = jax.lax.scan(step, (start, optimizer.init(start)), jnp.arange(steps))
    return jax.tree.map(lambda first, later: jnp.concatenate([first[None], later]), start, path), worth

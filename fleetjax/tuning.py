"""Ascent along `fleetjax.sensitivity`: tune thresholds, weights and rates of a fleet."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from fleetjax.config import Config, all_fields, get_value
from fleetjax.envs import Env
from fleetjax.experiment import prepare
from fleetjax.gradients import Objective, Values, check_request, final_return, make_gradient
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
    request = check_request(config, keys, fields, method, width, num_samples, env)
    config, env, names = request.config, request.env, request.names
    known = all_fields(config.algorithm)
    start = {name: jnp.float32(get_value(config, name)) for name in names}
    for name, value in start.items():
        if known[name].kind is not float or value == 0:
            raise ValueError(f"{name} = {value} cannot be tuned: only real numbers other than 0 can; choose a first value")
    derive = make_gradient(config, env, objective or final_return, names, method, request.widths, num_samples)
    states = jax.lax.map(lambda key: prepare(config, key, env), request.keys)
    optimizer = optax.adam(learning_rate)

    def step(carry: tuple[Values, optax.OptState], number: jax.Array):
        ratios, memory = carry
        values = {name: ratios[name] * start[name] for name in names}

        def of_key(entry):
            key, state = entry
            return derive(values, jax.random.fold_in(key, number), state)

        worth, gradients, _ = jax.lax.map(of_key, (request.keys, states))
        downhill = {name: -jnp.mean(gradients[name]) * start[name] for name in names}
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies its i32 count and floats, which "strict" forbids
            change, memory = optimizer.update(downhill, memory)
        moved = jax.tree.map(jnp.add, ratios, change)
        kept = {n: jnp.clip(moved[n] * start[n], known[n].low, known[n].high) / start[n] for n in names}
        return (kept, memory), (kept, jnp.mean(worth))

    ones = {name: jnp.ones(()) for name in names}
    _, (ratios, worth) = jax.lax.scan(step, (ones, optimizer.init(ones)), jnp.arange(steps))
    values = {name: start[name] * jnp.concatenate([jnp.ones(1), ratios[name]]) for name in names}
    last = {name: jnp.mean(found[1 + steps // 2 :]) for name, found in values.items()}
    return Tuned(config.replace(**last), values, worth)

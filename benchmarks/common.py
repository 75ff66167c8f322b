"""What the benchmarks share: a fleet that can be timed in stretches, and the machine's rate for a large matrix product."""

import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import fleetjax


def seconds(function: Callable[..., Any], *args: Any) -> tuple[float, Any]:
    """Run once; return the wall-clock seconds until the result is there, and the result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    return time.perf_counter() - start, result


def median_seconds(function: Callable[..., Any], *args: Any, repeats: int = 5) -> float:
    """Return the median seconds of `repeats` runs, after one that compiles."""
    jax.block_until_ready(function(*args))
    return statistics.median(seconds(function, *args)[0] for _ in range(repeats))


def quick_config(environment: str, algorithm: str = "cur", **overrides: Any) -> fleetjax.Config:
    """Return a configuration whose fleet starts almost untrained: a timestep costs the same, the start is short."""
    short = {
        "num_demonstrations": 256,
        "pretraining_steps": 1,
        "critic_pretraining_steps": 1,
        "num_critic_transitions": 200,
        "initial_period": 0,
    }
    return fleetjax.make_config(environment, algorithm, **short | overrides)


def stretch(config: fleetjax.Config, num_steps: int) -> Callable[..., Any]:
    """Return a compiled `(key, state) -> Result` of `num_steps` timesteps that gives the state's memory away."""
    part = config.replace(num_steps=num_steps)
    return jax.jit(lambda key, state: fleetjax.run(part, key, state), donate_argnums=1)


def step_milliseconds(config: fleetjax.Config, *, num_steps: int = 50, repeats: int = 3) -> float:
    """Return the median milliseconds of a timestep of a fresh fleet."""
    key = jax.random.key(0)
    run = stretch(config, num_steps)
    state = run(key, jax.jit(fleetjax.prepare)(config, key)).state
    times = []
    for _ in range(repeats):
        elapsed, result = seconds(run, key, state)
        state = result.state
        times.append(elapsed / num_steps * 1e3)
    return statistics.median(times)


def matrix_rate(size: int = 1024, products: int = 10) -> Callable[[], float]:
    """Return a function that measures f32 operations a second in a large matrix product."""
    a = jax.random.normal(jax.random.key(0), (size, size)) / size**0.5
    multiply = jax.jit(lambda x: jax.lax.scan(lambda y, _: (y @ a, None), x, length=products)[0])
    jax.block_until_ready(multiply(a))
    return lambda: 2 * size**3 * products / seconds(multiply, a)[0]


def dense_weights(sizes: list[int]) -> list[int]:
    """Return the number of weights of each dense layer between the given sizes."""
    return [a * b for a, b in itertools.pairwise(sizes)]


def gradient_step_operations(config: fleetjax.Config, spec: fleetjax.EnvSpec) -> int:
    """Return the multiplications and additions that a C.U.R. gradient step cannot do without.

    A product with W weights costs 2 W a sample forwards, 2 W for the weights' gradient, and 2 W for the inputs' (which
    the first layer does not need).
    """
    policy = dense_weights([spec.observation_size, *config.hidden_sizes, spec.action_size])
    critic = dense_weights([spec.observation_size + spec.action_size, *config.hidden_sizes, 1])

    def forward(layers: list[int]) -> int:
        return 2 * sum(layers)

    def gradient(layers: list[int]) -> int:
        return forward(layers) + 2 * sum(layers) + 2 * sum(layers[1:])

    members, twins = config.ensemble_size, 2
    imitation = members * gradient(policy)
    safety = members * forward(policy) + twins * (forward(critic) + gradient(critic))
    return config.batch_size * config.gradient_steps * (imitation + safety)


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of equal keys as an aligned Markdown table."""
    names = list(rows[0])
    cells = [names, *[[str(row[name]) for name in names] for row in rows]]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    lines = ["| " + " | ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in cells]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|", *lines[1:]])


def as_milliseconds(value: float) -> str:
    """Return seconds as milliseconds with two decimals."""
    return f"{value * 1e3:.2f}"


def moving_rows(state: fleetjax.FleetState) -> jax.Array:
    """Return the indices of the robots that are not in violation."""
    return jnp.flatnonzero(~state.env.violation)

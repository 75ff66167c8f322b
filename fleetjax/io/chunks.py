"""Run in chunks of timesteps, so that there is something to show and to keep before the end."""

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from fleetjax.config import Config
from fleetjax.experiment import evaluate, prepare, simulate, without_teleoperation
from fleetjax.fleet import FleetState, Interventions
from fleetjax.learning.imitation import PolicyState
from fleetjax.metrics import Metrics

CHUNKS = 100  # that a run is divided into, more or less


class Chunk(NamedTuple):
    """What some timesteps gave.

    Attributes:
        metrics: Metrics[C].
        interventions: Interventions[C, M], if they were logged.
    """

    metrics: Metrics
    interventions: Interventions | None


def chunk_length(num_steps: int, within: int | None = None) -> int:
    """Return into how many timesteps to divide a run: near a hundredth, a divisor of `within` if there is one near.

    A chunk of one timestep would be another program, with other roundings.

    Args:
        num_steps: timesteps of the run.
        within: what chunks should add up to without a remainder, which would need a program of its own; None = the run.

    >>> chunk_length(10_000), chunk_length(20), chunk_length(10_005), chunk_length(10_007), chunk_length(10_000, 250)
    (100, 2, 115, 101, 125)
    """
    within = within or num_steps
    wanted = max(2, -(-num_steps // CHUNKS))
    near = [n for n in range(max(2, -(-wanted // 3)), 3 * wanted + 1) if within % n == 0]
    return min(near, key=lambda n: abs(np.log(n / wanted)), default=min(wanted, within))


def chunks_of(num_steps: int, length: int) -> list[int]:
    """Return the lengths of chunks that add up to `num_steps`, in order; none is 1 unless all are.

    >>> chunks_of(10, 4), chunks_of(9, 4), chunks_of(1, 4), chunks_of(0, 4)
    ([4, 4, 2], [4, 5], [1], [])
    """
    full, rest = divmod(num_steps, length)
    chunks = [length] * full + [rest] * (rest > 0)
    return [*chunks[:-2], chunks[-2] + 1] if rest == 1 and full else chunks


def _prepare(config: Config, key: jax.Array) -> FleetState:
    """Return what `prepare` does; of several keys, the states of as many fleets."""
    return jax.vmap(prepare, in_axes=(None, 0))(config, key) if key.ndim else prepare(config, key)


def _simulate(config: Config, key: jax.Array, state: FleetState, *, mesh: Mesh | None = None, logged: bool) -> Any:
    """Return what `simulate` does; of several keys, with the fleets side by side."""
    one = functools.partial(simulate, mesh=mesh, logged=logged)
    return jax.vmap(one, in_axes=(None, 0, 0))(config, key, state) if key.ndim else one(config, key, state)


# The state's memory is used again: buffers can be large.
_advance = jax.jit(_simulate, static_argnames=("mesh", "logged"), donate_argnames="state")


def start(config: Config, key: jax.Array, length: int, *, logged: bool = False) -> FleetState:
    """Pre-train, and compile the first chunk of `length` timesteps meanwhile. Keyboard interrupts come through at once.

    Args:
        config: configuration.
        key: the key of the run, or [K] keys of runs side by side; what is returned then has a leading axis K.
        length: timesteps of the first chunk.
        logged: whether interventions will be logged.

    Returns:
        FleetState: the state at t = 0; `run_chunks` from it finds its program compiled.
    """
    pool = ThreadPoolExecutor(2)  # this thread only waits: an interrupt within JAX's own code could get lost
    try:
        lowered = pool.submit(lambda: jax.jit(_prepare).lower(config, key)).result()
        first = pool.submit(lambda: config.replace(num_steps=min(length, config.num_steps))).result()
        state = pool.submit(lambda: jax.block_until_ready(lowered.compile()(config, key)))
        pool.submit(lambda: _advance.lower(first, key, lowered.out_info, logged=logged).compile()).result()
        return state.result()
    finally:
        pool.shutdown(wait=False)


def run_chunks(
    config: Config,
    key: jax.Array,
    state: FleetState,
    lengths: list[int],
    *,
    logged: bool = False,
    mesh: Mesh | None = None,
) -> Iterator[tuple[Chunk, FleetState]]:
    """Run chunk after chunk; together they are `run(config, key, state)`.

    Args:
        config: configuration.
        key: the key of the whole run, the same for each chunk; or [K] keys of runs side by side.
        state: where to start; its memory is taken over.
        lengths: timesteps of each chunk.
        logged: whether to log interventions.
        mesh: over which the state is divided; None = it is not.

    Yields:
        Chunk in numpy arrays and the state behind it, valid until the next one is asked for. Several keys give both a
            leading axis K.
    """
    for length in lengths:
        (metrics, state), interventions = _advance(config.replace(num_steps=length), key, state, mesh=mesh, logged=logged)
        yield jax.device_get(Chunk(metrics, interventions)), state


def start_evaluation(config: Config, key: jax.Array, policy: PolicyState) -> Iterator[Metrics]:
    """Compile the evaluation of a trained policy, and return what runs it, chunk after chunk.

    Returns:
        Iterator of Metrics[C] in numpy arrays; together they are those of `evaluate(config, key, policy)`.
    """
    length, *others = chunks_of(config.num_steps, chunk_length(config.num_steps))
    first = config.replace(num_steps=length)
    begin = jax.jit(evaluate).lower(first, key, policy).compile()
    config = without_teleoperation(config)
    if others:
        _advance.lower(config.replace(num_steps=others[0]), key, begin.out_info.state, logged=False).compile()

    def parts() -> Iterator[Metrics]:
        metrics, state = begin(first, key, policy)
        yield jax.device_get(metrics)
        yield from (chunk.metrics for chunk, _ in run_chunks(config, key, state, others))

    return parts()


def join(chunks: list[Metrics]) -> Metrics:
    """Return Metrics[T] of chunks in order."""
    return jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)

"""Run in chunks of timesteps, so that there is something to show and to keep before the end."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from fleetjax.config import Config
from fleetjax.fleet import FleetState
from fleetjax.learning.imitation import LearnerState
from fleetjax.metrics import Metrics
from fleetjax.run import evaluate, prepare, run

CHUNKS = 100  # that a run is divided into, more or less


def chunk_length(num_steps: int) -> int:
    """Return into how many timesteps to divide a run: near a hundredth, and without a remainder if that can be.

    A remainder would be compiled anew.

    >>> chunk_length(10_000), chunk_length(20), chunk_length(10_005), chunk_length(10_007)
    (100, 1, 115, 101)
    """
    wanted = -(-num_steps // CHUNKS)
    near = [n for n in range(-(-wanted // 3), 3 * wanted + 1) if num_steps % n == 0]
    return min(near, key=lambda n: abs(np.log(n / wanted)), default=wanted)


def chunks_of(num_steps: int) -> list[int]:
    """Return the lengths of a run's chunks, in order."""
    length = chunk_length(num_steps)
    rest = num_steps % length
    return [length] * (num_steps // length) + [rest] * (rest > 0)


def start(config: Config, key: jax.Array) -> FleetState:
    """Pre-train, and compile the first chunk meanwhile. Keyboard interrupts come through at once.

    Returns:
        FleetState: the state at t = 0; `go_on` from it finds its program compiled.
    """
    first = config.replace(num_steps=chunk_length(config.num_steps))
    pool = ThreadPoolExecutor(2)  # this thread only waits: an interrupt within JAX's own code could get lost
    try:
        lowered = pool.submit(lambda: jax.jit(prepare).lower(config, key)).result()
        state = pool.submit(lambda: jax.block_until_ready(lowered.compile()(config, key)))
        pool.submit(lambda: _advance.lower(first, key, lowered.out_info).compile()).result()
        return state.result()
    finally:
        pool.shutdown(wait=False)


_advance = jax.jit(run, donate_argnums=2)  # the state's memory is used again: buffers can be large


def go_on(config: Config, key: jax.Array, state: FleetState, lengths: list[int]) -> Iterator[tuple[Metrics, FleetState]]:
    """Run chunk after chunk; together they are `run(config, key, state)`.

    Args:
        config: configuration.
        key: the key of the whole run, the same for each chunk.
        state: where to start; its memory is taken over.
        lengths: timesteps of each chunk.

    Yields:
        Metrics[C] in numpy arrays and the state behind the chunk, valid until the next one is asked for.
    """
    for length in lengths:
        metrics, state = _advance(config.replace(num_steps=length), key, state)
        yield jax.device_get(metrics), state


def start_evaluation(config: Config, key: jax.Array, learner: LearnerState) -> Iterator[Metrics]:
    """Compile the evaluation of a trained policy, and return what runs it, chunk after chunk.

    Returns:
        Iterator of Metrics[C] in numpy arrays; together they are those of `evaluate(config, key, learner)`.
    """
    length, *others = chunks_of(config.num_steps)
    first = config.replace(num_steps=length)
    begin = jax.jit(evaluate).lower(first, key, learner).compile()
    config = config.replace(algorithm="constraint")  # nobody teleoperates
    if others:
        _advance.lower(config.replace(num_steps=others[0]), key, begin.out_info.state).compile()

    def chunks() -> Iterator[Metrics]:
        metrics, state = begin(first, key, learner)
        yield jax.device_get(metrics)
        yield from (metrics for metrics, _ in go_on(config, key, state, others))

    return chunks()


def join(chunks: list[Metrics]) -> Metrics:
    """Return Metrics[T] of chunks in order."""
    return jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)

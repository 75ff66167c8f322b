"""A run in its folder: begun or gone on with, chunk after chunk, with checkpoints, until it ends or is stopped.

A run that was killed and gone on with gives the bits of one that was not: chunks and checkpoints change nothing, the key of
timestep t is `fold_in(key, t)`, and metrics are cut back to the checkpoint's timestep.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from fleetjax.config import Config
from fleetjax.fleet import FleetState
from fleetjax.io import checkpoint, execution, files, folder, text
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics, first_divergence
from fleetjax.priority import get_algorithm


class Diverged(ArithmeticError):
    """Something learnt is not finite any more."""


class Start(NamedTuple):
    """Where an operation starts.

    Attributes:
        state: the fleet.
        metrics: Metrics[t] so far, in numpy arrays; None at t = 0.
        log: the file of metrics.
    """

    state: FleetState
    metrics: Metrics | None
    log: files.Log


def operate(path: Path, config: Config, seed: int, *, resume: bool, checkpoint_every: int) -> tuple[Metrics, FleetState]:
    """Run what is left of a run.

    Args:
        path: its folder, which this process has locked.
        config: its configuration.
        seed: the seed of its key.
        resume: whether to look for checkpoints; else it starts from t = 0.
        checkpoint_every: timesteps between checkpoints; 0 = none.

    Returns:
        Metrics[T] in numpy arrays and the last state.

    Raises:
        ValueError: if there are checkpoints and none can be used.
        OSError: if something cannot be written.
        Diverged: if what is learnt is not finite any more.
        KeyboardInterrupt: if it was asked to stop; the message says how to go on.
    """
    begun, key, total = time.monotonic(), jax.random.key(seed), config.num_steps
    length = execution.chunk_length(total, checkpoint_every)
    identity = folder.identity(config, seed)
    say(f"{text.headline(config, seed)}, on the {jax.default_backend().upper()} ...")
    start = _resume(path, config, key, identity) if resume else _begin(path, config, key, length)
    state, before, log = start
    say(f"ready after {text.duration(time.monotonic() - begun)}")
    chunks = [before] if before else []
    done = saved = int(state.timestep)
    writer = checkpoint.Writer(path, identity)
    with contextlib.closing(log), progress(config, before) as show, stoppable() as asked_to_stop:
        for metrics, state in execution.go_on(config, key, start.state, execution.chunks_of(total - done, length)):
            folder.append_metrics(log, metrics, done)
            chunks.append(metrics)
            done += len(metrics.successes)
            show(metrics)
            _check(metrics, done, path)
            stop = asked_to_stop() and done < total
            if stop or (checkpoint_every and saved + checkpoint_every <= done < total):
                writer.write(state, {"metrics": log.mark()})
                saved = done
            if stop:
                writer.wait()
                raise KeyboardInterrupt(f"at t = {done} of {total}; go on with: fleetjax run --resume {path}")
        writer.wait()
    return execution.join(chunks), state


def _check(chunk: Metrics, done: int, path: Path) -> None:
    """Check that all that was learnt is finite.

    Args:
        chunk: Metrics[C] of the last timesteps.
        done: timesteps so far, those included.
        path: the run's folder.

    Raises:
        Diverged: if it is not; the message says what was not, and when first.
    """
    found = first_divergence(chunk)
    if found:
        first, names = found
        when = done - len(chunk.diverged) + first
        raise Diverged(
            f"not finite from t = {when} on: {', '.join(names)}; a smaller learning_rate may help. Metrics so far are in {path}"
        )


def _begin(path: Path, config: Config, key: jax.Array, length: int) -> Start:
    """Pre-train."""
    first = "pre-training" if get_algorithm(config.algorithm).pretrains else "preparing"
    say(f"compiling and {first} ...")
    state = execution.start(config, key, min(length, config.num_steps))
    return Start(state, None, folder.open_metrics(path))


def _resume(path: Path, config: Config, key: jax.Array, identity: Mapping[str, Any]) -> Start:
    """Read the newest checkpoint that is whole, and say which are not."""

    def check(notes: Mapping[str, Any]) -> None:
        files.beginning(path / folder.METRICS, notes["metrics"])

    found, refused = checkpoint.restore(path, identity, execution.shapes(config, key), check)
    for reason in refused:
        say(f"left out {reason}")
    if found is None:
        if refused:
            raise ValueError(f"{path} has no checkpoint that could be used; run it anew with --output {path} --overwrite")
        say("no checkpoint was written yet; from the start")
        return _begin(path, config, key, execution.chunk_length(config.num_steps))
    say(f"going on from {found.path}")
    mark = found.notes["metrics"]
    metrics = folder.parse_metrics(files.beginning(path / folder.METRICS, mark), config.num_steps)
    return Start(found.state, metrics, folder.open_metrics(path, mark))


@contextlib.contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether the process was asked to stop, by Ctrl-C or SIGTERM; twice stops it at once."""
    asked = False

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt("at once, without a checkpoint")
        asked = True
        say("\nstopping at the end of this chunk of timesteps; once more stops at once")

    if threading.current_thread() is not threading.main_thread():  # which alone hears signals
        yield lambda: False
        return
    heard = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, ask) for number in heard}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

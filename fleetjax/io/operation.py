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

from fleetjax import envs
from fleetjax.envs import EnvSpec
from fleetjax.fleet import FleetState
from fleetjax.io import checkpoint, execution, files, folder, interventions, text
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics, first_divergence
from fleetjax.priority import get_algorithm


class Diverged(ArithmeticError):
    """Something learnt is not finite any more."""


class Unusable(ValueError):
    """A run cannot be gone on with: its checkpoints are all damaged or foreign."""


class Journal:
    """What a run leaves as it goes on: `metrics.csv`, and the log of interventions if there is one.

    Args:
        path: folder of the run.
        spec: its environment's, if interventions are logged.
        notes: what `mark` returned when the files were as they shall be again; None begins new ones.
    """

    def __init__(self, path: Path, spec: EnvSpec | None, notes: Mapping[str, Any] | None = None):
        notes = notes or {}
        self.spec = spec
        self.metrics = folder.open_metrics(path, notes.get("metrics"))
        self.interventions = interventions.open_log(path, notes.get("interventions")) if spec else None

    def append(self, chunk: execution.Chunk, first: int) -> None:
        """Add a chunk of timesteps, from `first` on."""
        folder.append_metrics(self.metrics, chunk.metrics, first)
        if self.interventions and self.spec and chunk.interventions:
            interventions.append(self.interventions, chunk.interventions, first, self.spec)

    def mark(self) -> dict[str, Any]:
        """Put it all on the disk; return what is needed to cut it back to this."""
        return {"metrics": self.metrics.mark()} | ({"interventions": self.interventions.mark()} if self.interventions else {})

    def close(self) -> None:
        """Close the files."""
        self.metrics.close()
        if self.interventions:
            self.interventions.close()


class Start(NamedTuple):
    """Where an operation starts.

    Attributes:
        state: the fleet.
        metrics: Metrics[t] so far, in numpy arrays; None at t = 0.
        journal: where what comes is written.
    """

    state: FleetState
    metrics: Metrics | None
    journal: Journal


def operate(run: folder.Run, *, resume: bool, checkpoint_every: int) -> tuple[Metrics, FleetState]:
    """Run what is left of a run.

    Args:
        run: its folder, which this process has locked, its configuration, and whether interventions are logged.
        resume: whether to look for checkpoints; else it starts from t = 0.
        checkpoint_every: timesteps between checkpoints; 0 = none.

    Returns:
        Metrics[T] in numpy arrays and the last state.

    Raises:
        Unusable: if there are checkpoints and none can be used.
        OSError: if something cannot be written.
        Diverged: if what is learnt is not finite any more.
        KeyboardInterrupt: if it was asked to stop; the message says how to go on.
    """
    begun, key, total = time.monotonic(), jax.random.key(run.seed), run.config.num_steps
    length = execution.chunk_length(total, checkpoint_every)
    say(f"{text.headline(run.config, run.seed)}, on the {jax.default_backend().upper()} ...")
    state, before, journal = _resume(run, key, length) if resume else _begin(run, key, length)
    say(f"ready after {text.duration(time.monotonic() - begun)}")
    gathered = [before] if before else []
    done = saved = int(state.timestep)
    writer = checkpoint.Writer(run.folder, folder.identity(run.config, run.seed))
    chunks = execution.go_on(run.config, key, state, execution.chunks_of(total - done, length), logged=run.logged)
    with contextlib.closing(journal), progress(run.config, before) as show, stoppable() as asked_to_stop:
        for chunk, after in chunks:
            journal.append(chunk, done)
            gathered.append(chunk.metrics)
            done += len(chunk.metrics.successes)
            show(chunk.metrics)
            _check(chunk.metrics, done, run.folder)
            state, stop = after, asked_to_stop() and done < total
            if stop or (checkpoint_every and saved + checkpoint_every <= done < total):
                writer.write(state, journal.mark())
                saved = done
            if stop:
                writer.wait()
                raise KeyboardInterrupt(f"at t = {done} of {total}; go on with: fleetjax run --resume {run.folder}")
        writer.wait()
    return execution.join(gathered), state


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


def _spec(run: folder.Run) -> EnvSpec | None:
    return envs.make(run.config.environment, run.config.backend).spec if run.logged else None


def _begin(run: folder.Run, key: jax.Array, length: int) -> Start:
    """Pre-train."""
    first = "pre-training" if get_algorithm(run.config.algorithm).pretrains else "preparing"
    say(f"compiling and {first} ...")
    state = execution.start(run.config, key, min(length, run.config.num_steps), logged=run.logged)
    return Start(state, None, Journal(run.folder, _spec(run)))


def _resume(run: folder.Run, key: jax.Array, length: int) -> Start:
    """Read the newest checkpoint that is whole, and say which are not."""
    logs = {"metrics": folder.METRICS} | ({"interventions": interventions.FILE} if run.logged else {})

    def check(notes: Mapping[str, Any]) -> None:
        for name, file in logs.items():
            files.beginning(run.folder / file, notes[name])

    identity = folder.identity(run.config, run.seed)
    found, refused = checkpoint.restore(run.folder, identity, execution.shapes(run.config, key), check)
    for reason in refused:
        say(f"left out {reason}")
    if found is None:
        if refused:
            raise Unusable(f"{run.folder} has no checkpoint that could be used; run it anew, with --overwrite")
        say("no checkpoint was written yet; from the start")
        return _begin(run, key, length)
    say(f"going on from {found.path}")
    data = files.beginning(run.folder / folder.METRICS, found.notes["metrics"])
    metrics = folder.parse_metrics(data, run.config.num_steps)
    return Start(found.state, metrics, Journal(run.folder, _spec(run), found.notes))


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

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


def unbegun(run: folder.Run, *, new: bool) -> KeyboardInterrupt:
    """Return what to raise if a run is stopped before its first timestep; its folder is removed if it is new."""
    if new:
        folder.discard(run.folder)
    return KeyboardInterrupt(f"before the first timestep; {'nothing was kept' if new else f'{run.folder} is as it was'}")


class Journal:
    """What a run leaves as it goes on: `metrics.csv`, and the log of interventions if there is one.

    Args:
        path: folder of the run.
        spec: its environment's, if interventions are logged.
    """

    def __init__(self, path: Path, spec: EnvSpec | None):
        self.path, self.spec = path, spec
        self._logs: dict[str, files.Log] = {}

    def open(self, notes: Mapping[str, Any] | None = None) -> None:
        """Begin new files, or cut them back to what they were when `mark` returned `notes`."""
        notes = notes or {}
        self._logs["metrics"] = folder.open_metrics(self.path, notes.get("metrics"))
        if self.spec:
            self._logs["interventions"] = interventions.open_log(self.path, notes.get("interventions"))

    def append(self, chunk: execution.Chunk, first: int) -> None:
        """Add a chunk of timesteps, from `first` on."""
        folder.append_metrics(self._logs["metrics"], chunk.metrics, first)
        if self.spec and chunk.interventions:
            interventions.append(self._logs["interventions"], chunk.interventions, first, self.spec)

    def mark(self) -> dict[str, Any]:
        """Put it all on the disk; return what is needed to cut it back to this."""
        return {name: log.mark() for name, log in self._logs.items()}

    def close(self) -> None:
        """Close the files."""
        for log in self._logs.values():
            log.close()


class Start(NamedTuple):
    """Where an operation starts.

    Attributes:
        run: the run, with the versions that it goes on under.
        state: the fleet.
        metrics: Metrics[t] so far, in numpy arrays; None at t = 0.
        notes: what the journal noted then; None at t = 0.
    """

    run: folder.Run
    state: FleetState
    metrics: Metrics | None
    notes: Mapping[str, Any] | None


def operate(run: folder.Run, *, resume: bool, checkpoint_every: int, save: Callable[[folder.Run, Metrics], None]) -> Metrics:
    """Run what is left of a run. An older run in its folder goes when there are timesteps to take its place.

    Args:
        run: its folder, which this process has locked, its configuration, and whether interventions are logged.
        resume: whether to look for checkpoints; else it starts from t = 0.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        save: draws and seals what there is.

    Returns:
        Metrics[T] in numpy arrays.

    Raises:
        Unusable: if there are checkpoints and none can be used.
        OSError: if something cannot be written.
        Diverged: if what is learnt is not finite any more.
        KeyboardInterrupt: if it was asked to stop; the message says how to go on.
    """
    begun, new = time.monotonic(), folder.prepare(run)
    say(f"{text.headline(run.config, run.seed)}, on the {jax.default_backend().upper()} ...")
    length = execution.chunk_length(run.config.num_steps, checkpoint_every)
    gathered: list[Metrics] = []
    try:
        start = (_resume if resume else _begin)(run, jax.random.key(run.seed), length)
        run = start.run
        say(f"ready after {text.duration(time.monotonic() - begun)}")
        state = _go_on(start, gathered, length, overwrite=not (new or resume), checkpoint_every=checkpoint_every)
    except (KeyboardInterrupt, Diverged):
        if not gathered:
            raise unbegun(run, new=new) from None
        save(run, execution.join(gathered))
        raise
    metrics = execution.join(gathered)
    if get_algorithm(run.config.algorithm).pretrains:
        folder.write_policy(run.folder, state.policy)
    save(run, metrics)
    return metrics


def _go_on(start: Start, gathered: list[Metrics], length: int, *, overwrite: bool, checkpoint_every: int) -> FleetState:
    """Run what is left, and gather the Metrics of what is written, chunk after chunk; return the last state."""
    run, state, before, notes = start
    key, total = jax.random.key(run.seed), run.config.num_steps
    done = saved = int(state.timestep)
    writer = checkpoint.Writer(run.folder, folder.identity(run.config, run.seed))
    chunks = execution.go_on(run.config, key, state, execution.chunks_of(total - done, length), logged=run.logged)
    with (
        contextlib.closing(Journal(run.folder, _spec(run))) as journal,
        progress(run.config, before) as show,
        stoppable() as asked_to_stop,
    ):
        if before:
            folder.write_config(run, sealed=False)
            journal.open(notes)
            gathered.append(before)
        for chunk, after in chunks:
            if not gathered:
                if overwrite and asked_to_stop():
                    raise KeyboardInterrupt
                folder.create(run)
                journal.open()
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
    return state


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
    return Start(run._replace(versions=()), state, None, None)


def _resume(run: folder.Run, key: jax.Array, length: int) -> Start:
    """Read the newest checkpoint that is whole, and say which are not."""
    logs = {"metrics": folder.METRICS} | ({"interventions": interventions.FILE} if run.logged else {})

    def check(found: checkpoint.Checkpoint) -> None:
        data = {name: files.beginning(run.folder / file, found.notes.get(name)) for name, file in logs.items()}
        timestep = int(found.state.timestep)
        if len(folder.parse_metrics(data["metrics"], timestep).successes) != timestep:
            raise ValueError(f"{folder.METRICS} had fewer timesteps at that time")

    identity = folder.identity(run.config, run.seed)
    found, refused = checkpoint.restore(run.folder, identity, execution.shapes(run.config, key), check)
    for reason in refused:
        say(f"left out {reason}")
    if found is None:
        if checkpoint.is_any_finished(run.folder):
            raise Unusable(f"{run.folder} has no checkpoint that could be used; run it anew, with --overwrite")
        say("no checkpoint was written yet; from the start")
        return _begin(run, key, length)
    say(f"going on from {found.path}")
    data = files.beginning(run.folder / folder.METRICS, found.notes["metrics"])
    metrics = folder.parse_metrics(data, run.config.num_steps)
    return Start(_updated(run, int(found.state.timestep)), found.state, metrics, found.notes)


def _updated(run: folder.Run, timestep: int) -> folder.Run:
    """Return a run with the versions that it goes on under; say so if they are others than before."""
    run = folder.resumed(run, timestep)
    if run.versions[-1]["timestep"] == timestep:
        before, now = run.versions[-2:]
        names = folder.changes(before, now)
        old, new = (", ".join(f"{name} {entry[name]}" for name in names) for entry in (before, now))
        say(f"before t = {timestep} this run used {old}; it resumes with {new}, so its numbers may not be an undisturbed run's")
    return run


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

"""A run in its folder: started or resumed, chunk after chunk, with checkpoints, until it ends or is stopped.

A run that was killed and resumed gives the same bits as one that was not: chunks and checkpoints change nothing, the key of
timestep t is `keys.key_at(key, t)`, and the files are cut back to the checkpoint's timestep.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax

from fleetjax import envs
from fleetjax.checks import state_shapes
from fleetjax.fleet import FleetState
from fleetjax.io import checkpoint, chunks, files, folder, interventions, metrics_csv, text
from fleetjax.io.errors import Diverged, Refusal
from fleetjax.io.journal import Journal
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics, first_divergence
from fleetjax.priority import get_algorithm


class Start(NamedTuple):
    """Where a run starts.

    Attributes:
        run: the run, with the versions that it continues under.
        state: the fleet.
        metrics: Metrics[t] so far, in numpy arrays; None at t = 0.
        notes: what the journal noted then; nothing at t = 0.
    """

    run: folder.Run
    state: FleetState
    metrics: Metrics | None
    notes: Mapping[str, Any]


def check_interval(checkpoint_every: int) -> None:
    """Check the timesteps between checkpoints.

    Raises:
        ValueError: if there can be none that often.
    """
    if checkpoint_every < 0 or checkpoint_every == 1:
        raise ValueError(f"checkpoint_every = {checkpoint_every} must be 0 (none) or at least 2 timesteps")


def complete(run: folder.Run, *, checkpoint_every: int) -> Metrics:
    """Run what is left of a run, whatever its folder holds of it: nothing yet, a part, or all.

    Args:
        run: its folder and its configuration, and whether interventions are logged.
        checkpoint_every: timesteps between checkpoints; 0 = none.

    Returns:
        Metrics[T] in numpy arrays.

    Raises:
        ValueError: if the folder holds another run, or a damaged one.
        BlockingIOError: if another process works on it.
        Exception: as `run_in_folder` does.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    with files.lock(run.folder):
        begun = folder.is_run(run.folder)
        if begun:
            run = read_same(run)
            finished = folder.read_finished(run)
            if finished:
                return finished
        else:
            folder.check_folder(run.folder, overwrite=False)
        return run_in_folder(run, resume=begun, checkpoint_every=checkpoint_every)


def read_same(asked: folder.Run) -> folder.Run:
    """Return what a folder holds of the run that is asked for.

    Raises:
        ValueError: if it holds another run, or a damaged one.
    """
    run = folder.read_run(asked.folder)
    difference = folder.first_difference(asked, run)
    if difference:
        raise ValueError(f"{difference} in {run.folder}; choose another --output")
    return run


def run_in_folder(run: folder.Run, *, resume: bool, checkpoint_every: int) -> Metrics:
    """Run what is left of a run. An older run in its folder is deleted once there are timesteps to take its place.

    Args:
        run: its folder, which this process has locked, its configuration, and whether interventions are logged.
        resume: whether to look for checkpoints; else it starts at t = 0.
        checkpoint_every: timesteps between checkpoints; 0 = none.

    Returns:
        Metrics[T] in numpy arrays.

    Raises:
        Refusal: if there are checkpoints and none can be used.
        OSError: if something cannot be written.
        Diverged: if something learnt is no longer finite.
        KeyboardInterrupt: if it was asked to stop; the message says how to resume it.
    """
    begun, new = time.monotonic(), folder.prepare(run)
    say(f"{text.headline(run.config, run.seed)}, on the {jax.default_backend().upper()} ...")
    key, total = jax.random.key(run.seed), run.config.num_steps
    length, journal = chunks.chunk_length(total, checkpoint_every), Journal(run, checkpoint_every)
    try:
        run, state, before, notes = (_resume(run) if resume else None) or _begin(run, key, length)
        say(f"ready after {text.duration(time.monotonic() - begun)}")
        lengths = chunks.chunks_of(total - int(state.timestep), length)
        remaining = chunks.run_chunks(run.config, key, state, lengths, logged=run.logged)
        with contextlib.closing(journal), progress(run.config, before) as show, stoppable() as asked_to_stop:
            if before:
                journal.reopen(run, before, notes)
            for chunk, state in remaining:
                if not journal.metrics:
                    if asked_to_stop() and not (new or resume):
                        raise KeyboardInterrupt  # the older run is still there
                    journal.create(run)
                journal.append(chunk)
                show(chunk.metrics)
                check_finite(chunk.metrics, journal.timestep, run)
                stopping = asked_to_stop() and journal.timestep < total
                if stopping or journal.is_due:
                    journal.save(state)
                if stopping:
                    break
            journal.finish()
        if journal.timestep < total:
            raise KeyboardInterrupt(f"at t = {journal.timestep} of {total}; resume with: fleetjax run --resume {run.folder}")
    except (KeyboardInterrupt, Diverged):
        if not journal.metrics:
            raise unbegun(run, new=new) from None
        seal(run, chunks.join(journal.metrics))
        raise
    metrics = chunks.join(journal.metrics)
    if get_algorithm(run.config.algorithm).pretrains:
        folder.write_policy(run.folder, state.policy)
    seal(run, metrics)
    return metrics


def _begin(run: folder.Run, key: jax.Array, length: int) -> Start:
    """Pre-train."""
    first = "pre-training" if get_algorithm(run.config.algorithm).pretrains else "preparing"
    say(f"compiling and {first} ...")
    state = chunks.start(run.config, key, length, logged=run.logged)
    return Start(run._replace(versions=()), state, None, {})


def _resume(run: folder.Run) -> Start | None:
    """Read the newest intact checkpoint, and say which are not; None if none was written yet.

    Raises:
        Refusal: if there are checkpoints and none can be used, or they are those of a fleet that was divided over devices.
    """

    def check(found: checkpoint.Checkpoint) -> None:
        metrics_until(run, int(found.state.timestep), found.notes)
        if run.logged:
            files.beginning(run.folder / interventions.FILE, found.notes.get("interventions"))

    parts = checkpoint.parts(run.folder)
    if parts > 1:
        raise Refusal(f"{run.folder} was run with --distributed on {parts} devices; repeat that command to resume it")
    shapes = state_shapes(run.config, envs.make(run.config.environment, run.config.backend))
    found, refused = checkpoint.restore(run.folder, folder.identity(run.config, run.seed), shapes, check)
    for reason in refused:
        say(f"skipped checkpoint {reason}")
    if found is None:
        check_nothing_is_lost(run, folder.from_the_start(run))
        say("no checkpoint was written yet; starting from t = 0")
        return None
    say(f"resuming from {found.path}")
    timestep = int(found.state.timestep)
    metrics = metrics_until(run, timestep, found.notes)
    return Start(under_versions_of_today(run, timestep), found.state, metrics, found.notes)


def metrics_until(run: folder.Run, timestep: int, notes: Mapping[str, Any]) -> Metrics:
    """Return Metrics[t] until the checkpoint at a timestep, by its notes.

    Raises:
        ValueError: if the file no longer holds them.
    """
    metrics = metrics_csv.parse(files.beginning(run.folder / folder.METRICS, notes.get("metrics")), timestep)
    if len(metrics.successes) != timestep:
        raise ValueError(f"{folder.METRICS} had fewer timesteps at that time")
    return metrics


def check_nothing_is_lost(run: folder.Run, remedy: str) -> None:
    """Check that a run of which no checkpoint can be used has none, so that it may start again.

    Raises:
        Refusal: if there are checkpoints, with what to do besides deleting the folder.
    """
    if checkpoint.is_any_finished(run.folder):
        raise Refusal(f"{run.folder} has no checkpoint that can be used; delete the folder, or {remedy}")


def under_versions_of_today(run: folder.Run, timestep: int) -> folder.Run:
    """Return a run with the versions that it continues under; say so if they are others than before."""
    run = folder.resumed(run, timestep)
    if run.versions[-1]["timestep"] == timestep:
        before, now = run.versions[-2:]
        names = folder.changes(before, now)
        old, new = (", ".join(f"{name} {entry[name]}" for name in names) for entry in (before, now))
        say(
            f"before t = {timestep} this run used {old}; it resumes with {new}, "
            "so its numbers may differ from those of an uninterrupted run"
        )
    return run


def check_finite(chunk: Metrics, done: int, run: folder.Run) -> None:
    """Check that all that was learnt is finite.

    Args:
        chunk: Metrics[C] of the last timesteps.
        done: timesteps so far, those included.
        run: the run.

    Raises:
        Diverged: if it is not; the message says what was not, and when first.
    """
    found = first_divergence(chunk)
    if found:
        first, names = found
        what = text.divergence(done - len(chunk.diverged) + first, names)
        raise Diverged(f"{what}. The metrics so far are in {run.folder}")


def unbegun(run: folder.Run, *, new: bool) -> KeyboardInterrupt:
    """Return what to raise if a run is stopped before its first timestep; its folder is removed if it is new."""
    if new:
        folder.discard(run.folder)
    return KeyboardInterrupt(f"before the first timestep; {'nothing was kept' if new else f'{run.folder} is unchanged'}")


def seal(run: folder.Run, metrics: Metrics) -> None:
    """Draw what there is, and store the SHA-256 of all files."""
    from fleetjax.io import figure  # matplotlib takes a while to import

    drawn = figure.plot([(run.config, run.seed, metrics)], text.headline(run.config, run.seed))
    files.write(run.folder / folder.FIGURE, figure.render(drawn))
    folder.write_config(run, sealed=True)


class _Stop:
    """What signals call in `stoppable`: the first one asks, the second one stops at once."""

    def __init__(self):
        self.asked = False

    def __call__(self, number: int, frame: Any) -> None:
        if self.asked:
            raise KeyboardInterrupt("at once, without a checkpoint")
        self.asked = True
        say("\nstopping after this chunk of timesteps; press Ctrl-C again to stop at once")


@contextlib.contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether the process was asked to stop, by Ctrl-C or SIGTERM; twice stops it at once.

    A block within another one hears also what the outer one was asked before.
    """
    if threading.current_thread() is not threading.main_thread():  # which alone hears signals
        yield lambda: False
        return
    heard = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    outer = [handler for number in heard if isinstance(handler := signal.getsignal(number), _Stop)]
    stop = outer[0] if outer else _Stop()
    before = {number: signal.signal(number, stop) for number in heard}
    try:
        yield lambda: stop.asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""A run in its folder, by several processes or devices together: as `resumable` does for one."""

import contextlib
import time
import uuid
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from fleetjax import envs, sharding
from fleetjax.checks import state_shapes
from fleetjax.distribute import spread, with_parts
from fleetjax.experiment import prepare
from fleetjax.fleet import FleetState
from fleetjax.io import checkpoint, chunks, files, folder, resumable, team, text
from fleetjax.io.errors import Diverged, Refusal
from fleetjax.io.journal import Journal
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics, first_divergence
from fleetjax.priority import get_algorithm

PATIENCE = 20.0  # seconds until every process should see a new file of another's
_prepare = jax.jit(prepare, static_argnames="mesh")


def complete(run: folder.Run, *, checkpoint_every: int, step_timeout: int) -> Metrics | None:
    """Run what is left of a run, whatever its folder holds of it: nothing yet, a part, or all.

    Every process calls this with the same arguments. The folder is on a file system that all of them share.

    Returns:
        Metrics[T] in numpy arrays, for the process that leads; None for the others.

    Raises:
        Refusal: if processes disagree, or the folder cannot be used.
        Diverged: if something learnt is no longer finite.
        KeyboardInterrupt: if one was asked to stop.
    """
    again = "repeat the same command on all processes to resume"
    with contextlib.ExitStack() as stack:
        beat = stack.enter_context(team.watched(step_timeout, again))
        identity = folder.identity(run.config, run.seed)
        facts = {**folder.versions(), **identity.pop("config"), **identity, "checkpoint_every": checkpoint_every}
        try:
            team.check_agreement(facts)
        except ValueError as error:
            raise Refusal(str(error)) from error
        team.led(lambda: _lock(run.folder, stack))
        _check_shared(run.folder)
        begun = team.led(lambda: _look(run))
        if begun["finished"]:
            return folder.read_finished(folder.read_run(run.folder)) if team.leads() else None
        return _run(run, begun, checkpoint_every, beat, again)


def _check_shared(path: Path) -> None:
    """Check that all processes have the same folder: each must see what the one that leads puts there.

    Raises:
        Refusal: if one does not.
    """
    mark = path / team.led(lambda: _leave_mark(path))
    until = time.monotonic() + PATIENCE
    while not (seen := mark.exists()) and time.monotonic() < until:  # NFS shows new files late
        time.sleep(0.1)
    blind = [number for number, sees in enumerate(team.tell(seen)) if not sees]
    if team.leads():
        mark.unlink(missing_ok=True)
    if blind:
        who = f"process {blind[0]} does" if len(blind) == 1 else f"processes {', '.join(map(str, blind))} do"
        raise Refusal(
            f"{who} not see the folder of process 0; give all processes the same --output, on a file system that they share"
        )


def _leave_mark(path: Path) -> str:
    name = f".seen-{uuid.uuid4().hex}"
    (path / name).touch()
    return name


def _lock(path: Path, stack: contextlib.ExitStack) -> None:
    """Make the folder, if it is not there, and lock it until the stack ends."""
    path.mkdir(parents=True, exist_ok=True)
    stack.enter_context(files.lock(path))


def _look(run: folder.Run) -> dict[str, Any]:
    """Return what the folder holds: a finished run, a checkpoint, or nothing."""
    if not folder.is_run(run.folder):
        folder.check_folder(run.folder, overwrite=False)
        folder.prepare(run)
        return {"finished": False, "checkpoint": None}
    if folder.read_finished(resumable.read_same(run)):
        return {"finished": True}
    fits = partial(resumable.metrics_until, run)
    path, refused = checkpoint.newest(run.folder, folder.identity(run.config, run.seed), fits)
    for reason in refused:
        say(f"skipped checkpoint {reason}")
    if path is None:
        resumable.check_nothing_is_lost(run, "choose another --output")
    return {"finished": False, "checkpoint": path and path.name}


def _start(run: folder.Run, name: str | None, mesh: Mesh) -> tuple[FleetState, Metrics | None, Mapping[str, Any]]:
    """Return the state to start from on a mesh, the Metrics[t] so far, and the notes of the checkpoint, if it is one."""
    config = run.config
    if name is None:
        return _prepare(config, jax.random.key(run.seed), mesh=mesh), None, {}
    whole = state_shapes(config, envs.make(config.environment, config.backend))
    shapes = lambda parts: jax.eval_shape(partial(with_parts, parts=parts), whole)  # noqa: E731
    identity = folder.identity(config, run.seed)
    state, notes = checkpoint.read_shares(run.folder / checkpoint.FOLDER / name, identity, shapes, sharding.flat(mesh))

    def divide(state: FleetState) -> FleetState:
        with sharding.over(mesh, config.num_humans):
            return spread(state)

    before = resumable.metrics_until(run, int(state.timestep), notes) if team.leads() else None
    return jax.jit(divide)(state), before, notes


def _run(run: folder.Run, begun: dict[str, Any], every: int, beat: Callable[[], None], again: str) -> Metrics | None:
    mesh, config, key, total = team.mesh(), run.config, jax.random.key(run.seed), run.config.num_steps
    leads, length = team.leads(), chunks.chunk_length(run.config.num_steps, every)
    if leads:
        processes = f"{jax.process_count()} processes" if jax.process_count() > 1 else "1 process"
        say(f"{text.headline(config, run.seed)}, on {mesh.size} devices of {processes} ...")
    state, before, notes = _start(run, begun["checkpoint"], mesh)
    saved = done = int(state.timestep)
    beat()
    with contextlib.ExitStack() as stack:
        asked = stack.enter_context(resumable.stoppable())
        journal = stack.enter_context(contextlib.closing(Journal(run, 0))) if leads else None
        show = stack.enter_context(progress(config, before)) if leads else None
        if journal and before:
            run = resumable.under_versions_of_today(folder.read_run(run.folder), done)
            journal.reopen(run, before, notes)
        elif journal:
            journal.create(run)
        remaining = chunks.run_chunks(config, key, state, chunks.chunks_of(total - done, length), mesh=mesh)
        for chunk, state in remaining:
            beat()
            if journal and show:
                journal.append(chunk)
                show(chunk.metrics)
            if found := first_divergence(chunk.metrics):
                raise Diverged(text.divergence(done + found[0], found[1]))
            done += len(chunk.metrics.successes)
            stopping = any(team.tell(asked())) and done < total
            if stopping or (every and done - saved >= every and done < total):
                marks = team.tell(journal.marks() if journal else None)[0]
                checkpoint.write_shares(
                    run.folder, folder.identity(config, run.seed), state, marks, leads=leads, meet=team.meet
                )
                saved = done
                beat()
            if stopping:
                raise KeyboardInterrupt(f"at t = {done} of {total}; {again}")
    if not journal:
        team.meet("finished")
        return None
    joined = chunks.join(journal.metrics)
    if get_algorithm(config.algorithm).pretrains:
        folder.write_policy(run.folder, state.policy)
    resumable.seal(run, joined)
    team.meet("finished")
    return joined

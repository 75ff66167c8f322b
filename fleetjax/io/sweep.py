"""A sweep in its folder: many runs, in several processes that have cores of their own.

The runs' folders are all that is kept, besides `sweep.json`, which says what the sweep is. So a sweep that was stopped or
killed resumes by what they hold: finished runs are skipped, others resume from their checkpoints. Each process locks the folder
of its run. Jobs of a cluster, which are nobody's children, agree by leases who has which run.
"""

import contextlib
import json
import time
from collections.abc import Sequence

import jax

from fleetjax.io import cluster, crew, files, folder, metrics_csv, resumable, text
from fleetjax.io.errors import Incomplete
from fleetjax.io.job import LOGS
from fleetjax.io.progress import progress_of_many, say
from fleetjax.io.study import Group, Study, combine, groups

FILE = "sweep.json"


def leave_gpus_to_workers() -> None:
    """Let this process compute on the CPU: JAX would hold the GPUs, which its workers need."""
    jax.config.update("jax_platforms", "cpu")


def check_folder(study: Study, runs: Sequence[folder.Run]) -> None:
    """Check that the folder of a sweep is new or empty, or holds a part of the same sweep.

    Raises:
        ValueError: if it does not; the message has the first difference.
    """
    path = study.output
    if not (path / FILE).exists():
        files.expect(files.is_unused(path), f"{path} already exists and is not the folder of a sweep; choose another --output")
        return
    held = _read(study)
    files.expect(
        held.seeds_per_program == study.seeds_per_program,
        f"seeds_per_program = {study.seeds_per_program}, but the sweep in {path} has {held.seeds_per_program}, and its runs "
        "would round differently; choose another --output",
    )
    here, before = {run.folder: run for run in runs}, combine(held)
    for run in before:
        files.expect(
            run.folder in here,
            f"{path} holds another sweep, with a run {run.folder.name} that this one lacks; choose another --output",
        )
        difference = folder.first_difference(here[run.folder], run)
        files.expect(not difference, f"{run.folder.name}: {difference} in {path}; choose another --output")
    theirs, ours = (
        {frozenset(run.folder for run in group) for group in groups(each, study.seeds_per_program)} for each in (before, runs)
    )
    files.expect(
        theirs <= ours,
        f"with these seeds, other runs than in {path} would be side by side, and round differently; add whole groups of "
        f"seeds_per_program = {study.seeds_per_program} seeds behind the others, or choose another --output",
    )


def _read(study: Study) -> Study:
    """Return the sweep that the folder holds.

    Raises:
        ValueError: if what says so is damaged.
    """
    path = study.output / FILE
    try:
        content = json.loads(path.read_bytes())
        found = study._replace(
            blocks=tuple(content["runs"]),
            logged=content["log_interventions"],
            seeds_per_program=content.get("seeds_per_program", 1),
        )
        combine(found)
        return found
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} cannot be used: {files.one_line(error)}; choose another --output") from None


def run_all(study: Study, runs: Sequence[folder.Run]) -> None:
    """Complete all runs of a sweep whose folder was checked.

    Raises:
        Incomplete: if some failed.
        KeyboardInterrupt: if it was asked to stop; the message says how to resume it.
    """
    begun = time.monotonic()
    study.output.mkdir(parents=True, exist_ok=True)
    with files.lock(study.output):
        content = {"runs": study.blocks, "log_interventions": study.logged, "seeds_per_program": study.seeds_per_program}
        files.write_json(study.output / FILE, content)
        (study.output / LOGS).mkdir(exist_ok=True)
        done = {run.folder for run in runs if is_finished(run)}
        waiting = [group for group in groups(runs, study.seeds_per_program) if not done.issuperset(run.folder for run in group)]
        finished, all_runs = len(done), text.plural(len(runs), "run")
        say(f"{all_runs}, {finished} of them finished already")
        try:
            failed = _complete(study, runs, waiting)
        except KeyboardInterrupt:
            finished = sum(map(is_finished, runs))
            raise KeyboardInterrupt(f"with {finished} of {all_runs} finished; repeat the command to resume") from None
    if failed:
        raise Incomplete(f"{failed} of {all_runs} failed; repeat the command to try again; delete a damaged run folder first")
    print(f"{all_runs} finished, {text.duration(time.monotonic() - begun)} in all. Folder: {study.output}")


def is_finished(run: folder.Run) -> bool:
    """Return whether the folder of a run holds all of it."""
    try:
        found = folder.read_run(run.folder)
        return not folder.first_difference(run, found) and folder.read_finished(found) is not None
    except (OSError, ValueError):  # which a worker will meet again, and tell
        return False


def _workers(study: Study, waiting: Sequence[Group]) -> crew.Crew | cluster.Jobs:
    """Return who completes the runs that wait."""
    if study.launcher and waiting:
        return cluster.Jobs(study, waiting)
    return crew.Crew(waiting, study.workers, study.checkpoint_every, study.output / LOGS)


def _complete(study: Study, runs: Sequence[folder.Run], waiting: Sequence[Group]) -> int:
    """Complete the groups that wait, and show how all runs stand.

    Returns:
        int: how many failed.

    Raises:
        KeyboardInterrupt: if it was asked to stop before all had ended.
    """
    logs = {run.folder: study.output / LOGS / f"{group[0].folder.name}.log" for group in waiting for run in group}
    timesteps = {run.folder: metrics_csv.count(run.folder) for run in runs}
    ended, failed = len(runs) - len(logs), 0
    with (
        progress_of_many(len(runs), sum(run.config.num_steps for run in runs), sum(timesteps.values())) as show,
        resumable.stoppable() as asked_to_stop,
        contextlib.closing(_workers(study, waiting)) as workers,
    ):
        while workers.busy:
            for run, reason in workers.wait():
                ended, failed, timesteps[run.folder] = ended + 1, failed + bool(reason), run.config.num_steps
                news = f"failed: {reason}; its log is {logs[run.folder]}" if reason else "finished"
                show(ended, sum(timesteps.values()), f"{run.folder.name} {news}", failed=bool(reason))
            timesteps |= {run.folder: metrics_csv.count(run.folder) for run in workers.busy}
            show(ended, sum(timesteps.values()))
            if asked_to_stop():
                workers.stop()
    if ended < len(runs):
        raise KeyboardInterrupt
    return failed

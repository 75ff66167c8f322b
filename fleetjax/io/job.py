"""A job of a sweep on a cluster: a process that takes groups of runs which no other job has, and completes them.

What a job is sent is plain data, and nothing here loads JAX before the job has taken its place.
"""

import contextlib
import os
import signal
import sys
import time
import traceback
from collections.abc import Mapping
from typing import Any, NamedTuple

from fleetjax.io import files, worker
from fleetjax.io.lease import Leases
from fleetjax.io.place import Place

LEASES, LOGS = "leases", "logs"
POLLS = 20  # in a term, of a job that waits


class Job(NamedTuple):
    """What a job is sent; submitit calls it on its machine, and again when the scheduler has stopped and requeued it.

    Attributes:
        study: fields of `study.Study`, as plain data.
        sweep: name of the sweep that was started.
        core: index of the core to use, among those that it may use; None = all that the scheduler gave it.
        gpu: as CUDA_VISIBLE_DEVICES names it; None = all that the scheduler gave it.
        term: seconds, see `Leases`.
    """

    study: Mapping[str, Any]
    sweep: str
    core: int | None
    gpu: str | None
    term: float

    def __call__(self) -> None:
        """Complete runs until all have finished or failed."""
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # submitit ignores it, even while there is no run to stop
        cores = sorted(os.sched_getaffinity(0))
        Place(cores if self.core is None else [cores[self.core % len(cores)]], self.gpu).take()
        try:
            complete_all(self)
        except KeyboardInterrupt as interrupt:  # whoever asked for it needs no answer
            print(f"interrupted {' '.join(interrupt.args)}", file=sys.stderr)

    def checkpoint(self, *args: Any, **kwargs: Any) -> Any:
        """Return the job to submit when its time is up: this one."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *args, **kwargs)


def complete_all(job: Job) -> None:
    """Take and complete groups. If other jobs hold all that are left, wait: one of those jobs may die.

    Raises:
        KeyboardInterrupt: if the job was asked to stop.
    """
    from fleetjax.io import crew, resumable, study

    asked = study.from_plain(job.study)
    leases = Leases(asked.output / LEASES, job.sweep, job.term)
    left, compiled = study.groups(study.plan(asked), asked.seeds_per_program), None
    with resumable.stoppable() as asked_to_stop:
        while left:
            if asked_to_stop():
                raise KeyboardInterrupt("between runs")
            seen = {run.folder.name: leases.look(run.folder.name) for runs in left for run in runs}
            left = [runs for runs in left if not all(leases.ended(seen[run.folder.name]) for run in runs)]
            free = [runs for runs in left if all(leases.is_free(seen[run.folder.name]) for run in runs)]
            if not free:
                time.sleep(job.term / POLLS)
                continue
            runs = crew.choose(free, compiled, [study.program(others) for others in left if others not in free])
            compiled = _complete(asked, job.term, runs, leases) or compiled


def _complete(asked: Any, term: float, runs: Any, leases: Leases) -> Any:
    """Take a group, with the leases of all its runs, and complete it.

    Args:
        asked: the sweep, as `study.Study`.
        term: seconds, see `Leases`.
        runs: a `study.Group` that was free when last looked at.
        leases: of the sweep's runs.

    Returns:
        The program that this compiled; None if another job was faster.

    Raises:
        KeyboardInterrupt: if the job was asked to stop.
    """
    from fleetjax.io import group, study

    with contextlib.ExitStack() as stack:
        helds = []
        for run in runs:
            held = stack.enter_context(leases.taken(run.folder.name))
            if held is None:
                return None
            helds.append(held)
        worker.log_to(asked.output / LOGS / f"{runs[0].folder.name}.log")
        try:
            reasons = group.complete(runs, checkpoint_every=asked.checkpoint_every)
        except BlockingIOError as error:  # a process on this machine has it, but did not renew its lease
            print(files.one_line(error), file=sys.stderr, flush=True)
            time.sleep(term / POLLS)
            return study.program(runs)
        except Exception as error:
            traceback.print_exc()
            reasons = [files.one_line(error)] * len(runs)
        for held, reason in zip(helds, reasons, strict=True):
            held.end("failed" if reason else "finished", reason)
    return study.program(runs)

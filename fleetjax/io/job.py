"""A job of a sweep on a cluster: a process that takes runs which no other job has, and completes them.

What a job is sent is plain data, and nothing here loads JAX before the job has its cores.
"""

import os
import sys
import time
import traceback
from collections.abc import Mapping
from typing import Any, NamedTuple

from fleetjax.io import files, worker
from fleetjax.io.lease import Leases

LEASES, LOGS = "leases", "logs"
POLLS = 20  # in a term, of a job that waits


class Job(NamedTuple):
    """What a job is sent; submitit calls it on its machine, and again when the scheduler has stopped and requeued it.

    Attributes:
        study: fields of `study.Study`, as plain data.
        sweep: name of the sweep that was started.
        core: index of the core to use, among those that it may use; None = all that the scheduler gave it.
        term: seconds, see `Leases`.
    """

    study: Mapping[str, Any]
    sweep: str
    core: int | None
    term: float

    def __call__(self) -> None:
        """Complete runs until all have finished or failed."""
        cores = sorted(os.sched_getaffinity(0))
        if self.core is not None:
            os.sched_setaffinity(0, {cores[self.core % len(cores)]})
        try:
            complete_all(self)
        except KeyboardInterrupt as interrupt:  # whoever asked for it needs no answer
            print(f"interrupted {' '.join(interrupt.args)}", file=sys.stderr)

    def checkpoint(self, *args: Any, **kwargs: Any) -> Any:
        """Return the job to submit when its time is up: this one."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *args, **kwargs)


def complete_all(job: Job) -> None:
    """Take and complete runs. If other jobs hold all runs that are left, wait: one of those jobs may die.

    Raises:
        KeyboardInterrupt: if the job was asked to stop.
    """
    from fleetjax.io import crew, resumable, study

    asked = study.from_plain(job.study)
    leases = Leases(asked.output / LEASES, job.sweep, job.term)
    left, compiled = {run.folder.name: run for run in study.plan(asked)}, None
    with resumable.stoppable() as asked_to_stop:
        while left:
            if asked_to_stop():
                raise KeyboardInterrupt("between runs")
            seen = {name: leases.look(name) for name in left}
            left = {name: run for name, run in left.items() if not leases.ended(seen[name])}
            free = [run for name, run in left.items() if leases.is_free(seen[name])]
            if not free:
                time.sleep(job.term / POLLS)
                continue
            run = crew.choose(free, compiled, [study.program(other) for other in left.values() if other not in free])
            with leases.taken(run.folder.name) as held:
                if held is None:
                    continue
                worker.log_to(asked.output / LOGS / f"{run.folder.name}.log")
                compiled = study.program(run)
                try:
                    resumable.complete(run, checkpoint_every=asked.checkpoint_every)
                    held.end("finished")
                except BlockingIOError as error:  # a process on this machine has it, but did not renew its lease
                    print(files.one_line(error), file=sys.stderr, flush=True)
                    time.sleep(job.term / POLLS)
                except Exception as error:
                    traceback.print_exc()
                    held.end("failed", files.one_line(error))

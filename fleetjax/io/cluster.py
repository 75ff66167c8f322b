"""Jobs that complete a sweep: started by submitit, on this machine or by SLURM, and watched from here.

Jobs need nothing of the process that started them but the sweep's folder, which all machines share.
"""

import os
import signal
import time
import uuid
from collections.abc import Sequence
from typing import Any

from fleetjax.io import crew, place, study
from fleetjax.io.folder import Run
from fleetjax.io.job import LEASES, Job
from fleetjax.io.lease import Leases

FOLDER = "jobs"  # where submitit writes
_POLL = 0.5  # seconds
_DONE = 60.0  # seconds that stopped jobs get
_REQUEUES = 10_000  # of a job at most
_WARNING = 300  # seconds before the end of its time in which a job of a cluster is requeued


def check(launcher: study.Launcher | None) -> None:
    """Check that the launcher can be used here.

    Raises:
        ValueError: if it cannot.
    """
    if launcher is None:
        return
    try:
        submitit = _submitit()
    except ImportError:
        raise ValueError(f'launcher = {launcher.kind!r} needs submitit; install it: pip install ".[cluster]"') from None
    if launcher.kind == "slurm" and submitit.SlurmExecutor.affinity() < 0:
        raise ValueError("launcher = 'slurm' needs SLURM, and this machine has no srun; run this on the cluster, or omit it")


def _submitit() -> Any:
    """Return the library. It would set up the whole process's logging when it is imported, unless told not to."""
    os.environ.setdefault("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    import submitit

    return submitit


class Jobs:
    """The jobs of a sweep. It has the methods of `crew.Crew`.

    Args:
        asked: the sweep.
        waiting: groups of runs to complete.
    """

    def __init__(self, asked: study.Study, waiting: Sequence[study.Group]):
        submitit = _submitit()
        assert asked.launcher
        launcher, name = asked.launcher, uuid.uuid4().hex[:12]
        self._kind, self._left, self._stopping = launcher.kind, [run for group in waiting for run in group], False
        self._leases = Leases(asked.output / LEASES, name, launcher.lease)
        self._log = asked.output / FOLDER
        executor = submitit.AutoExecutor(folder=self._log, cluster=launcher.kind, slurm_max_num_timeout=_REQUEUES)
        common: dict[str, Any] = {"name": "fleetjax", "timeout_min": launcher.minutes, "cpus_per_task": 1}
        if launcher.kind == "slurm":
            common |= {"slurm_signal_delay_s": _WARNING}
            common |= {"slurm_partition": launcher.partition} if launcher.partition else {}
            common |= {"gpus_per_node": 1} if launcher.gpu else {}
        executor.update_parameters(**common)
        plain, number = study.to_plain(asked), min(launcher.jobs, len(waiting))
        if launcher.kind == "local":
            found = place.gpus() or [None]
            places = [(i, found[i % len(found)]) for i in range(number)]
        else:
            places = [(None, None)] * number  # the scheduler gives what it gives
        with crew.deaf_to_ctrl_c():
            self._jobs = [executor.submit(Job(plain, name, core, gpu, launcher.lease)) for core, gpu in places]

    @property
    def busy(self) -> list[Run]:
        """The runs that have not ended."""
        return list(self._left)

    def wait(self) -> list[tuple[Run, str]]:
        """Wait briefly. Return the runs that finished, each with "", and those that failed, each with the reason."""
        time.sleep(_POLL)
        over = all(job.done() for job in self._jobs)  # before the leases are read, which jobs write first
        ended = [(run, found.reason) for run in self._left if (found := self._leases.ended(self._leases.look(run.folder.name)))]
        done = {run.folder for run, _ in ended}
        self._left = [run for run in self._left if run.folder not in done]
        if over:
            ended += [(run, f"all jobs have ended; their logs are in {self._log}") for run in self._left if not self._stopping]
            self._left = []
        return ended

    def stop(self) -> None:
        """Let each job write a checkpoint and end."""
        if not self._stopping:
            self._stopping = True
            for job in self._jobs:
                self._end(job)

    def _end(self, job: Any) -> None:
        """Ask a job to end."""
        if job.done():
            return
        if self._kind == "local":
            os.kill(int(job.job_id), signal.SIGTERM)  # which its parent passes on
        else:
            job.cancel(check=False)

    def close(self) -> None:
        """End the jobs that are left."""
        self.stop()
        until = time.monotonic() + _DONE
        while not all(job.done() for job in self._jobs) and time.monotonic() < until:
            time.sleep(0.1)

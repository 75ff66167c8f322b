"""The workers of a sweep: processes with cores of their own, and which run each takes next."""

import collections
import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from fleetjax.io import worker
from fleetjax.io.folder import Run
from fleetjax.io.study import program

_POLL = 0.5  # seconds


class _Worker:
    """A process, and the run that it completes.

    Args:
        cores: that it may use.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs.
    """

    def __init__(self, cores: list[int], checkpoint_every: int, logs: Path):
        context = multiprocessing.get_context("spawn")
        self.cores, (self.pipe, end) = cores, context.Pipe()
        self.process = context.Process(target=worker.work, args=(end, cores, checkpoint_every, logs), daemon=True)
        with deaf_to_ctrl_c():
            self.process.start()
        end.close()
        self.run: Run | None = None
        self.program: Any = None

    def begin(self, run: Run) -> None:
        """Let it complete a run."""
        self.run, self.program = run, program(run)
        with contextlib.suppress(OSError):  # it has died, as the end of its pipe will tell
            self.pipe.send(run)

    def result(self) -> str | None:
        """Return "" if the run is finished, or why it failed; None if the process has ended."""
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return None


@contextlib.contextmanager
def deaf_to_ctrl_c() -> Iterator[None]:
    """Let a process that is started meanwhile not hear Ctrl-C, which a terminal sends to all: its parent tells it to stop.

    The signal is blocked, not ignored: one that arrives meanwhile reaches this process afterwards.
    """
    resource_tracker.ensure_running()  # which would unblock it when it starts with the first process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Crew:
    """The workers, and the runs that wait for them.

    Args:
        waiting: runs to complete.
        workers: processes at most; None = one for each core.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs, one for each run.
    """

    def __init__(self, waiting: Sequence[Run], workers: int | None, checkpoint_every: int, logs: Path):
        self._waiting, self._options, self._stopping = list(waiting), (checkpoint_every, logs), False
        cores = sorted(os.sched_getaffinity(0))
        number = min(workers or len(cores), len(waiting))
        shares = [cores[i::number] or [cores[i % len(cores)]] for i in range(number)]
        self._workers = [_Worker(share, *self._options) for share in shares]
        for one in self._workers:
            self._assign(one)

    @property
    def busy(self) -> list[Run]:
        """The runs that are under way."""
        return [one.run for one in self._workers if one.run]

    def wait(self) -> list[tuple[Run, str]]:
        """Wait briefly. Return the runs that finished, each with "", and those that failed, each with the reason."""
        working: dict[Any, _Worker] = {one.pipe: one for one in self._workers if one.run}
        ended = []
        for pipe in wait(list(working), _POLL):
            one = working[pipe]
            run, reason = one.run, one.result()
            assert run
            one.run = None
            if reason is None and self._stopping:
                continue
            if reason is None:
                reason = f"its worker ended ({_how(one.process.exitcode)})"
                one = self._replace(one)
            ended.append((run, reason))
            self._assign(one)
        return ended

    def _replace(self, dead: _Worker) -> _Worker:
        dead.pipe.close()
        new = _Worker(dead.cores, *self._options)
        self._workers[self._workers.index(dead)] = new
        return new

    def _assign(self, one: _Worker) -> None:
        """Give a worker the next run, or let it end if there is none."""
        if self._waiting:
            run = choose(self._waiting, one.program, [other.program for other in self._workers if other.run])
            self._waiting.remove(run)
            one.begin(run)
        else:
            one.pipe.close()

    def stop(self) -> None:
        """Let each worker write a checkpoint and end; start no more runs."""
        if not self._stopping:
            self._stopping, self._waiting = True, []
            for one in self._workers:
                if one.run:
                    one.process.terminate()

    def close(self) -> None:
        """End all processes, at once if they are at work."""
        for one in self._workers:
            if one.run:
                one.process.kill()
            one.pipe.close()
        for one in self._workers:
            one.process.join()


def choose(waiting: Sequence[Run], compiled: Any, others: Sequence[Any]) -> Run:
    """Return the run that a worker takes next.

    One whose program it has compiled; then one whose program fewest other workers have; then one of the program with most runs.

    Args:
        waiting: runs to choose from, at least one.
        compiled: the program of the worker's last run; None at first.
        others: the programs of the runs that other workers complete.
    """
    left = collections.Counter(map(program, waiting))

    def rank(run: Run) -> tuple[bool, int, int]:
        own = program(run)
        return compiled is None or own != compiled, others.count(own), -left[own]

    return min(waiting, key=rank)


def _how(exitcode: int | None) -> str:
    return signal.Signals(-exitcode).name if exitcode and exitcode < 0 else f"exit code {exitcode}"

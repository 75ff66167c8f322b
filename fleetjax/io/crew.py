"""The workers of a sweep: processes with cores of their own, and which group of runs each takes next."""

import collections
import contextlib
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from fleetjax.io import place, worker
from fleetjax.io.folder import Run
from fleetjax.io.study import Group, program

_POLL = 0.5  # seconds


class _Worker:
    """A process, and the group of runs that it completes.

    Args:
        where: the cores that it may use, and its GPU.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs.
    """

    def __init__(self, where: place.Place, checkpoint_every: int, logs: Path):
        context = multiprocessing.get_context("spawn")
        self.place, (self.pipe, end) = where, context.Pipe()
        self.process = context.Process(target=worker.work, args=(end, where, checkpoint_every, logs), daemon=True)
        with deaf_to_ctrl_c():
            self.process.start()
        end.close()
        self.group: Group = ()
        self.program: Any = None

    def begin(self, group: Group) -> None:
        """Let it complete a group."""
        self.group, self.program = group, program(group)
        with contextlib.suppress(OSError):  # it has died, as the end of its pipe will tell
            self.pipe.send(group)

    def result(self) -> list[str] | None:
        """Return for each run "" if it is finished, or why it failed; None if the process has ended."""
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
    """The workers, and the groups of runs that wait for them.

    Args:
        waiting: groups to complete.
        workers: processes at most; None = one for each GPU, or else for each core.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs, one for each group.
    """

    def __init__(self, waiting: Sequence[Group], workers: int | None, checkpoint_every: int, logs: Path):
        self._waiting, self._options, self._stopping = list(waiting), (checkpoint_every, logs), False
        places = place.divide(len(waiting), workers) if waiting else []
        self._workers = [_Worker(one, *self._options) for one in places]
        for one in self._workers:
            self._assign(one)

    @property
    def busy(self) -> list[Run]:
        """The runs that are under way."""
        return [run for one in self._workers for run in one.group]

    def wait(self) -> list[tuple[Run, str]]:
        """Wait briefly. Return the runs that finished, each with "", and those that failed, each with the reason."""
        working: dict[Any, _Worker] = {one.pipe: one for one in self._workers if one.group}
        ended = []
        for pipe in wait(list(working), _POLL):
            one = working[pipe]
            group, reasons = one.group, one.result()
            one.group = ()
            if reasons is None and self._stopping:
                continue
            if reasons is None:
                reasons = [f"its worker ended ({_how(one.process.exitcode)})"] * len(group)
                one = self._replace(one)
            ended += zip(group, reasons, strict=True)
            self._assign(one)
        return ended

    def _replace(self, dead: _Worker) -> _Worker:
        dead.pipe.close()
        new = _Worker(dead.place, *self._options)
        self._workers[self._workers.index(dead)] = new
        return new

    def _assign(self, one: _Worker) -> None:
        """Give a worker the next group, or let it end if there is none."""
        if self._waiting:
            group = choose(self._waiting, one.program, [other.program for other in self._workers if other.group])
            self._waiting.remove(group)
            one.begin(group)
        else:
            one.pipe.close()

    def stop(self) -> None:
        """Let each worker end, with a checkpoint if its run has any; start no more runs."""
        if not self._stopping:
            self._stopping, self._waiting = True, []
            for one in self._workers:
                if one.group:
                    one.process.terminate()

    def close(self) -> None:
        """End all processes, at once if they are at work."""
        for one in self._workers:
            if one.group:
                one.process.kill()
            one.pipe.close()
        for one in self._workers:
            one.process.join()


def choose(waiting: Sequence[Group], compiled: Any, others: Sequence[Any]) -> Group:
    """Return the group of runs that a worker takes next.

    One whose program it has compiled; then one whose program fewest other workers have; then one of the program that has most.

    Args:
        waiting: groups to choose from, at least one.
        compiled: the program of the worker's last group; None at first.
        others: the programs of the groups that other workers complete.
    """
    left = collections.Counter(map(program, waiting))

    def rank(group: Group) -> tuple[bool, int, int]:
        own = program(group)
        return compiled is None or own != compiled, others.count(own), -left[own]

    return min(waiting, key=rank)


def _how(exitcode: int | None) -> str:
    return signal.Signals(-exitcode).name if exitcode and exitcode < 0 else f"exit code {exitcode}"

"""Which worker has a run, where no process is the parent of all: leases in a folder that all workers share.

A run has a folder of leases: files 0, 1, 2 ..., of which the highest counts. A worker takes the run by making the next file,
with a hard link, which succeeds for one worker alone. The owner renews its lease: several times in each `term` it raises a
counter in the file. A worker that sees the same counter for a whole term (its own or the owner's, the longer one) takes the
owner for dead, and makes the next file. An owner that finds a higher file, or could not write for most of its term, has lost
the run: it ends its process at once.

Assumed of the file system: of several machines that make the same hard link one succeeds, and a machine that opens a file sees
what another wrote at least half a term ago. Locks may fail to keep other machines out. Clocks need not agree.
"""

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from fleetjax.io import files

RENEWALS = 6  # in a term
LOST = 75  # exit code of a process that has lost its run: EX_TEMPFAIL


class Lease(NamedTuple):
    """What a lease says.

    Attributes:
        owner: who has the run, or had it: machine, process, and the sweep that it belongs to.
        renewals: how often it was renewed.
        end: "" while the owner is at work; then "finished", "stopped" or "failed".
        reason: why it failed.
        term: the owner's, in seconds.
    """

    owner: tuple[str, int, str]
    renewals: int
    end: str = ""
    reason: str = ""
    term: float = 0.0


class Seen(NamedTuple):
    """The newest lease of a run.

    Attributes:
        number: of its file; -1 = nobody ever had the run.
        lease: what it says; None if there is none, or it cannot be read at this moment.
        since: since when it has been unchanged, by this process's clock.
    """

    number: int
    lease: Lease | None
    since: float


class Leases:
    """The leases of the runs of a sweep, as one worker sees them.

    Args:
        folder: that all workers share.
        sweep: name of the sweep that was started; runs that failed in an older one may be taken again.
        term: seconds without renewal after which others may take this worker for dead.
    """

    def __init__(self, folder: Path, sweep: str, term: float):
        self._folder, self._term, self._seen = folder, term, dict[str, Seen]()
        self._me = (socket.gethostname(), os.getpid(), sweep)

    def look(self, run: str) -> Seen:
        """Return the newest lease of a run, as the folder has it now."""
        number = max((int(path.name) for path in (self._folder / run).glob("[0-9]*")), default=-1)
        lease = _read(self._folder / run / str(number)) if number >= 0 else None
        before = self._seen.get(run)
        if before is None or (before.number, before.lease) != (number, lease):
            self._seen[run] = Seen(number, lease, time.monotonic())
        return self._seen[run]

    def ended(self, seen: Seen) -> Lease | None:
        """Return the lease if its run finished or failed in this sweep, else None."""
        lease = seen.lease
        return lease if lease and lease.end in ("finished", "failed") and lease.owner[2] == self._me[2] else None

    def is_free(self, seen: Seen) -> bool:
        """Return whether a run that has not ended may be taken: its owner is done with it, or has not renewed it for a term."""
        term = max(self._term, seen.lease.term if seen.lease else 0.0)
        return seen.number < 0 or bool(seen.lease and seen.lease.end) or time.monotonic() - seen.since >= term

    @contextlib.contextmanager
    def taken(self, run: str) -> Iterator["Held | None"]:
        """Take a run that was free when last looked at, and keep it until the block ends; None if another worker was faster."""
        path = self._folder / run / str(self._seen[run].number + 1)
        held = Held(path, Lease(self._me, 0, term=self._term))
        if not held.take():
            yield None
            return
        try:
            yield held
        finally:
            held.release()


class Held:
    """A lease that this process has, renewed by one thread. Another ends the process if that hangs, as a write to NFS can.

    Args:
        path: its file.
        lease: what it says at first.
    """

    def __init__(self, path: Path, lease: Lease):
        self._path, self._lease, self._term = path, lease, lease.term
        self._end = ("stopped", "")
        self._renewed = time.monotonic()  # when the last write that succeeded began
        self._done, self._thread = threading.Event(), threading.Thread(target=self._renew, daemon=True)
        self._released, self._watch = threading.Event(), threading.Thread(target=self._end_if_late, daemon=True)

    def take(self) -> bool:
        """Make the file; return False if another worker has made it."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        own = self._path.with_name(f".{self._path.name}-{uuid.uuid4().hex}")
        own.write_text(_written(self._lease))
        try:
            os.link(own, self._path)
        except FileExistsError:
            return False
        finally:
            own.unlink(missing_ok=True)
        self._thread.start()
        self._watch.start()
        return True

    def end(self, how: str, reason: str = "") -> None:
        """Say how the work on the run ended: "finished", or "failed" for a reason; else it counts as stopped."""
        self._end = (how, reason)

    def release(self) -> None:
        """Renew it no longer, and let others know. An owner that was taken for dead ends its process here."""
        self._done.set()
        self._thread.join()
        try:
            self._write(*self._end)
        finally:
            self._released.set()
            self._watch.join()

    def _renew(self) -> None:
        while not self._done.wait(self._term / RENEWALS):
            begun = time.monotonic()
            with contextlib.suppress(OSError):
                self._write()
                self._renewed = begun

    def _end_if_late(self) -> None:
        while not self._released.wait(self._term / (2 * RENEWALS)):
            if time.monotonic() - self._renewed > self._term * (1 - 1 / RENEWALS):
                os._exit(LOST)

    def _write(self, end: str = "", reason: str = "") -> None:
        if self._path.with_name(str(int(self._path.name) + 1)).exists():
            os._exit(LOST)
        self._lease = self._lease._replace(renewals=self._lease.renewals + 1, end=end, reason=reason)
        files.write(self._path, _written(self._lease).encode())


def _written(lease: Lease) -> str:
    return json.dumps(lease._asdict()) + "\n"


def _read(path: Path) -> Lease | None:
    """Return what a lease says; None if it cannot be read at this moment."""
    try:
        content = json.loads(path.read_text())
        host, process, sweep = content["owner"]
        return Lease(
            (str(host), int(process), str(sweep)),
            int(content["renewals"]),
            str(content["end"]),
            str(content["reason"]),
            float(content.get("term", 0.0)),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None

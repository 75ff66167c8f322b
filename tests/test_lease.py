"""Leases: one owner at a time, what dead owners had is taken over, and an owner that was taken for dead ends."""

import multiprocessing
import os
import signal
import threading
import time

import pytest

from fleetjax.io import files
from fleetjax.io.lease import LOST, Leases

RUN = "navigation-cur-seed0"
LONG, SOME, OWNERS, SHORT = 1000.0, 6.0, 2.0, 0.5  # seconds; SOME is renewed in time even on a busy machine


def test_a_run_has_one_owner_and_is_free_when_it_is_done_with_it(tmp_path):
    mine, other = Leases(tmp_path, "sweep", LONG), Leases(tmp_path, "sweep", LONG)
    assert mine.is_free(mine.look(RUN))
    assert other.is_free(other.look(RUN))
    with mine.taken(RUN) as held:
        assert held
        assert not other.is_free(other.look(RUN))
        assert other.ended(other.look(RUN)) is None
        held.end("failed", "disk full")
    assert other.ended(other.look(RUN)).reason == "disk full"
    later = Leases(tmp_path, "another sweep", LONG)
    assert later.ended(later.look(RUN)) is None
    assert later.is_free(later.look(RUN))


def test_of_many_that_try_one_gets_a_run(tmp_path):
    barrier, won, over = threading.Barrier(8), [], threading.Event()

    def claim():
        leases = Leases(tmp_path, "sweep", LONG)
        assert leases.is_free(leases.look(RUN))
        barrier.wait()
        with leases.taken(RUN) as held:
            won.append(bool(held))
            over.wait()

    threads = [threading.Thread(target=claim) for _ in range(8)]
    for thread in threads:
        thread.start()
    while len(won) < 8:
        time.sleep(1e-3)
    over.set()
    for thread in threads:
        thread.join()
    assert sorted(won) == [False] * 7 + [True]
    assert [path.name for path in (tmp_path / RUN).iterdir()] == ["0"]


def test_an_owner_that_renews_keeps_its_run_for_longer_than_a_term(tmp_path, monkeypatch):
    monkeypatch.setattr(files.os, "fsync", lambda _: None)  # which may take longer than a term on a busy disk
    mine, other = Leases(tmp_path, "sweep", SOME), Leases(tmp_path, "sweep", SOME)
    assert mine.is_free(mine.look(RUN))
    with mine.taken(RUN):
        until = time.monotonic() + 1.5 * SOME
        while time.monotonic() < until:
            assert not other.is_free(other.look(RUN))
            time.sleep(SHORT / 20)
    assert other.is_free(other.look(RUN))


def own(folder, begun, hangs):
    """Take the run in another process; if `hangs`, writing to the disk never comes back."""
    leases = Leases(folder, "sweep", OWNERS)
    assert leases.is_free(leases.look(RUN))
    files.os.fsync = lambda _: None
    with leases.taken(RUN):
        if hangs:
            files.os.fsync = lambda _: time.sleep(LONG)
        begun.set()
        time.sleep(LONG)


def test_an_owner_whose_disk_hangs_ends_within_its_term(tmp_path):
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    process = context.Process(target=own, args=(tmp_path, begun, True))
    process.start()
    begun.wait()
    process.join()
    assert process.exitcode == LOST
    assert not (tmp_path / RUN / "1").exists()


def test_a_worker_with_a_shorter_term_waits_for_the_owners(tmp_path):
    owner, other = Leases(tmp_path, "sweep", LONG), Leases(tmp_path, "sweep", 1e-3)
    assert owner.is_free(owner.look(RUN))
    with owner.taken(RUN):
        assert not other.is_free(other.look(RUN))
        time.sleep(0.1)
        assert not other.is_free(other.look(RUN))


@pytest.mark.parametrize("alive", [False, True])
def test_a_dead_owner_loses_its_run_and_one_taken_for_dead_ends(tmp_path, alive):
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    process = context.Process(target=own, args=(tmp_path, begun, False))
    process.start()
    begun.wait()
    assert process.pid
    os.kill(process.pid, signal.SIGSTOP if alive else signal.SIGKILL)
    leases = Leases(tmp_path, "sweep", SHORT)
    assert not leases.is_free(leases.look(RUN))
    while not leases.is_free(leases.look(RUN)):
        time.sleep(SHORT / 20)
    with leases.taken(RUN) as held:
        assert held
        if alive:
            os.kill(process.pid, signal.SIGCONT)
            process.join()
            assert process.exitcode == LOST
    assert sorted(os.listdir(tmp_path / RUN)) == ["0", "1"]

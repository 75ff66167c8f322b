"""The processes that run one fleet together: how they meet, agree, and notice that one of them is gone.

JAX's coordination service connects them, gloo carries what CPU devices exchange. Process 0 leads: it alone writes to the run
folder, but for checkpoints, of which each process writes its share.
"""

import atexit
import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax._src import distributed  # whose store of keys and values has no public name
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from fleetjax.io import files
from fleetjax.io.errors import Refusal

LARGEST = 2**16  # bytes that processes tell each other at once
INTERVAL = 2.0  # seconds between two signs of life
SILENCE = 30.0  # seconds without a sign after which a process is gone
LEAVING = 20.0  # seconds that process 0 waits at its end for the others to leave


class Meeting(NamedTuple):
    """Where the processes meet.

    Attributes:
        coordinator: HOST:PORT of process 0; None = what JAX finds in the environment, as under SLURM.
        num_processes: P, or None.
        process_id: which of them this one is, from 0; or None.
        timeout: seconds to wait for the others.
    """

    coordinator: str | None
    num_processes: int | None
    process_id: int | None
    timeout: int


def join(meeting: Meeting) -> None:
    """Meet the other processes. A single one needs no meeting.

    Raises:
        ValueError: if the meeting cannot be held as described.
        Refusal: if the others do not come in time.
    """
    given = (meeting.coordinator, meeting.num_processes, meeting.process_id)
    if meeting.num_processes == 1 and meeting.process_id in (None, 0):
        return
    if any(value is None for value in given) and any(value is not None for value in given):
        raise ValueError("give --coordinator, --num-processes and --process-id together, or none of them under SLURM")
    if meeting.num_processes is not None and not 0 <= (meeting.process_id or 0) < meeting.num_processes:
        raise ValueError(f"--process-id {meeting.process_id} must be from 0 to {meeting.num_processes - 1}")
    if meeting.coordinator is not None:
        host, _, port = meeting.coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(f"--coordinator {meeting.coordinator} must be HOST:PORT")
        if meeting.process_id:
            _knock(host, int(port), meeting.timeout)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_recoverability", True)  # else JAX ends this process when another one fails, with a trace
    where = f"at {meeting.coordinator}" if meeting.coordinator else "in this environment; give --coordinator HOST:PORT"
    message = f"the processes did not meet within {meeting.timeout} s {where}"
    with _within(meeting.timeout, message):
        try:
            # When its own timeouts are over, JAX aborts the process.
            jax.distributed.initialize(*given, initialization_timeout=meeting.timeout + 60, shutdown_timeout_seconds=10)
        except Exception as error:  # of many kinds, by what is missing
            raise Refusal(f"{message} ({files.one_line(error)})") from error
    if leads():
        atexit.register(_leave_last)  # before JAX's own end, which was registered first


def _leave_last() -> None:
    """Wait until the other processes have left. This one holds what connects them: without it JAX aborts them as they leave."""
    others_leave = threading.Thread(target=_wait_for_the_others, daemon=True)
    others_leave.start()
    others_leave.join(LEAVING)


def _wait_for_the_others() -> None:
    store = distributed.global_state.client
    with contextlib.suppress(jax.errors.JaxRuntimeError):
        if store is not None:
            store.get_live_nodes(list(range(jax.process_count())))  # answers as soon as all others ask as well, or have left


def _knock(host: str, port: int, timeout: int) -> None:
    """Wait until something listens.

    Raises:
        Refusal: if nothing does in time.
    """
    end = time.monotonic() + timeout
    while True:
        try:
            socket.create_connection((host, port), timeout=max(1.0, end - time.monotonic())).close()
            return
        except OSError as error:
            if time.monotonic() > end:
                reason = f"the coordinator {host}:{port} does not answer within {timeout} s"
                raise Refusal(f"{reason}; start process 0 there, or raise --connect-timeout") from error
            time.sleep(0.2)


def mesh() -> Mesh:
    """Return all devices of all processes in a row."""
    return Mesh(np.array(jax.devices()), ("robots",))


def leads() -> bool:
    """Return whether this is process 0."""
    return jax.process_index() == 0


def meet(why: str) -> None:
    """Wait for all processes."""
    multihost_utils.sync_global_devices(why)


def tell(content: Any) -> list[Any]:
    """Return what every process says, as JSON, by process."""
    data = json.dumps(content).encode()
    if len(data) > LARGEST:
        raise ValueError(f"{len(data)} bytes are too many to tell")
    row = np.zeros(LARGEST, np.uint8)
    row[: len(data)] = np.frombuffer(data, np.uint8)
    rows = np.atleast_2d(multihost_utils.process_allgather(row))
    return [json.loads(bytes(row).rstrip(b"\0")) for row in rows]


def check_agreement(facts: Mapping[str, Any]) -> None:
    """Check that all processes run the same.

    Args:
        facts: plain values by name.

    Raises:
        ValueError: naming the first that differs, and whose.
    """
    first, *others = tell(facts)
    for process, found in enumerate(others, start=1):
        for name in first | found:
            if first.get(name) != found.get(name):
                raise ValueError(
                    f"{name} = {found.get(name)} in process {process}, but {first.get(name)} in process 0; "
                    "start all processes with the same arguments and versions"
                )


def led(decide: Callable[[], Any]) -> Any:
    """Return what the leader decides, in every process.

    Raises:
        Refusal: in every process, with what the leader's decision raised.
    """
    said, error = {}, None
    if leads():
        try:
            said = {"value": decide()}
        except (ValueError, OSError, Refusal) as raised:
            said, error = {"error": str(raised)}, raised
    answer = tell(said)[0]
    if error or "error" in answer:
        raise Refusal(answer["error"]) from error
    return answer["value"]


@contextlib.contextmanager
def watched(timeout: int, how_to_resume: str) -> Iterator[Callable[[], None]]:
    """Yield a function to call as the run proceeds. Without a call for `timeout` seconds, or if another process is gone, end.

    What ends this process is one line on stderr and exit code 1. JAX's own shutdown would wait for the others, and then abort.
    """
    last, over, signs = time.monotonic(), threading.Event(), _Signs()

    def beat() -> None:
        nonlocal last
        last = time.monotonic()

    def watch() -> None:
        while not over.wait(INTERVAL):
            lost = signs.exchange()
            if lost is not None and not over.is_set():
                _end(f"process {lost} is gone; {how_to_resume}")
            if time.monotonic() - last > timeout and not over.is_set():
                _end(f"no progress for {timeout} s: a process hangs, or --step-timeout is too short; {how_to_resume}")

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield beat
    except (jax.errors.JaxRuntimeError, ConnectionError) as error:
        if jax.process_count() == 1:
            raise
        _end(f"another process is probably gone ({files.one_line(error)}); {how_to_resume}")
    finally:
        over.set()


class _Signs:
    """Signs of life, a number from each process that grows, in the store of JAX's coordination service."""

    def __init__(self):
        self._store = distributed.global_state.client
        self._sent = 0
        self._heard = {process: (-1, time.monotonic()) for process in range(jax.process_count())}

    def exchange(self) -> int | None:
        """Give a sign, and return a process that has given none for `SILENCE` seconds; None = all have."""
        if self._store is None:
            return None
        try:
            self._sent += 1
            self._store.key_value_set(f"fleetjax/{jax.process_index()}", str(self._sent), allow_overwrite=True)
            signs = {name.split("/")[-1]: int(sign) for name, sign in self._store.key_value_dir_get("fleetjax/")}
        except jax.errors.JaxRuntimeError:
            return 0  # which holds the store
        now = time.monotonic()
        for process, (sign, _) in self._heard.items():
            found = signs.get(str(process), -1)
            if found != sign:
                self._heard[process] = (found, now)
        silent = [process for process, (_, when) in self._heard.items() if now - when > SILENCE]
        return silent[0] if silent else None


@contextlib.contextmanager
def _within(seconds: int, message: str) -> Iterator[None]:
    """End this process with a message if the block takes longer. It may hang in code that cannot be interrupted."""
    timer = threading.Timer(seconds, _end, (message, 2))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _end(message: str, code: int = 1) -> None:
    print(f"fleetjax: {message}", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(code)

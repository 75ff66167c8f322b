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
TICK = 0.5  # seconds between two looks at the others
INTERVAL = 2.0  # seconds between two signs of life
SILENCE = 30.0  # seconds without a sign after which a process is gone
LEAVING = 20.0  # seconds that process 0 waits at its end for the others to leave

_leader_left = threading.Event()  # process 0 has closed its connection to this process
_ending = threading.Lock()  # whoever holds it ends this process, and alone says why


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
    if meeting.timeout < 1:
        raise ValueError(f"--connect-timeout {meeting.timeout} must be at least 1 second")
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
            given = (_relayed(host, int(port)), *given[1:])
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_recoverability", True)  # else JAX ends this process when another one fails, with a trace
    where = f"at {meeting.coordinator}" if meeting.coordinator else "in this environment"
    remedy = "raise --connect-timeout" if meeting.coordinator else "give --coordinator HOST:PORT"
    message = f"the processes did not meet within {meeting.timeout} s {where}; start all of them, or {remedy}"
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


def _relayed(host: str, port: int) -> str:
    """Return an address on this machine where a thread passes on what JAX and the coordinator say to each other.

    JAX aborts a process whose connection to the coordinator breaks, with a trace. The relay hears of that first, and lets
    `watched` end the process with a message.
    """
    listener = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=_accept, args=(listener, host, port), daemon=True).start()
    return f"127.0.0.1:{listener.getsockname()[1]}"


def _accept(listener: socket.socket, host: str, port: int) -> None:
    while True:
        here, _ = listener.accept()
        try:
            there = socket.create_connection((host, port))
        except OSError:
            here.close()
            continue
        left = threading.Event()  # JAX has closed its end
        for carry in (_carry_there, _carry_here):
            threading.Thread(target=carry, args=(here, there, left), daemon=True).start()


def _carry_there(here: socket.socket, there: socket.socket, left: threading.Event) -> None:
    _carry(here, there)
    left.set()
    _hang_up(here, there)


def _carry_here(here: socket.socket, there: socket.socket, left: threading.Event) -> None:
    _carry(there, here)
    if not left.is_set():
        _leader_left.set()
        left.wait(SILENCE)  # JAX sees a silent connection, not a broken one
    _hang_up(here, there)


def _carry(source: socket.socket, target: socket.socket) -> None:
    """Pass on what comes until the source is closed. What the target no longer takes is dropped."""
    target.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with contextlib.suppress(OSError):
        while data := source.recv(LARGEST):
            with contextlib.suppress(OSError):
                target.sendall(data)


def _hang_up(*ends: socket.socket) -> None:
    for end in ends:
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


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


def check_step_timeout(timeout: int) -> None:
    """Check the seconds after which a run that stands still is ended.

    Raises:
        ValueError: if they are none.
    """
    if timeout < 1:
        raise ValueError(f"--step-timeout {timeout} must be at least 1 second")


@contextlib.contextmanager
def watched(timeout: int, how_to_resume: str) -> Iterator[Callable[[], None]]:
    """Yield a function to call as the run proceeds. Without a call for `timeout` seconds, or if another process is gone, end.

    What ends this process is one line on stderr and exit code 1. JAX's own shutdown would wait for the others, and then abort.
    """
    still, over, signs = 0.0, threading.Event(), _Signs()

    def beat() -> None:
        nonlocal still
        still = 0.0

    def watch() -> None:
        nonlocal still
        while not over.wait(TICK):
            still += TICK  # counted, not timed: a process that was suspended for a while goes on
            lost = 0 if _leader_left.is_set() else signs.missing()
            if lost is not None and not over.is_set():
                _end(f"process {lost} is gone; {how_to_resume}")
            if still > timeout and not over.is_set():
                _end(f"no progress for {timeout} s: a process hangs, or --step-timeout is too short; {how_to_resume}")

    for work in (watch, lambda: signs.exchange(over)):
        threading.Thread(target=work, daemon=True).start()
    try:
        yield beat
    except Exception as error:
        if jax.process_count() == 1 or not _is_of_exchange(error):
            raise
        _end(f"another process is probably gone ({files.one_line(error)}); {how_to_resume}")
    finally:
        over.set()


def _is_of_exchange(error: Exception) -> bool:
    """Return whether processes failed to exchange something. JAX raises what gloo reports as errors of several types."""
    return isinstance(error, (jax.errors.JaxRuntimeError, ConnectionError)) or "Gloo" in str(error)


class _Signs:
    """Signs of life, a number from each process that grows. Process 0 holds their store, that of JAX's coordination service."""

    def __init__(self):
        self._store = distributed.global_state.client
        self._own = jax.process_index()
        self._signs = dict.fromkeys(range(jax.process_count()), -1)
        self._silence = dict.fromkeys(self._signs, 0.0)  # seconds since the last sign of each process

    def exchange(self, over: threading.Event) -> None:
        """Give signs and hear those of the others, until it is over. This waits as long as process 0 hangs."""
        sent = 0
        while self._store is not None and not over.wait(INTERVAL):
            sent += 1
            with contextlib.suppress(jax.errors.JaxRuntimeError):
                self._store.key_value_set(f"fleetjax/{self._own}", str(sent), allow_overwrite=True)
                for name, sign in self._store.key_value_dir_get("fleetjax/"):
                    self._hear(int(name.split("/")[-1]), int(sign))

    def _hear(self, process: int, sign: int) -> None:
        if self._signs[process] != sign:
            self._signs[process], self._silence[process] = sign, 0.0

    def missing(self) -> int | None:
        """Return a process that has given no sign for `SILENCE` seconds; None = all have. Call this every `TICK` seconds."""
        if self._store is None:
            return None
        for process in self._silence:
            self._silence[process] += TICK
        unheard = self._silence[self._own]  # even this process's own sign: the store does not answer
        if unheard > SILENCE:
            return 0
        return next((process for process, silence in self._silence.items() if silence - unheard > SILENCE), None)


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
    _ending.acquire()  # for ever
    print(f"fleetjax: {message}", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(code)

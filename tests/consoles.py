"""How tests run consoles: small fleets, compiled once for all tests of a process, and served from a thread."""

import asyncio
import contextlib
import json
import threading
from collections.abc import Iterator, Sequence
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import jax
from websockets.sync.client import ClientConnection, connect

import fleetjax
from fleetjax import envs
from fleetjax.console import engine, server
from fleetjax.console.session import Session
from fleetjax.io import folder

SMALL: dict[str, Any] = {
    "num_robots": 4,
    "num_humans": 2,
    "num_steps": 60,
    "hard_reset_time": 2,
    "initial_period": 0,
    "uncertainty_threshold": 0.0,
    "hidden_sizes": (8,),
    "ensemble_size": 2,
    "batch_size": 8,
    "gradient_steps": 1,
    "critic_capacity": 300,
    "num_demonstrations": 20,
    "pretraining_steps": 5,
    "num_critic_transitions": 20,
    "critic_pretraining_steps": 5,
}
_compile = engine.compile_programs
_compiled: dict[Any, engine.Programs] = {}


def flags() -> list[str]:
    """Return the small fleet as flags of the command line."""
    words = []
    for name, value in SMALL.items():
        words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value])]
    return words


def compile_once(config: fleetjax.Config, env: envs.Env, num_pictures: Sequence[int]) -> engine.Programs:
    """Return the programs of a console; those of another with the same static fields and pictures, if there was one."""
    key = (jax.tree.structure(config), env.spec.name, tuple(num_pictures))
    if key not in _compiled:
        if not num_pictures:  # a replay takes the session's programs, without the pictures
            for (structure, name, _), programs in _compiled.items():
                if (structure, name) == key[:2]:
                    return programs
        _compiled[key] = _compile(config, env, num_pictures)
    return _compiled[key]


def make_config(environment: str = "navigation", algorithm: str = "cur", **changes: Any) -> fleetjax.Config:
    return fleetjax.make_config(environment, algorithm, **SMALL | changes)


class Served:
    """A console that runs in a thread.

    Attributes:
        session: its run.
        console: its server.
        port: where it listens.
    """

    def __init__(self, session: Session, options: server.Options):
        self.session, self.console = session, server.Console(session, options)
        listener = server.listen(options.host, 0)
        self.port: int = listener.getsockname()[1]
        self.ready = threading.Event()
        self.failure: BaseException | None = None

        def run() -> None:
            try:
                asyncio.run(self.console.run(listener, ready=self.ready.set, show=lambda metrics: None))
            except BaseException as error:
                self.failure = error
                self.ready.set()

        self.thread = threading.Thread(target=run)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def get(self, path: str, **headers: str) -> HTTPResponse:
        """Return the answer to a request, read."""
        connection = HTTPConnection("127.0.0.1", self.port)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
            answer = connection.getresponse()
            answer.body = answer.read()  # type: ignore[attr-defined]
            return answer

    def page(self, kind: str = "operator", **options: Any) -> ClientConnection:
        """Open a WebSocket as a page of this console does."""
        headers = {"Origin": self.url} | options.pop("additional_headers", {})
        return connect(
            f"ws://127.0.0.1:{self.port}/ws/{kind}", additional_headers=headers, proxy=None, compression=None, **options
        )

    def stop(self) -> None:
        """End the session, and wait for it."""
        self.console.stop()
        self.thread.join()
        if self.failure:
            raise self.failure


@contextlib.contextmanager
def serving(session: Session, **changes: Any) -> Iterator[Served]:
    """Serve a session until the block ends."""
    usual = {"host": "127.0.0.1", "port": 0, "token": None, "interval": 0.02, "timeout": 60.0, "wait": 0, "simulated": False}
    served = Served(session, server.Options(**usual | changes))
    served.thread.start()
    served.ready.wait()
    try:
        yield served
    finally:
        served.stop()


def make_session(path: Path, **changes: Any) -> Session:
    path.mkdir(parents=True, exist_ok=True)
    return Session(folder.Run(path, make_config(**changes), 0))


def say(page: ClientConnection, **message: Any) -> None:
    page.send(json.dumps(message))


def hear(page: ClientConnection, *kinds: str) -> dict[str, Any]:
    """Return the next message of one of these kinds."""
    while True:
        message = json.loads(page.recv(timeout=60))
        if message["type"] in kinds:
            return message


def claim(page: ClientConnection, key: str = "", seat: int = -1) -> dict[str, Any]:
    """Ask for a seat; return the answer."""
    say(page, type="claim", key=key, seat=seat)
    return hear(page, "seat", "taken")

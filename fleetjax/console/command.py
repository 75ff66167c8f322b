"""What `fleetjax console` does, behind the command line: checks first, then a session."""

import asyncio
import contextlib
import importlib.util
import math
import socket
import time
from typing import TYPE_CHECKING

from fleetjax import envs
from fleetjax.config import Config
from fleetjax.console import controls
from fleetjax.io import folder, text
from fleetjax.io.errors import Diverged
from fleetjax.io.progress import progress, say
from fleetjax.io.resumable import seal, unbegun
from fleetjax.metrics import Metrics

if TYPE_CHECKING:  # the rest is imported once it is known to be installed
    from fleetjax.console.server import Options

NEEDED = ("starlette", "uvicorn", "websockets")


def check(config: Config, *, host: str, port: int, token: str | None, interval: float, timeout: float, wait: int) -> None:
    """Check all that was asked for before anything is computed.

    Raises:
        ValueError: if it cannot be used.
    """
    controls.check_people(config)
    controls.controls_of(envs.make(config.environment, config.backend))
    if any(importlib.util.find_spec(name) is None for name in NEEDED):
        raise ValueError('the console needs a web server; run pip install ".[console]" in the source folder')
    from fleetjax.console import guard

    guard.check_address(host, token)
    if not 0 <= port <= 65535:
        raise ValueError(f"port = {port} must be in [0, 65535]; 0 takes any free port")
    if not (math.isfinite(interval) and interval >= 0):
        raise ValueError(f"interval = {interval} must be at least 0 seconds")
    if not (math.isfinite(timeout) and timeout > 0):
        raise ValueError(f"timeout = {timeout} must be more than 0 seconds")
    if not 0 <= wait <= config.num_humans:
        raise ValueError(f"wait = {wait} must be in [0, {config.num_humans}], the number of seats")


def supervise(run: folder.Run, options: "Options", listener: socket.socket) -> Metrics:
    """Run a console in a folder that is locked. An older run in it is deleted at the first timestep.

    Args:
        run: the run.
        options: how it is served.
        listener: bound socket.

    Returns:
        Metrics[t].

    Raises:
        Diverged: if something learnt is no longer finite; what there is, is kept.
        KeyboardInterrupt: if it was stopped before the first timestep.
    """
    from fleetjax.console import server
    from fleetjax.console.session import Session

    begun = time.monotonic()
    new = folder.prepare(run)
    say(f"{text.headline(run.config, run.seed)}: compiling and preparing ...")
    try:
        session = Session(run)
    except KeyboardInterrupt:
        raise unbegun(run, new=new) from None

    def ready() -> None:
        address = server.address_of(listener, options)
        say(f"ready after {text.duration(time.monotonic() - begun)}; Ctrl-C ends the session. Open {address}")

    with contextlib.closing(session):
        try:
            with progress(run.config) as show:
                asyncio.run(server.Console(session, options).run(listener, ready=ready, show=show))
        except (KeyboardInterrupt, Diverged):
            if not session.metrics:
                raise unbegun(run, new=new) from None
            seal(run, session.complete())
            raise
        if not session.metrics:
            raise unbegun(run, new=new)
        metrics = session.complete()
        seal(run, metrics)
    return metrics

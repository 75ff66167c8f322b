"""The web server of a console: pages, WebSockets, and the clock that takes one timestep after the other.

Seats are only touched by the event loop's thread, the fleet only by a worker's. No timestep waits for a client: each has a
mailbox that keeps the newest state, and a task of its own that sends it.
"""

import asyncio
import contextlib
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from fleetjax.console import controls, messages, pages
from fleetjax.console.engine import View
from fleetjax.console.guard import Guard
from fleetjax.console.seats import Refused, Seats
from fleetjax.console.session import Session
from fleetjax.metrics import Metrics
from fleetjax.types import EnvState

STATIC = Path(__file__).parent / "static"
MOST_CLIENTS = 1000
MOST_MESSAGES = 200  # of one client in a timestep
MOST_ERRORS = 20  # of one client
BETWEEN_PAINTINGS = 0.2  # seconds, at least, between two pictures of the fleet
GOODBYE = 1.0  # seconds that clients get for the last message


class Options(NamedTuple):
    """How a console is run.

    Attributes:
        host: address that is served.
        port: 0 = any free one.
        token: what every page needs; None = no token.
        interval: seconds per timestep.
        timeout: seconds of silence after which a seat is free.
        wait: people to wait for before the first timestep.
        simulated: whether the simulated supervisor plays seats that nobody takes.
    """

    host: str
    port: int
    token: str | None
    interval: float
    timeout: float
    wait: int
    simulated: bool


class Client:
    """An open page, and what it is still to be sent: notices in order, and of states the newest."""

    def __init__(self, kind: str):
        self.kind = kind
        self.notices: deque[str] = deque(maxlen=32)
        self.state: str | None = None
        self.closing: tuple[int, str] | None = None
        self.heard = self.errors = 0
        self._wake = asyncio.Event()

    def tell(self, content: dict[str, Any]) -> None:
        """Leave a notice."""
        self.notices.append(pages.to_json(content))
        self._wake.set()

    def show(self, state: str) -> None:
        """Leave a state; an older one that was not sent goes."""
        self.state = state
        self._wake.set()

    def close(self, code: int, reason: str) -> None:
        """Close the connection once all is sent."""
        self.closing = (code, reason)
        self._wake.set()

    def _next(self) -> str | None:
        """Take what is to be sent next."""
        if self.notices:
            return self.notices.popleft()
        state, self.state = self.state, None
        return state

    async def deliver(self, socket: WebSocket) -> None:
        """Send what is left here, until the connection ends."""
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
            while True:
                await self._wake.wait()
                self._wake.clear()
                while (text := self._next()) is not None:
                    await socket.send_text(text)
                if self.closing:
                    await socket.close(*self.closing)
                    return


class Console:
    """A session that is served.

    Args:
        session: the run.
        options: how it is served.
    """

    def __init__(self, session: Session, options: Options):
        self.session, self.options = session, options
        self.seats = Seats(session.config.num_humans, simulated=options.simulated, timeout=options.timeout)
        self.clients: set[Client] = set()
        self.tick = 0
        self._introduction = pages.introduction(session, options.interval)
        self._controls = controls.controls_of(session.env)
        self._painting: asyncio.Task[None] | None = None
        self._next_painting = 0.0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()

    def app(self) -> ASGIApp:
        """Return the guarded web application."""
        names = {"/": "index.html", "/operator": "operator.html", "/fleet": "fleet.html"}
        routes = [
            *(Route(path, _page(name), methods=["GET"]) for path, name in names.items()),
            Mount("/static", StaticFiles(directory=STATIC)),
            WebSocketRoute("/ws/operator", lambda socket: self._serve(socket, "operator")),
            WebSocketRoute("/ws/fleet", lambda socket: self._serve(socket, "fleet")),
        ]
        return Guard(Starlette(routes=routes), self.options.host, self.options.token)

    def stop(self) -> None:
        """End the session after the timestep that is under way; any thread may call it."""
        if self._loop:
            self._loop.call_soon_threadsafe(self._stop.set)

    # Clients

    async def _serve(self, socket: WebSocket, kind: str) -> None:
        """Talk with one page until it goes."""
        if len(self.clients) >= MOST_CLIENTS:
            await socket.close(1013, "too many pages are open")
            return
        await socket.accept()
        client = Client(kind)
        self.clients.add(client)
        sending = asyncio.create_task(client.deliver(socket))
        client.tell({"type": "hello", **self._introduction})
        try:
            while (message := await socket.receive())["type"] == "websocket.receive":
                self._hear(client, message.get("text"))
        finally:
            self.clients.discard(client)
            self.seats.drop(client, self._now())
            sending.cancel()

    def _hear(self, client: Client, text: str | None) -> None:
        """Do what a page asks for, or tell it why not; one that is being closed is no longer heard."""
        if client.closing:
            return
        client.heard += 1
        if client.heard > MOST_MESSAGES:
            client.close(1008, "too many messages")
            return
        try:
            if text is None:
                raise ValueError("messages must be text")
            message = messages.parse(text)
            if client.kind != "operator" and not isinstance(message, messages.Seen):
                raise ValueError("this page only watches")
            self._do(client, message)
        except Refused as refusal:
            client.tell({"type": "refused", "reason": str(refusal)})
        except ValueError as error:
            client.errors += 1
            client.tell({"type": "error", "reason": str(error)})
            if client.errors >= MOST_ERRORS:
                client.close(1008, "too many malformed messages")

    def _do(self, client: Client, message: messages.Message) -> None:
        """Do what a page asks for.

        Raises:
            Refused: if it is not possible.
            ValueError: if it makes no sense.
        """
        match message:
            case messages.Claim():
                self._claim(client, message)
            case messages.Act():
                action = controls.action_of(self._controls, message.held)
                self.seats.act(client, message.robot, message.since, self.tick - message.tick, action)
            case messages.Reset():
                self.seats.confirm(client, message.robot, message.since)
            case messages.Leave():
                self.seats.leave(client)
                client.tell({"type": "left"})
        self.seats.hear(client, self._now())

    def _claim(self, client: Client, message: messages.Claim) -> None:
        try:
            wish = message.seat if message.seat >= 0 else None
            seat, key, before = self.seats.claim(client, self._now(), key=message.key, seat=wish)
        except Refused as refusal:
            free = [i for i, seat in enumerate(self.seats.seats) if not seat.key]
            client.tell({"type": "taken", "reason": str(refusal), "free": free})
            return
        client.tell({"type": "seat", "seat": seat, "key": key})
        if isinstance(before, Client):
            before.tell({"type": "replaced"})
            before.close(1000, "open elsewhere")

    def _now(self) -> float:
        return asyncio.get_running_loop().time()

    # The clock

    async def run(self, listener: socket.socket, *, ready: Callable[[], None], show: Callable[[Metrics], None]) -> None:
        """Serve, and take all timesteps, or as many as there are until it is stopped.

        Args:
            listener: bound socket.
            ready: called when pages can be opened.
            show: called with the Metrics[1] of each timestep.
        """
        self._loop = asyncio.get_running_loop()
        config = uvicorn.Config(
            self.app(),
            ws="websockets-sansio",
            ws_max_size=messages.LONGEST,
            ws_ping_interval=max(1.0, self.options.timeout / 2),
            ws_ping_timeout=max(1.0, self.options.timeout),
            ws_per_message_deflate=False,
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=2,
        )
        server = _Server(config)
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        try:
            with self._signals():
                while not server.started and not serving.done():
                    await asyncio.sleep(0.01)
                ready()
                await self._tick_on(show)
                await self._say_goodbye()
        finally:
            server.should_exit = True
            await serving

    async def _tick_on(self, show: Callable[[Metrics], None]) -> None:
        """Take timesteps at the pace that was asked for, or as fast as they go."""
        worker = ThreadPoolExecutor(1)
        in_worker = lambda *args: asyncio.get_running_loop().run_in_executor(worker, *args)  # noqa: E731
        session = self.session
        try:
            await self._wait_for_people()
            due = self._now()
            while not session.over and not self._stop.is_set():
                self._expire()
                kinds = self.seats.kinds()
                view = await in_worker(session.begin, kinds)
                self.tick = view.timestep
                self.seats.assign(view, kinds)
                await self._show_operators(view, in_worker)
                self._show_watchers(view, kinds)
                due = max(due + self.options.interval, self._now())
                await self._sleep(due)
                inputs = self.seats.collect(kinds, session.env.spec.action_size)
                show(await in_worker(session.finish, inputs))
            if self._painting:
                await self._painting
        finally:
            worker.shutdown()

    async def _wait_for_people(self) -> None:
        while not self._stop.is_set():
            self._expire()
            there = sum(bool(seat.key) for seat in self.seats.seats)
            if there >= self.options.wait:
                return
            state = pages.to_json({"type": "waiting", "people": there, "wanted": self.options.wait})
            for client in self.clients:
                client.show(state)
                client.heard = 0
            await self._pause(min(0.5, self.options.timeout / 3))

    async def _sleep(self, due: float) -> None:
        """Wait until a moment, or until it is stopped. Operators are shown long timesteps again, so that they answer."""
        while not self._stop.is_set() and (left := due - self._now()) > 0:
            await self._pause(min(left, self.options.timeout / 3))
            if left > self.options.timeout / 3:
                for client in self.clients:
                    client.tell({"type": "ping"})

    async def _pause(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._stop.wait(), seconds)

    def _expire(self) -> None:
        for client in self.seats.expire(self._now()):
            if isinstance(client, Client):
                client.tell({"type": "expired"})

    async def _show_operators(self, view: View, in_worker: Callable[..., Any]) -> None:
        """Leave everyone in a seat what they are to see of a timestep."""
        robots = {seat.robot for seat in self.seats.seats if seat.client} - {-1}
        pictures = await in_worker(pages.portraits, self.session, robots)
        for number, seat in enumerate(self.seats.seats):
            if isinstance(seat.client, Client):
                seat.client.show(pages.to_json(pages.operator(self.session, view, number, seat, pictures)))
        for client in self.clients:
            client.heard = 0

    def _show_watchers(self, view: View, kinds: np.ndarray) -> None:
        """Begin to draw the fleet for those who watch, unless it was begun a moment ago; no timestep waits for it."""
        if self._painting and self._painting.done():
            self._painting.result()  # an error, if there was one
            self._painting = None
        if self._painting or self._now() < self._next_painting or not any(c.kind == "fleet" for c in self.clients):
            return
        self._next_painting = self._now() + BETWEEN_PAINTINGS
        confirmed = [seat.confirmed for seat in self.seats.seats]
        self._painting = asyncio.create_task(self._paint(view, kinds, confirmed, self.session.engine.state.env))

    async def _paint(self, view: View, kinds: np.ndarray, confirmed: list[bool], env: EnvState) -> None:
        def draw() -> str:
            return pages.to_json(pages.fleet(self.session, view, kinds, confirmed, pages.tiles(self.session, env, view)))

        state = await asyncio.to_thread(draw)
        for client in self.clients:
            if client.kind == "fleet":
                client.show(state)

    async def _say_goodbye(self) -> None:
        """Tell every page that it is over, and give them a moment to hear it."""
        for client in self.clients:
            client.tell({"type": "over", "tick": len(self.session.metrics)})
            client.close(1000, "the session is over")
        until = self._now() + GOODBYE
        while self.clients and self._now() < until:
            await asyncio.sleep(0.02)

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        """End the session on Ctrl-C and SIGTERM; a second one ends the process at once."""
        if threading.current_thread() is not threading.main_thread():  # which alone hears signals
            yield
            return
        loop = asyncio.get_running_loop()
        heard = (signal.SIGINT, signal.SIGTERM)

        def ask() -> None:
            self._stop.set()
            for number in heard:
                loop.remove_signal_handler(number)

        for number in heard:
            loop.add_signal_handler(number, ask)
        try:
            yield
        finally:
            for number in heard:
                loop.remove_signal_handler(number)


class _Server(uvicorn.Server):
    """Leaves signals to the console."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def _page(name: str) -> Callable[[Request], Response]:
    return lambda request: FileResponse(STATIC / name)


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that is bound, so that a port in use is known before anything is computed.

    Raises:
        OSError: if it cannot be bound.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise OSError(f"cannot serve {host}, port {port} ({error.strerror}); choose another --host or --port") from None
    return listener


def address_of(listener: socket.socket, options: Options) -> str:
    """Return what to type into a browser."""
    host = f"[{options.host}]" if ":" in options.host else options.host
    everywhere = options.host in ("0.0.0.0", "::")
    query = f"/?token={options.token}" if options.token else "/"
    return f"http://{socket.gethostname() if everywhere else host}:{listener.getsockname()[1]}{query}"

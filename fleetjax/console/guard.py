"""Who may talk to the console: checks of host, origin and token before anything else, and headers that keep pages safe."""

import hmac
import ipaddress
import re
import socket
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_TOKEN = re.compile(r"[A-Za-z0-9._~-]{8,128}")
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address.

    >>> is_loopback("localhost"), is_loopback("127.0.0.1"), is_loopback("0.0.0.0"), is_loopback("example.org")
    (True, True, False, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_address(host: str, token: str | None) -> None:
    """Check that an address may be served.

    Raises:
        ValueError: if others could reach it without a token, or the token is too short or not plain.
    """
    if token is None and not is_loopback(host):
        raise ValueError(f"host = {host!r} can be reached by other machines; pass --token TOKEN, which every page then needs")
    if token is not None and not _TOKEN.fullmatch(token):
        raise ValueError("token must have 8 to 128 letters, digits, or any of . _ ~ -")


class Guard:
    """Refuses requests that do not come from the console's own pages; wraps an ASGI application.

    Browsers let any site open WebSockets to any address, and a name can be made to point to 127.0.0.1. So the host that a
    request names must be this one's, and a WebSocket must come from a page of that same host.

    Args:
        app: what is guarded.
        host: the address that is served.
        token: what every page needs; None = no token.
    """

    def __init__(self, app: ASGIApp, host: str, token: str | None):
        self.app, self.token = app, token
        self.local = is_loopback(host)
        self.names = {host.lower(), "localhost"} | (
            set() if self.local else {socket.gethostname().lower(), socket.getfqdn().lower()}
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        answer = self._answer(scope)
        if answer is None:
            await self.app(scope, receive, send_safely)
        elif scope["type"] == "http":
            await answer(scope, receive, send_safely)
        else:
            await receive()  # the request to connect
            await send({"type": "websocket.close", "code": 1008})

    def _answer(self, scope: Scope) -> Response | None:
        """Return what a request gets instead of the page; None if nothing is wrong with it."""
        headers = Headers(scope=scope)
        if not self._is_here(headers.getlist("host")):
            return PlainTextResponse("This is not a host name of the console.\n", 421)
        if scope["type"] == "websocket" and not _same_host(headers.getlist("origin"), headers["host"]):
            return PlainTextResponse("WebSockets are for the console's own pages.\n", 403)
        if self.token is None:
            return None
        query = parse_qs(scope["query_string"].decode("latin-1"))
        if scope["type"] == "http" and "token" in query:
            return self._welcome(scope["path"], query, _cookie_name(headers))
        return None if self._is_token(_cookie(headers)) else _no_token()

    def _welcome(self, path: str, query: dict[str, list[str]], cookie: str) -> Response:
        """Return the page without the token in its address, and the token as a cookie."""
        if not self._is_token(query.pop("token")[-1]):
            return _no_token()
        rest = urlencode(query, doseq=True)
        # The path comes first, with one slash: two would name another host.
        answer = RedirectResponse("/" + path.lstrip("/") + (f"?{rest}" if rest else ""), 303)
        answer.set_cookie(cookie, self.token or "", httponly=True, samesite="lax")
        return answer

    def _is_token(self, given: str) -> bool:
        return self.token is not None and hmac.compare_digest(given.encode(), self.token.encode())

    def _is_here(self, hosts: list[str]) -> bool:
        """Return whether a request names this host, once. No other site's name can be an address."""
        try:
            name, _ = _parts(hosts[0]) if len(hosts) == 1 else ("", None)
            return name in self.names or is_loopback(name) or (not self.local and bool(ipaddress.ip_address(name)))
        except ValueError:
            return False


def _parts(host: str) -> tuple[str, int | None]:
    """Return the name and the port in a Host header.

    Raises:
        ValueError: if it has other parts, or the port is none.
    """
    parts = urlsplit(f"//{host}")
    if parts.netloc != host or "@" in host:
        raise ValueError("a host has a name and a port")
    return parts.hostname or "", parts.port


def _same_host(origins: list[str], host: str) -> bool:
    if len(origins) != 1:
        return False
    try:
        parts = urlsplit(origins[0])
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def _cookie_name(headers: Headers) -> str:
    """Return the name of the cookie; browsers send a host's cookies to all its ports."""
    _, port = _parts(headers["host"])
    return f"fleetjax-{port or ''}"


def _cookie(headers: Headers) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(_cookie_name(headers))
    except CookieError:
        return ""
    return found.value if found else ""


def _no_token() -> Response:
    return PlainTextResponse("This console needs its token: open the address with ?token=TOKEN once.\n", 403)

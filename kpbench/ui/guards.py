"""Which requests the application answers: those of its own pages, from a browser that was pointed at it by its address.

A page of another site may make a browser send requests here. Its requests name the other site: in ``Origin``, or, if
its domain leads to this machine (DNS rebinding), in ``Host``. Both are refused before anything is read.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import SplitResult, urlsplit

MOST_UPLOAD_BYTES = 256 * 2**20
"""Largest request."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'"
)
"""Content security policy: a page loads nothing from elsewhere, and no other page shows it in a frame."""
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address.

    Examples
    --------
    >>> from kpbench.ui.guards import is_loopback
    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0")
    (True, True, False)
    """
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _split(address: str) -> SplitResult:
    """Return the parts of an address; empty ones if it is none."""
    try:
        return urlsplit(address)
    except ValueError:
        return urlsplit("")


def refuse_reason(headers: dict[str, str], method: str, host: str) -> tuple[int, str] | None:
    """Return status and message for a request that is refused; None for one that is answered.

    Parameters
    ----------
    headers : dict of str to str
        By name in lower case.
    method : str
        "GET", "POST", …
    host : str
        Address that the server listens on. On a loopback address, only loopback names lead to the server; on others,
        also addresses and the name of this machine.

    Examples
    --------
    >>> from kpbench.ui.guards import refuse_reason
    >>> refuse_reason({"host": "evil.example:8000"}, "GET", "127.0.0.1")[0]
    421
    >>> refuse_reason({"host": "localhost:8000", "origin": "http://evil.example"}, "POST", "127.0.0.1")[0]
    403
    """
    asked = headers.get("host", "")
    name = _split(f"//{asked}").hostname or ""
    is_own = _is_address(name) or name == socket.gethostname().lower()
    if not (is_loopback(name) or (is_own and not is_loopback(host))):
        return 421, f"Host is {asked[:80]!r}, expected the address that kpbench printed"
    origin = headers.get("origin")
    if origin is not None and _split(origin).netloc != asked:
        return 403, f"Origin is {origin[:80]!r}, expected a page of {asked}"
    length = headers.get("content-length", "")
    if method not in ("GET", "HEAD", "OPTIONS") and not length.isdecimal():
        return 411, "a request without its length"
    if length.isdecimal() and int(length) > MOST_UPLOAD_BYTES:
        return 413, f"{int(length) / 2**20:.0f} MiB, expected at most {MOST_UPLOAD_BYTES // 2**20} MiB"
    return None


@dataclass(frozen=True)
class Guard:
    """Middleware (ASGI) that refuses requests, see :func:`refuse_reason`, and sends the security policy of pages."""

    app: Callable[[Message, Receive, Send], Awaitable[None]]
    host: str

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refused = refuse_reason(headers, scope.get("method", "GET"), self.host)
        if refused is None:
            await self.app(scope, receive, _with_policy(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            status, text = refused
            head = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
            await send({"type": "http.response.start", "status": status, "headers": head})
            await send({"type": "http.response.body", "body": f"kpbench: {text}\n".encode()})


def _with_policy(send: Send) -> Send:
    async def send_with_policy(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = [
                (b"content-security-policy", POLICY.encode()),
                (b"x-content-type-options", b"nosniff"),
                (b"referrer-policy", b"no-referrer"),
                (b"cross-origin-resource-policy", b"same-origin"),
            ]
            message["headers"] = [*message.get("headers", ()), *headers]
        await send(message)

    return send_with_policy

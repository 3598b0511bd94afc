"""Checks of every request: a token, a bound on its size and its time, and a count."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import os
import time
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any, cast

from uvicorn.protocols.http.h11_impl import H11Protocol

from list3r.cli.answer import SCHEMA
from list3r.memory.core.errors import OptionError
from list3r.server.http.tokens import refusal

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]

OPEN_PATHS = frozenset(("/health",))
"""Paths answered without a token, and once a connection; they reveal nothing of the catalogue."""


@dataclass(frozen=True)
class ServiceLimits:
    """Bounds of one request, and of all at once."""

    request_bytes: int = 256 * 1024
    request_s: float = 10.0
    """For the headers of a request, from the connection or the last answer on; again as much for body and answer."""
    at_once: int = 64
    """Requests that one process answers; one that is still arriving does not count."""
    open_at_once: int = 512
    """Connections of one process; beyond that the longest waiting are closed."""
    of_one_address: int = 256
    """Connections of one address to one process."""
    answers: int = 200
    """Of one page."""
    connections: int = 8
    """To the database, of one process."""

    def __post_init__(self) -> None:
        counts = (self.request_bytes, self.at_once, self.open_at_once, self.of_one_address, self.answers)
        if min(*counts, self.connections) < 1 or not self.request_s > 0:
            raise OptionError("the limits of a service must be above 0")


class Metrics:
    """Counts of one process, in the text format of Prometheus."""

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, int]] = Counter()
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.under_way = 0

    def text(self) -> str:
        """Return all counts."""
        worker = f'worker="{os.getpid()}"'
        lines = ["# TYPE list3r_requests_total counter"]
        for (path, status), count in sorted(self.requests.items()):
            lines.append(f'list3r_requests_total{{{worker},path="{path}",status="{status}"}} {count}')
        lines.append("# TYPE list3r_request_seconds_total counter")
        for path, seconds in sorted(self.seconds.items()):
            lines.append(f'list3r_request_seconds_total{{{worker},path="{path}"}} {seconds:.6f}')
        lines += ["# TYPE list3r_requests_under_way gauge", f"list3r_requests_under_way{{{worker}}} {self.under_way}"]
        return "\n".join(lines) + "\n"


class Guard:
    """Wraps an application: requests not allowed, too large or too slow are refused here."""

    def __init__(self, inner: Application, secret: str, limits: ServiceLimits, metrics: Metrics) -> None:
        self._inner, self._secret, self._limits, self._metrics = inner, secret, limits, metrics
        self._answering = 0

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._inner(scope, receive, send)
            return
        answer, began = _Answer(send, closes=scope["path"] in OPEN_PATHS), time.monotonic()
        self._metrics.under_way += 1
        try:
            async with asyncio.timeout(self._limits.request_s):
                await self._guarded(scope, receive, answer)
        except TimeoutError:
            await answer.refuse(408, "SlowError", f"the request took longer than {self._limits.request_s:g} s")
        finally:
            self._metrics.under_way -= 1
            path = getattr(scope.get("route"), "path", "other")
            self._metrics.requests[path, answer.status] += 1
            self._metrics.seconds[path] += time.monotonic() - began

    async def _guarded(self, scope: Message, receive: Receive, answer: _Answer) -> None:
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        kind, _, token = headers.get("authorization", "").partition(" ")
        why = (
            None if scope["path"] in OPEN_PATHS else refusal(self._secret, token if kind.lower() == "bearer" else None)
        )
        if why is not None:
            await answer.refuse(401, "TokenError", why)
            return
        most = self._limits.request_bytes
        if int(headers.get("content-length", "0") or 0) > most:
            await answer.refuse(413, "SizeError", f"a request may have at most {most} bytes")
            return
        body = b""
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body += message.get("body", b"")
            if len(body) > most:
                await answer.refuse(413, "SizeError", f"a request may have at most {most} bytes")
                return
            if not message.get("more_body", False):
                break
        if self._answering >= self._limits.at_once:
            await answer.refuse(503, "BusyError", f"{self._answering} requests are being answered; ask again later")
            return
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]
        self._answering += 1
        try:
            await self._inner(scope, lambda: _next(whole, receive), answer)
        finally:
            self._answering -= 1


async def _next(whole: list[Message], receive: Receive) -> Message:
    return whole.pop() if whole else await receive()


class _Answer:
    """Sends an answer, and knows its status."""

    def __init__(self, send: Send, *, closes: bool) -> None:
        """`closes`: the answer ends the connection."""
        self._send, self._closes = send, closes
        self.status = 0

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = int(message["status"])
            if self._closes:
                message["headers"] = [*message["headers"], (b"connection", b"close")]
        await self._send(message)

    async def refuse(self, status: int, kind: str, text: str) -> None:
        """Answer with an error, unless another answer has begun."""
        if self.status:
            return
        headers, self._closes = [(b"content-type", b"application/json")], True
        if status == 401:
            headers.append((b"www-authenticate", b"Bearer"))
        await self({"type": "http.response.start", "status": status, "headers": headers})
        await self({"type": "http.response.body", "body": json.dumps(error_answer(status, kind, text)).encode()})


def error_answer(status: int, kind: str, message: str) -> dict[str, Any]:
    """Return the envelope of a request that failed."""
    error = {"kind": kind, "message": message, "status": status}
    return {"schema": SCHEMA, "units": None, "matches": [], "notes": [], "error": error}


class BoundedProtocol(H11Protocol):
    """A connection that ends when a request does not arrive, or its answer is not taken, in time, and sooner when
    others need its place while it waits.
    """

    def __init__(self, *args: Any, limits: ServiceLimits, **words: Any) -> None:
        super().__init__(*args, **words)
        self._limits = limits

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        self.address = _network(self.client[0]) if self.client else ""
        self.waits_since = self.loop.time()
        self._deadline = self.loop.call_later(self._limits.request_s, self.cut)
        self.loop.call_later(0.0, self._make_room)  # after reading the data of other connections

    def handle_events(self) -> None:
        """Read; from the headers of a request on, there is time for its body and answer, and to take that."""
        before = self.cycle
        super().handle_events()
        if self.cycle is not before:
            self._allow(2.0 * self._limits.request_s)  # `Guard` answers before that

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        self.waits_since = self.loop.time()
        self._allow(self._limits.request_s)
        super().on_response_complete()

    @property
    def waits(self) -> bool:
        """Whether the service waits for the client, to send a request or to take an answer."""
        c = self.cycle
        return c is None or c.response_complete or c.more_body or self.flow.write_paused

    def cut(self) -> None:
        """End the connection, whatever the client has not taken yet."""
        self.connections.discard(self)
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._deadline.cancel()
        super().connection_lost(exc)

    def _allow(self, seconds: float) -> None:
        self._deadline.cancel()
        self._deadline = self.loop.call_later(seconds, self.cut)

    def _make_room(self) -> None:
        """Close the longest waiting connections of the addresses with most, while there are too many."""
        while True:
            held = cast("set[BoundedProtocol]", self.connections)
            counts = Counter(c.address for c in held)
            crowded = counts[self.address] > self._limits.of_one_address
            if not crowded and len(held) <= self._limits.open_at_once:
                return
            waiting = [c for c in held if c.waits and (c.address == self.address or not crowded)]
            if not waiting:  # all are being answered, which `Guard` bounds
                return
            min(waiting, key=lambda c: (-counts[c.address], c.waits_since)).cut()


def _network(address: str) -> str:
    """Return an address; of one of IPv6 the half that its owner cannot choose."""
    found = ipaddress.ip_address(address)
    if isinstance(found, ipaddress.IPv6Address) and found.ipv4_mapped is None:
        return str(ipaddress.IPv6Network((int(found), 64), strict=False))
    return address

"""What every request passes before it is answered: a token, a bound on its size and its time, and a count."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from list3r.cli.answer import SCHEMA
from list3r.memory.errors import OptionError
from list3r.service.tokens import refusal

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]

OPEN_PATHS = frozenset(("/health",))
"""Answered without a token; they say nothing of what is catalogued."""


@dataclass(frozen=True)
class ServiceLimits:
    """Bounds of one request, and of all at once."""

    request_bytes: int = 256 * 1024
    request_s: float = 10.0
    """For the whole of a request, from its headers to the last byte of the answer."""
    at_once: int = 64
    """Requests of one process."""
    answers: int = 200
    """Of one page."""
    connections: int = 8
    """To the database, of one process."""

    def __post_init__(self) -> None:
        if min(self.request_bytes, self.at_once, self.answers, self.connections) < 1 or not self.request_s > 0:
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
    """Wraps an application: what is not allowed, too large or too slow is answered here."""

    def __init__(self, inner: Application, secret: str, limits: ServiceLimits, metrics: Metrics) -> None:
        self._inner, self._secret, self._limits, self._metrics = inner, secret, limits, metrics

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._inner(scope, receive, send)
            return
        answer, began = _Answer(send), time.monotonic()
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
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]
        await self._inner(scope, lambda: _next(whole, receive), answer)


async def _next(whole: list[Message], receive: Receive) -> Message:
    return whole.pop() if whole else await receive()


class _Answer:
    """Sends an answer, and knows its status."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.status = 0

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = int(message["status"])
        await self._send(message)

    async def refuse(self, status: int, kind: str, text: str) -> None:
        """Answer with an error, unless another answer has begun."""
        if self.status:
            return
        headers = [(b"content-type", b"application/json"), (b"connection", b"close")]
        if status == 401:
            headers.append((b"www-authenticate", b"Bearer"))
        await self({"type": "http.response.start", "status": status, "headers": headers})
        await self({"type": "http.response.body", "body": json.dumps(error_answer(status, kind, text)).encode()})


def error_answer(status: int, kind: str, message: str) -> dict[str, Any]:
    """Return the envelope of a request that failed."""
    error = {"kind": kind, "message": message, "status": status}
    return {"schema": SCHEMA, "units": None, "matches": [], "notes": [], "error": error}


class BoundedProtocol(H11Protocol):
    """A connection that is closed where the headers of its request do not come in time."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait."""
        super().connection_made(transport)
        self._deadline = self.loop.call_later(self.timeout_keep_alive, self._close_if_idle)

    def _close_if_idle(self) -> None:
        if self.cycle is None and not self.transport.is_closing():
            self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._deadline.cancel()
        super().connection_lost(exc)

"""The viewer's web server: this machine only, no page of another site, and the view that a link names."""

from __future__ import annotations

import contextlib
import functools
import http
import io
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request

HOST = "127.0.0.1"
_PAGES = frozenset(("document", "iframe"))
"""Sec-Fetch-Dest of a request that opens a page, not a picture or a script of one."""


def start_server(port: int, title: str, asked_for: Callable[[str], None]) -> viser.ViserServer:
    """Return a running server on this machine; `port` or the next free one.

    `asked_for` gets the code of every page that is opened with `?view=CODE`.
    """
    with _guarded(asked_for), quiet():
        server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
    return server


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """While a server starts or stops: viser's standard output is suppressed."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _guarded(asked_for: Callable[[str], None]) -> Iterator[None]:
    """While a server starts: it answers its own page only, by its own host and port. viser has no such option, and
    without it any page of another site or server open in the same browser could read and edit the memory.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Callable[[ServerConnection, Request], Any], **words: Any) -> Any:
        # `wraps`: websockets asks whether it is a coroutine function
        @functools.wraps(process_request)
        def process(connection: ServerConnection, request: Request) -> Any:
            refused = _refusal(request, f"{HOST}:{connection.local_address[1]}")
            if refused is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, refused)
            answer = process_request(connection, request)
            if answer is not None:
                answer.headers["Content-Security-Policy"] = f"frame-ancestors http://{HOST}:*"
            codes = parse_qs(request.path.partition("?")[2]).get("view")
            if codes and set(request.headers.get_all("Sec-Fetch-Dest")) <= _PAGES:
                asked_for(codes[-1])
            return answer

        return serve(*args, **words, process_request=process)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _refusal(request: Request, own: str) -> str | None:
    """Return why a request is not answered, None for one of the server's own page.

    The name of the host counts, too: another server of this machine may have the same port under the name localhost.
    """
    origins = request.headers.get_all("Origin")
    if request.headers.get_all("Host") != [own] or (
        (origins or "Upgrade" in request.headers) and origins != [f"http://{own}"]
    ):
        return f"This viewer answers at http://{own} only; open that address.\n"
    return None

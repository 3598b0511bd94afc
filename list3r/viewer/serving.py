"""The viewer's web server: this machine only, no page of another site, and the view that a link names."""

from __future__ import annotations

import contextlib
import functools
import io
import re
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server

HOST = "127.0.0.1"
_OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")


def start_server(port: int, title: str, asked_for: Callable[[str], None]) -> viser.ViserServer:
    """Return a running server on this machine; `port` or the next free one.

    `asked_for` gets the code of every page that is opened with `?view=CODE`.
    """
    with _guarded(asked_for), quiet():
        server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
    return server


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """While a server starts or stops: what viser tells on standard output is left out."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _guarded(asked_for: Callable[[str], None]) -> Iterator[None]:
    """While a server starts: it answers web sockets of its own pages only. viser has no such option, and without it any
    web site open in the same browser could read and edit the memory.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, **words: Any) -> Any:
        answer = words.pop("process_request", None)

        @functools.wraps(answer or guarded)
        def process(connection: Any, request: Any) -> Any:
            for code in parse_qs(urlsplit(request.path).query).get("view", []):
                asked_for(code)
            return None if answer is None else answer(connection, request)

        return serve(*args, **words, process_request=process, origins=[_OWN_PAGES])

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]

"""Processes that serve a catalogue."""

from __future__ import annotations

import functools
import math
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import uvicorn
from uvicorn.supervisors import Multiprocess

from list3r.catalog import Catalog
from list3r.memory.core.errors import OptionError
from list3r.server.http.app import CATALOG_VARIABLE, SECRET_VARIABLE, TIMEOUT_VARIABLE
from list3r.server.http.limits import Application, BoundedProtocol, ServiceLimits

_BACKLOG = 128
"""Connections that wait to be taken, and are taken at once."""


@dataclass(frozen=True)
class ServiceAddress:
    """Where a service listens, with how many processes."""

    host: str = "127.0.0.1"
    port: int = 8750
    """0: any free one."""
    workers: int = 1

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise OptionError(f"--workers {self.workers}: at least 1 process is needed")


def serve(
    catalog: str, secret: str, address: ServiceAddress, limits: ServiceLimits, started: Callable[[str], None]
) -> None:
    """Serve a catalogue until interrupted. `started` gets the address once the port is taken.

    Raises `OptionError` where the port is taken, `CatalogError` where the catalogue cannot be opened.
    """
    Catalog.open(catalog, make=False).close()  # its errors are reported here, and once
    os.environ |= {CATALOG_VARIABLE: catalog, SECRET_VARIABLE: secret, TIMEOUT_VARIABLE: str(limits.request_s)}
    listener = _listen(address.host, address.port)
    config = server_config("list3r.server.http.app:from_environment", limits, factory=True, workers=address.workers)
    started(f"http://{address.host}:{listener.getsockname()[1]}/v1")
    if address.workers == 1:
        uvicorn.Server(config).run(sockets=[listener])
    else:
        Multiprocess(config, sockets=[listener]).run()


def server_config(app: str | Application, limits: ServiceLimits, **words: Any) -> uvicorn.Config:
    """Return how uvicorn serves an application within limits."""
    return uvicorn.Config(
        app,
        http=functools.partial(BoundedProtocol, limits=limits),  # type: ignore[arg-type]
        ws="none",
        log_level="warning",
        backlog=_BACKLOG,
        timeout_keep_alive=math.ceil(limits.request_s),
        timeout_graceful_shutdown=math.ceil(limits.request_s),
        server_header=False,
        **words,
    )


def _listen(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise OptionError(f"--host {host} --port {port} cannot be served: {error}; name another") from error
    listener.listen(_BACKLOG)
    listener.set_inheritable(True)
    return listener

"""Latency of `list3r serve` for a client while others of the same address are slow on purpose.

    PYTHONPATH=. python benchmarks/slow_clients.py --clients 200 --seconds 60 --json FILE

A fifth of the slow ones each: send nothing; send a byte of their headers a second; the same after a first request that
was answered; send a byte of a body a second; ask once a second and take no answer. The third and the fifth kind have a
token. A closed one reconnects at once. The normal client asks over a new connection each time, and over one that it
keeps open.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import http.client
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from machine import write_json

from list3r.catalog import Catalog
from list3r.memory.store.store import Store
from list3r.server.http.tokens import make_token
from tests.conftest import write_small_room

SECRET = "a secret of the benchmark, long enough"
BEGUN = b"GET /health HTTP/1.1\r\nHost: a\r\n"
PAUSE_S = 0.05
"""Between two requests of the client that is not slow."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    args = parser.parse_args()
    report: dict[str, Any] = {"slow_clients": args.clients, "seconds": args.seconds}
    with tempfile.TemporaryDirectory() as folder, _service(Path(folder)) as port:
        report["alone"] = _asked(port, 5.0)
        spawn = multiprocessing.get_context("spawn")
        ready, connected = spawn.Event(), spawn.Value("l", 0)
        slow = spawn.Process(target=_slow, args=(port, args.clients, ready, connected), daemon=True)
        slow.start()
        ready.wait()
        report["beside_slow_clients"] = _asked(port, args.seconds)
        report["connections_of_slow_clients"] = connected.value
        slow.terminate()
        slow.join()
    print(report)
    if args.json is not None:
        write_json(args.json, report)


@contextlib.contextmanager
def _service(folder: Path) -> Iterator[int]:
    """A service of two small memories; its port."""
    with Catalog.open(str(folder / "catalog.sqlite")) as catalog:
        for name in ("one", "two"):
            with Store.create(folder / f"{name}.l3r") as store, store.transaction():
                write_small_room(store)
            catalog.add(folder / f"{name}.l3r")
    words = [sys.executable, "-m", "list3r", "serve", "--catalog", str(folder / "catalog.sqlite"), "--port", "0"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, env={**os.environ, "LIST3R_SERVE_SECRET": SECRET})
    try:
        assert process.stderr is not None
        port = urlsplit(process.stderr.readline().decode().strip()).port
        assert port is not None
        while True:
            with contextlib.suppress(OSError, http.client.HTTPException):
                _ask(http.client.HTTPConnection("127.0.0.1", port, timeout=10))
                break
            time.sleep(0.1)
        yield port
    finally:
        process.kill()
        process.wait()


def _asked(port: int, seconds: float) -> dict[str, Any]:
    """Ask over new connections and over a kept one in turn; how long the answers took, and their status."""
    end, kept = time.monotonic() + seconds, http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    took: dict[str, list[float]] = {"new": [], "kept": []}
    status: dict[str, Counter[str]] = {"new": Counter(), "kept": Counter()}
    while time.monotonic() < end:
        for which in took:
            connection = kept if which == "kept" else http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            began = time.monotonic()
            try:
                status[which][str(_ask(connection))] += 1
            except (OSError, http.client.HTTPException) as error:  # a kept one reconnects for the next request
                status[which][type(error).__name__] += 1
                connection.close()
            took[which].append(time.monotonic() - began)
            if which == "new":
                connection.close()
            time.sleep(PAUSE_S)
    return {which: {"answers": dict(status[which])} | _spread(took[which]) for which in took}


def _ask(connection: http.client.HTTPConnection) -> int:
    connection.request("GET", "/v1/find?text=mug", headers={"Authorization": f"Bearer {make_token(SECRET, 1.0)}"})
    answer = connection.getresponse()
    answer.read()
    return answer.status


def _spread(seconds: list[float]) -> dict[str, float]:
    """Median, 99th percentile and largest, ms."""
    return {
        name: round(1000 * float(np.quantile(seconds, q)), 1) for name, q in (("p50", 0.5), ("p99", 0.99), ("most", 1))
    }


def _slow(port: int, count: int, ready: Event, connected: Any) -> None:
    """Be many slow clients until ended."""

    async def one(kind: int) -> None:
        while True:
            client = socket.socket()
            client.setblocking(False)
            with contextlib.suppress(OSError), contextlib.closing(client):
                await _dawdle(client, port, kind)

    async def _dawdle(client: socket.socket, port: int, kind: int) -> None:
        loop = asyncio.get_running_loop()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        await loop.sock_connect(client, ("127.0.0.1", port))
        connected.value += 1
        asked = f"GET /v1/openapi.json HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {make_token(SECRET, 1.0)}\r\n\r\n"
        if kind == 0:
            await loop.sock_recv(client, 1)
        if kind == 2:
            await loop.sock_sendall(client, asked.encode())
            while not (more := await loop.sock_recv(client, 100_000)).endswith(b"}}}}"):
                if not more:
                    return
        if kind == 4:
            while True:  # until that fails
                await loop.sock_sendall(client, asked.encode())
                await asyncio.sleep(1.0)
        await loop.sock_sendall(client, BEGUN + (b"Content-Length: 1000\r\n\r\n" if kind == 3 else b""))
        while True:
            await loop.sock_sendall(client, b"x")
            with contextlib.suppress(TimeoutError):
                if not await asyncio.wait_for(loop.sock_recv(client, 1000), 1.0):
                    return

    async def all_of_them() -> None:
        tasks = [asyncio.create_task(one(n % 5)) for n in range(count)]
        await asyncio.sleep(1.0)
        ready.set()
        await asyncio.gather(*tasks)

    asyncio.run(all_of_them())


if __name__ == "__main__":
    main()

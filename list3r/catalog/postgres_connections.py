"""Connections to PostgreSQL: at most a fixed number, opened when they are needed and again when they are lost."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from queue import Empty, LifoQueue
from typing import Any

import psycopg
from psycopg.pq import TransactionStatus

from list3r.catalog.records import CatalogError

_WAIT_S = 5
"""How long a server is waited for, and a connection where all are in use."""
_STATEMENT_MS = 60_000
"""How long one statement may take."""
_SILENT_S = 20
"""A server that does not acknowledge anything for so long is lost: the network is gone."""
_PLANS = "-c jit=off -c enable_partitionwise_join=on -c max_parallel_workers_per_gather=0"
"""How questions are planned: relations are joined within each partition, where the rows of a memory are, in place of
reading them all; many small questions share the processors better than one that takes several."""
_VECTORS = "-c ivfflat.probes=40 -c ivfflat.iterative_scan=relaxed_order -c work_mem=16MB"
"""How vectors are searched: so many lists, and as many more where they hold too few; all that is there is sorted."""


class Connections:
    """Connections that threads take in turn."""

    def __init__(self, url: str, count: int) -> None:
        self._url = url
        self._free: LifoQueue[psycopg.Connection[Any] | None] = LifoQueue()
        for _ in range(count):
            self._free.put(None)

    @contextlib.contextmanager
    def one(self) -> Iterator[psycopg.Connection[Any]]:
        """A connection for a while, without a transaction. Raises `CatalogError` where all are in use for long."""
        try:
            held = self._free.get(timeout=_WAIT_S)
        except Empty:
            raise CatalogError(f"all connections to the catalogue were in use for {_WAIT_S} s; ask again") from None
        try:
            if held is None:
                held = self._connect()
            yield held
        finally:
            if held is not None and held.info.transaction_status != TransactionStatus.IDLE:
                held.close()
            self._free.put(None if held is None or held.closed else held)

    def close(self) -> None:
        """Close those that are free."""
        with contextlib.suppress(Empty):
            while True:
                held = self._free.get_nowait()
                if held is not None:
                    held.close()

    def _connect(self) -> psycopg.Connection[Any]:
        options = f"-c search_path=list3r,public -c statement_timeout={_STATEMENT_MS} {_PLANS} {_VECTORS}"
        lost: dict[str, Any] = {"keepalives_idle": 5, "keepalives_interval": 5, "tcp_user_timeout": 1000 * _SILENT_S}
        return psycopg.connect(
            self._url,
            options=options,
            connect_timeout=_WAIT_S,
            application_name="list3r",
            autocommit=True,
            keepalives_count=(_SILENT_S - 5) // 5,
            **lost,
        )

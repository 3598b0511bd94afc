"""The database of a catalogue by its URL; each kind is imported when it is asked for."""

from __future__ import annotations

from pathlib import Path

from list3r.catalog.base import Backend
from list3r.catalog.records import CatalogError


def open_backend(url: str, connections: int = 1, *, make: bool = True) -> Backend:
    """Return the database of a URL: postgresql://host/name, or a path or sqlite:///path for the embedded one.

    Without `make` a file that is not there is refused. Raises `CatalogError`.
    """
    kind, separator, rest = url.partition("://")
    if not separator or kind == "sqlite":
        from list3r.catalog.sqlite import SqliteBackend

        path = rest.removeprefix("/") if separator else url
        if not make and not Path(path).exists():
            raise CatalogError(f"{path} does not exist; `list3r catalog add FILE... --catalog {path}` makes it")
        return SqliteBackend(path)
    if kind in ("postgresql", "postgres"):
        from list3r.catalog.postgres import PostgresBackend

        return PostgresBackend(url, connections)
    raise CatalogError(f"{kind}:// is not a catalogue; give postgresql://host/name, or a file such as catalog.sqlite")

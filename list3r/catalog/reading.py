"""Read a memory file for a catalogue."""

from __future__ import annotations

import tempfile
from pathlib import Path

from list3r.batch.storage import checked_name, fetched, is_remote
from list3r.catalog.records import CatalogError, CatalogInstance, MemoryContent, MemoryEntry, SpaceVectors
from list3r.memory.core.description.words import vocabulary
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance
from list3r.memory.store.beside import has_foreign_log
from list3r.memory.store.file import file_hash
from list3r.memory.store.store import Store


def read_content(path: str, name: str | None = None) -> MemoryContent:
    """Return the content of a memory file, under its own name unless another is given.

    Raises `OptionError` for an invalid name, `MemoryFileError` for no memory, `CatalogError` for one that is being
    written.
    """
    if path != printable(path):
        raise CatalogError(f"{printable(path)} is not valid UTF-8, which a catalogue needs; rename the file or folder")
    if is_remote(path):
        with tempfile.TemporaryDirectory() as folder:
            local = fetched(path, Path(folder) / "memory")
            return _content(local, path, 0, name)
    local = Path(path).resolve()
    if not local.is_file():
        raise CatalogError(f"{path} is not a file; name a memory, such as house.l3r")
    return _content(local, str(local), local.stat().st_mtime_ns, name)


def _content(local: Path, path: str, mtime_ns: int, name: str | None) -> MemoryContent:
    log = local.with_name(f"{local.name}-wal")
    if log.exists() and log.stat().st_size and not has_foreign_log(local):
        raise CatalogError(
            f"{path} is being written; wait for that to end. If nothing writes it, `list3r repair {path}` completes it"
        )
    name = _own_name(path) if name is None else checked_name(name)
    with Store.open(local) as store, store.snapshot():
        instances = [_instance(name, i) for i in store.instances.all()]
        relations = [
            (r.subject, r.predicate, r.object, float(r.confidence), float(r.margin)) for r in store.relations.all()
        ]
        spaces = [SpaceVectors(printable(s), *store.embeddings.all(s)) for s in store.embeddings.spaces()]
        entry = MemoryEntry(
            name,
            path,
            0,
            file_hash(local),
            local.stat().st_size,
            mtime_ns,
            store.facts.scale_kind or "relative",
            store.facts.gravity,
            sum(t.structure is None for t in instances),
            len(store.sessions.all()),
        )
    return MemoryContent(entry, instances, relations, spaces)


def _own_name(path: str) -> str:
    try:
        return checked_name(Path(path).stem)
    except OptionError as error:
        raise OptionError(f"{path}: {error}; rename the file, or add it under another name") from None


def _instance(memory: str, i: Instance) -> CatalogInstance:
    known = vocabulary(i.label, i.structure, i.description, i.color_name)
    return CatalogInstance(
        memory,
        i.id,
        None if i.label is None else printable(i.label),
        printable(i.description),
        i.state,
        i.structure,
        float(i.confidence),
        i.position_sigma_m,
        i.component,
        i.box,
        {word: round(100 * weight) for word, weight in known.items()},
    )


def printable(text: str) -> str:
    """Return a text without characters that a database cannot hold: NUL and lone surrogates."""
    return text.replace("\x00", "\ufffd").encode("utf-8", "replace").decode("utf-8")

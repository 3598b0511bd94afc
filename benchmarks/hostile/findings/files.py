"""Findings 1 to 4 and 8: data that was lost."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

from hostile.findings.place import PRECIOUS, Place, first, spoil


def _in_the_way(link: Callable[[Path, Path], None], older: bool) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        memory, precious = place.older() if older else place.memory(), place.precious()
        link(precious, memory.with_name(memory.name + "-writer"))
        ended = place.ask("info", memory) if older else place.ask("label", memory, 2, "mug")
        left = precious.read_bytes()
        return first("" if left == PRECIOUS else f"{len(left)} of {len(PRECIOUS)} bytes are left", ended.bad)

    return look


def _symbolic(target: Path, place: Path) -> None:
    place.symlink_to(target)


def own_file_named_as_the_lock(place: Place) -> str:
    memory = place.memory()
    own = memory.with_name(memory.name + "-writer")
    own.write_bytes(PRECIOUS)
    place.ask("label", memory, 2, "mug")
    return "" if own.exists() and own.read_bytes() == PRECIOUS else "the user's file is gone"


def own_file_named_new(place: Place) -> str:
    own = place.folder / "n.l3r-new"
    own.write_bytes(PRECIOUS)
    store = importlib.import_module("list3r.memory.store.store").Store
    place.do(lambda: store.create(place.folder / "n.l3r").close())
    return "" if own.exists() and own.read_bytes() == PRECIOUS else "the user's file is gone"


def reading_an_older_memory_writes(place: Place) -> str:
    (place.folder / "old").mkdir()
    memory = place.older("old/m.l3r")
    before = {p.name: p.read_bytes() for p in memory.parent.iterdir()}
    for words in (("info", memory), ("list", memory), ("verify", memory), ("show", memory, 2)):
        place.ask(*words)
        now = {p.name: p.read_bytes() for p in memory.parent.iterdir()}
        if now != before:
            return f"`{words[0]}` changes {sorted(n for n in now | before if now.get(n) != before.get(n))}"
    return ""


_FLIP = (
    "UPDATE instances SET geometry = CAST(substr(geometry, 1, 7) || x'41' || substr(geometry, 9) AS BLOB) WHERE id = 3"
)
_SIGNED = {
    "a place": _FLIP,
    "instances.confidence": "UPDATE instances SET confidence = 0.123 WHERE id = 3",
    "merges.reason": "UPDATE merges SET reason = 'so'",
    "edits.created_at": "UPDATE edits SET created_at = 'yesterday'",
}


def _signed(statement: str) -> Callable[[Place], str]:
    """An edit of another row, after which the damaged file must still be damaged."""

    def look(place: Place) -> str:
        memory = place.memory()
        spoil(memory, statement)
        assert place.ask("verify", memory).status == 1
        for words in (("label", memory, 1, "mug"), ("merge", memory, 2, 4), ("delete", memory, 4)):
            ended = place.ask(*words)
            if place.ask("verify", memory).status == 0:
                return f"`verify` says sound after `{words[0]}`"
            if ended.bad:
                return ended.bad
        return ""

    return look


_RESTED_ON = {
    "supports": "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id IN (1, 3)",
    "placements": "UPDATE placements SET S_world_chunk = CAST(substr(S_world_chunk, 1, 96) || x'0000000000000840' "
    "AS BLOB)",
    "frames": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 3",
}


def _rested(table: str) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        taken = []
        for words in (("merge", 2, 4), ("delete", 4)):
            memory = place.memory()
            spoil(memory, _RESTED_ON[table])
            ended = place.ask(words[0], memory, *words[1:])
            taken += [words[0]] if ended.status == 0 else []
            if place.ask("verify", memory).status == 0:
                return f"`verify` says sound after `{words[0]}`"
        return f"{' and '.join(taken)} accepted" if taken else ""

    return look


def update_of_a_damaged_memory(place: Place) -> str:
    """A later session, which writes rows next to the damaged one."""
    memory, walk = place.folder / "b.l3r", place.walk(frames=12, size=(160, 120))
    words = ("--poses", "given", "--workers", 1)
    built = place.ask("build", walk, "-m", memory, *words, longest_s=120)
    assert built.status == 0, built.message
    place.ask("label", memory, 1, "thing")
    spoil(memory, "UPDATE merges SET reason = 'so'")
    later = place.walk("later", frames=10, size=(160, 120))
    ended = place.ask("update", memory, later, *words, longest_s=120)
    if place.ask("verify", memory).status == 0:
        return f"`verify` says sound after `update` (status {ended.status})"
    return ended.bad


def refused_build_removes_replaced(place: Place) -> str:
    memory, walk = place.memory(), place.walk(frames=2)
    own = place.memory("m.l3r.replaced")
    for more in ([], ["--force"]):
        ended = place.ask("build", walk, "-m", memory, "--poses", "given", "--workers", 1, *more)
        if not own.exists():
            return f"{own.name} is gone after `build {' '.join(more)}` (status {ended.status})"
    return ""


def _left_in_the_log(place: Place) -> Path:
    """A memory whose last edit was made while another process read."""
    opened = importlib.import_module("list3r").open
    memory = place.memory("log/m.l3r")
    writer = opened(memory, writable=True)
    reader = sqlite3.connect(f"file:{memory}?mode=ro", uri=True, isolation_level=None)
    with contextlib.closing(reader):
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM instances").fetchall()
        importlib.import_module("list3r.memory.maintenance.edits").label(writer.store, 2, "mine")
        writer.close()
    return memory


def log_left_is_not_told(place: Place) -> str:
    memory = _left_in_the_log(place)
    if not Path(f"{memory}-wal").exists():
        return ""
    silent = [c for c in ("verify", "info") if "-wal" not in place.ask(c, memory).message]
    place.ask("repair", memory)
    more = "" if not Path(f"{memory}-wal").exists() else "`repair` does not fold it in"
    return first(f"{' and '.join(silent)} do not report it" if silent else "", more)


def copy_without_log_is_sound(place: Place) -> str:
    memory = _left_in_the_log(place)
    if not Path(f"{memory}-wal").exists():
        return ""
    copy = Path(shutil.copy(memory, place.folder / "copy.l3r"))
    said = place.ask("verify", copy)
    lost = "mine" not in place.ask("list", copy).message
    return "the copy lacks the edit, and `verify` says nothing of it" if lost and "missing" not in said.message else ""


def repair_of_a_newer_memory(place: Place) -> str:
    memory = place.memory()
    with sqlite3.connect(memory) as database:
        newer = database.execute("PRAGMA user_version").fetchone()[0] + 1
        database.execute(f"PRAGMA user_version = {newer}")
    before = memory.read_bytes()
    ended = place.ask("repair", memory)
    return "" if memory.read_bytes() == before else f"written as the older version, status {ended.status}"


ROWS: dict[str, Callable[[Place], str]] = {
    "1 the lock's name is a symbolic link to a file; label": _in_the_way(_symbolic, False),
    "1 the lock's name is a hard link of a file; label": _in_the_way(os.link, False),
    "1 the same with a memory of an older schema; info": _in_the_way(_symbolic, True),
    "1 a user's own file has the lock's name; label": own_file_named_as_the_lock,
    "1 a user's own file is named MEMORY-new; create": own_file_named_new,
    "1 reading a memory of an older schema": reading_an_older_memory_writes,
    **{f"2 an edit beside a damaged row: {name}": _signed(sql) for name, sql in _SIGNED.items()},
    **{f"2 merge and delete of damaged {name}": _rested(name) for name in _RESTED_ON},
    "2 update of a memory with a damaged reason of a merge": update_of_a_damaged_memory,
    "3 a refused build and a memory named MEMORY.replaced": refused_build_removes_replaced,
    "4 the last edit stays in -wal: verify, info, repair": log_left_is_not_told,
    "4 a copy of the file alone": copy_without_log_is_sound,
    "8 repair of a memory of a newer schema": repair_of_a_newer_memory,
}

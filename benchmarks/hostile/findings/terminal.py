"""Findings 10, 11 and 14: waits for readers, output to the terminal, and tracebacks."""

from __future__ import annotations

import importlib
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from hostile.findings.place import Ended, Place, first, lie

EVIL = "mug\x1b[2J\x1b]0;owned\x07\n9  forged  row\r\u202eleft\x9b31m"


def stopped_reader(place: Place) -> str:
    memory = place.memory()
    child = os.fork()
    if child == 0:
        with importlib.import_module("list3r").open(memory) as scene, scene.store.snapshot():
            scene.instances()
            os.kill(os.getpid(), signal.SIGSTOP)
        os._exit(0)
    os.waitpid(child, os.WUNTRACED)
    try:
        ended = place.ask("label", memory, 2, "mug", longest_s=60)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    wrong = "another process that writes" in ended.message or "being written by another" in ended.message
    slow = f"blocked for {ended.wall_s:.0f} s" if ended.wall_s > 20 else ""
    return first(ended.bad, slow + (", called a writer" if wrong else "") if slow or wrong else "")


# ------------------------------------------------------------------------------------------- 11: the terminal


def _evil(place: Place, name: str = "m.l3r") -> Path:
    text = "CAST(x'" + EVIL.encode().hex() + "' AS TEXT)"
    kinds = "1, 1, 'loop', 0, 3, zeroblob(0), 0.5, 0, 9, 0.0, 0"
    return lie(
        place.memory(name),
        f"UPDATE instances SET label = {text}, description = {text}",
        f"UPDATE sessions SET source = {text}",
        f"UPDATE relations SET predicate = predicate || {text} WHERE subject = 5",
        f"UPDATE merges SET reason = {text}",
        f"INSERT INTO edges (u, v, kind, frame_u, frame_v, S_v_u, confidence, weight, inliers, residual_m, accepted, "
        f"reason, scores) SELECT {kinds}, {text}, '{{}}'".replace(
            "zeroblob(0)", "(SELECT S_world_chunk FROM placements)"
        ),
    )


def _raw(ended: Ended) -> str:
    for line in ended.message.split("\n"):
        if not line.isprintable():
            at = next(c for c in line if not c.isprintable())
            return f"{at!r} is printed raw"
        if line.strip().startswith("9  forged"):
            return "a row is forged"
    return ended.bad


def _printed(*commands: tuple[object, ...]) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        memory = _evil(place)
        for name, *more in commands:
            words = (name, more[0], memory, *more[1:]) if name == "query" else (name, memory, *more)
            if found := _raw(place.ask(*words)):
                return f"`{name}`: {found}"
        return ""

    return look


def folder_name(place: Place) -> str:
    (place.folder / "evil\x1b[31m\nname").mkdir()
    memory = place.memory("evil\x1b[31m\nname/m.l3r")
    return first(*(_raw(place.ask(*w)) for w in (("info", memory), ("verify", memory), ("show", memory, 77))))


_ENDINGS = {
    "usd": ".usda",
    "json": ".json",
    "graphml": ".graphml",
    "sql": ".sql",
    "report": ".html",
    "node-link": ".json",
}


def exports(place: Place) -> str:
    known = importlib.import_module("list3r.exporters.registry").FORMATS
    memory = _evil(place)
    for name in known.keys() & _ENDINGS.keys():
        out = place.folder / f"out{_ENDINGS[name]}"
        ended = place.ask("export", memory, "--to", name, "--out", out)
        if ended.bad or (out.exists() and b"\x1b" in out.read_bytes()):
            return f"{name}: {ended.bad or 'an escape is written raw'}"
    return ""


# ------------------------------------------------------------------------------------------- 14: tracebacks


def path_that_is_no_text(place: Place) -> str:
    place.memory(os.fsdecode(b"r\xffom.l3r"))
    place.walk(os.fsdecode(b"w\xffalk"), frames=12, size=(160, 120))
    name, walk = "$'r\\xffom.l3r'", "$'w\\xffalk'"
    commands = (
        f"list {name}",
        f"label {name} 2 mug",
        f"show {name} 77",
        f"verify {name}",
        f"inspect {walk}",
        f"build {walk} -m new.l3r --poses given --workers 1",
    )
    return first(*(place.shell(f"list3r {words}", 200).bad for words in commands))


def large_photo(place: Place) -> str:
    root = place.folder / "photos"
    root.mkdir()
    Image.new("L", (16_000, 12_500)).save(root / "0.jpg", quality=10)
    for k in range(1, 3):
        os.link(root / "0.jpg", root / f"{k}.jpg")
    return place.ask("inspect", root).bad


def ascii_output(place: Place) -> str:
    memory = place.memory()
    place.ask("label", memory, 2, "Café")
    ended = place.shell("list3r list m.l3r", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    return first(ended.bad, "" if ended.status == 0 else f"status {ended.status}")


def _output(redirected: str, fine: tuple[int, ...]) -> Callable[[Place], str]:
    """The label is written all the same: that must be the status, or be said."""

    def look(place: Place) -> str:
        place.memory()
        ended = place.shell(f"list3r label m.l3r 2 mine {redirected}")
        written = "mine" in place.ask("list", place.folder / "m.l3r").out
        said = ended.status in fine or "is done" in ended.err
        return first(ended.bad, "" if said and written else f"status {ended.status}, though the label is written")

    return look


def build_without_errors(place: Place) -> str:
    place.walk(frames=12, size=(160, 120))
    ended = place.shell("list3r build walk -m b.l3r --poses given --workers 1 2>&-", 200)
    return first(
        ended.bad, "" if ended.status == 0 else f"fails without a word, status {ended.status}: {ended.out[-80:]}"
    )


def links_in_a_circle(place: Place) -> str:
    loop = place.folder / "loop.l3r"
    loop.symlink_to(loop)
    walk = place.folder / "loop"
    walk.symlink_to(walk)
    commands = (("list", loop), ("repair", loop), ("inspect", walk), ("build", walk, "-m", loop))
    return first(*(place.ask(*w).bad for w in commands))


def array_without_sides(place: Place) -> str:
    root = place.walk()
    for path in (root / "depth").iterdir():
        with path.open("wb") as file:
            np.save(file, np.array(1.0))
    arrays = place.folder / "arrays"
    for kind in ("rgb", "depth"):
        (arrays / kind).mkdir(parents=True)
    for k in range(3):
        (arrays / "rgb" / f"{k}.png").write_bytes((root / "rgb" / f"{k}.png").read_bytes())
        np.save(arrays / "depth" / f"{k}.npy", np.array(1.0))
    return first(*(place.ask("inspect", r).bad for r in (root, arrays)))


def _json(text: str) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        walk, root = place.walk(), place.folder / "replica"
        (root / "results").mkdir(parents=True)
        for k in range(3):
            (root / "results" / f"frame{k:06d}.jpg").write_bytes((walk / "rgb" / f"{k}.png").read_bytes())
            (root / "results" / f"depth{k:06d}.png").write_bytes((walk / "depth" / f"{k}.png").read_bytes())
        np.savetxt(root / "traj.txt", [np.eye(4).ravel()] * 3)
        (root / "cam_params.json").write_text(text)
        return place.ask("inspect", root).beyond(10, 1000)

    return look


_EDGE = (
    "INSERT INTO edges (u, v, kind, frame_u, frame_v, S_v_u, confidence, weight, inliers, residual_m, accepted, "
    "reason, scores) SELECT 1, 1, 'loop', 0, 3, S_world_chunk, 0.5, 0, 9, 0.0, 0, 'so', '{\"s_det\": {}}' "
    "FROM placements"
)
_NAN = "zeroblob(48) || x'000000000000f87f' || substr(S_world_chunk, 57)"
_LIES = {
    "JSON in scores": _EDGE,
    "a placement that is not finite": f"UPDATE placements SET S_world_chunk = CAST({_NAN} AS BLOB)",
    "rotations of zero": "UPDATE frames SET T_chunk_cam = zeroblob(128)",
    "text where an id stands": "UPDATE relations SET object = 'mug' WHERE subject = 5",
    "text where a component stands": "UPDATE instances SET component = 'room' WHERE id = 3",
    "a label with line ends": "UPDATE instances SET label = 'a' || char(10) || 'b'",
}
_READS: tuple[tuple[object, ...], ...] = (
    ("list",), ("show", 3), ("info", "--loops"), ("merges",), ("verify",), ("query", "nearest", "--id", 3),
    ("query", "within", "--view", 3), ("query", "seen", 2), ("query", "relations"), ("query", "path", 3, 1),
)  # fmt: skip


def _told(statement: str) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        memory = lie(place.memory(), statement)
        for name, *more in _READS:
            words = (name, more[0], memory, *more[1:]) if name == "query" else (name, memory, *more)
            if found := place.ask(*words).bad:
                return f"`{name}`: {found}"
        for name, out in (("plan", "p.png"), ("usd", "u.usda"), ("json", "j.json"), ("glb", "g.glb"), ("tum", "t.txt")):
            if found := place.ask("export", memory, "--to", name, "--out", place.folder / out).bad:
                return f"`export --to {name}`: {found}"
        return ""

    return look


def label_that_is_no_text(place: Place) -> str:
    memory = lie(place.memory(), "UPDATE instances SET label = CAST(x'ff41' AS TEXT) WHERE id = 3")
    found = first(place.ask("list", memory).bad, place.ask("verify", memory).bad)
    sound = "`verify` calls it sound" if place.ask("verify", memory).status == 0 else ""
    place.ask("repair", memory)
    after = place.ask("list", memory)
    return first(found, sound, after.bad, "" if after.status == 0 else "`repair` cannot mend it")


ROWS: dict[str, Callable[[Place], str]] = {
    "10 a reader is stopped; label": stopped_reader,
    "11 escapes and line ends in what list prints": _printed(("list",), ("list", "--structure")),
    "11 in what show prints": _printed(("show", 2), ("show", 3)),
    "11 in what info and merges print": _printed(("info",), ("info", "--loops"), ("merges",), ("verify",)),
    "11 in what queries print": _printed(
        ("query", "find", "mug"), ("query", "nearest", "--id", 3), ("query", "within", "--view", 3),
        ("query", "seen", 2), ("query", "relations"), ("query", "path", 3, 1),
    ),
    "11 in the name of a folder": folder_name,
    "11 in USD, HTML, GraphML, JSON and SQL": exports,
    "14 a path that is not UTF-8": path_that_is_no_text,
    "14 a photo of 200 megapixels": large_photo,
    "14 a label with an accent, standard output of ASCII": ascii_output,
    "14 standard output is closed; label": _output(">&-", (0,)),
    "14 standard output is full; label": _output(">/dev/full", ()),
    "14 standard error is closed; label": _output("2>&-", (0,)),
    "14 standard error is closed; build": build_without_errors,
    "14 symbolic links in a circle": links_in_a_circle,
    "14 depth of 0 dimensions": array_without_sides,
    "14 deep JSON in cam_params.json": _json("[" * 100_000),
    "14 a number of 10,000 digits in cam_params.json": _json("1" * 10_000),
    **{f"14 a lie with valid checksums: {name}": _told(sql) for name, sql in _LIES.items()},
    "14 a label that is no UTF-8: verify, repair": label_that_is_no_text,
}  # fmt: skip

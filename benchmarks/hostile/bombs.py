"""Small files that unpack to much, and large claims in small files: each is refused quickly and in little memory.

Every bomb is opened by its own process; the system reports its processor time and peak memory.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hostile.packed import jpeg, mp4, png, zipped
from hostile.subject import write_source, write_subject
from list3r.memory.store.file import connected
from list3r.memory.store.rows.codec import pack

MOST_S, MOST_MB = 2.0, 500
_LAUNCH = """
import os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stderr=subprocess.STDOUT)
_, status, used = os.wait4(process.pid, 0)
print(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
"""A small process in between: a child has at least the peak of its parent."""


def run_bombs(folder: Path) -> dict[str, Any]:
    """Return how each bomb ended: status, seconds of a processor, megabytes; and violations."""
    rows: dict[str, dict[str, Any]] = {}
    problems = []
    for name, make in BOMBS.items():
        here = folder / name.replace(" ", "-").replace("/", "-")
        here.mkdir()
        words = make(here)
        tries = [_met(words)]
        while len(tries) < 3 and tries[-1]["cpu_s"] > MOST_S:  # others on the machine cost time too
            tries.append(_met(words))
        rows[name] = row = min(tries, key=lambda r: float(r["cpu_s"]))
        print(f"{name}: {row}", flush=True)
        refused = row["status"] == 2 and not row["traceback"]
        if not refused or row["cpu_s"] > MOST_S or row["peak_mb"] > MOST_MB:
            problems.append({"what": name, **row})
    return {"tries": len(rows), "bombs": rows, "problems": problems}


def _met(words: list[str]) -> dict[str, Any]:
    command = [sys.executable, "-S", "-c", _LAUNCH, sys.executable, "-m", "list3r", *words]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=300, check=False)
    *said, figures = done.stdout.splitlines() or ["0 0 0"]
    status, cpu_s, peak_kb = figures.split()
    text = "\n".join(said)
    return {
        "status": int(status),
        "cpu_s": round(float(cpu_s), 2),
        "peak_mb": int(peak_kb) // 1024,
        "traceback": "Traceback" in text,
        "said": " ".join(text.replace(str(Path(words[-1]).parent), "...").split())[-160:],
    }


# ------------------------------------------------------------------------------------------- sources


def _walk(here: Path, name: str, data: bytes, command: str = "inspect") -> list[str]:
    """A folder with one file that is the bomb."""
    write_source(here / "walk")
    for path in sorted((here / "walk").glob(name)):
        path.write_bytes(data)
    more = ["--memory", str(here / "m.l3r"), "--workers", "0"] if command == "build" else []
    return [command, str(here / "walk"), *more]


def _file(here: Path, name: str, data: bytes, command: str = "inspect", *more: str) -> list[str]:
    (here / name).write_bytes(data)
    return [command, str(here / name), *more]


def _r3d(here: Path, metadata: bytes | int, packing: int = zipfile.ZIP_DEFLATED) -> list[str]:
    data = zipped(("rgbd/0.jpg", jpeg(16, 16)), ("metadata", metadata), packing=packing)
    return _file(here, "walk.r3d", data)


def _r3d_depth(here: Path) -> list[str]:
    """Depth of LZFSE that unpacks to two gigabytes, in an archive of a megabyte."""
    try:
        import lzfse
    except ImportError:
        return _r3d(here, 2**32)
    camera = {"K": [10, 0, 0, 0, 10, 0, 8, 8, 1], "w": 16, "h": 16, "dw": 256, "dh": 192, "poses": []}
    block = lzfse.compress(bytes(20_000_000))[:-4]  # without the end
    return _file(
        here,
        "walk.r3d",
        zipped(
            ("metadata", json.dumps(camera).encode()),
            *((f"rgbd/{k}.jpg", jpeg(16, 16)) for k in range(2)),
            *((f"rgbd/{k}.depth", block * 12 + b"bvx$") for k in range(2)),
        ),
    )


def _crowded_zip(here: Path) -> list[str]:
    """An archive with a list of 600,000 members, all the same bytes."""
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0)
    listing = b"".join(entry + b"%07d" % k for k in range(600_000))
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(listing), 0, 0)
    return _file(here, "walk.r3d", listing + end)


def _sens(here: Path) -> list[str]:
    """Four gigabytes of frames of nothing, a file with a hole."""
    head = struct.pack("<IQ", 4, 0) + struct.pack("<16f", *np.eye(4).ravel()) * 4
    head += struct.pack("<iiIIIIfQ", 2, 1, 640, 480, 640, 480, 1000.0, 2**40)
    words = _file(here, "scene.sens", head)
    os.truncate(here / "scene.sens", 2**32)
    return words


def _sens_depth(here: Path) -> list[str]:
    head = struct.pack("<IQ", 4, 0) + struct.pack("<16f", *np.eye(4).ravel()) * 4
    head += struct.pack("<iiIIIIfQ", 2, 1, 16, 16, 65535, 65535, 1000.0, 1)
    depth, picture = zlib.compress(bytes(10_000_000), 9), jpeg(16, 16)
    frame = struct.pack("<16f", *np.eye(4).ravel()) + struct.pack("<4Q", 1, 1, len(picture), len(depth))
    return _file(here, "scene.sens", head + frame + picture + depth)


def _bag(here: Path) -> list[str]:
    """A bag of ROS 1 with one chunk of bzip2 that unpacks to a gigabyte."""
    chunk = bz2.compress(bytes(10**9))

    def record(head: dict[str, bytes], data: bytes) -> bytes:
        fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in head.items())
        return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data

    start = b"#ROSBAG V2.0\n"
    body = record({"op": b"\5", "compression": b"bz2", "size": struct.pack("<I", 10**9)}, chunk)
    at = len(start) + 4096
    kind = {"topic": b"/rgb", "type": b"std_msgs/UInt32", "md5sum": b"304a39449588c7f8ce2df6e8001c5fce"}
    words = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in kind.items())
    definition = b"message_definition=uint32 data\n"
    words += struct.pack("<I", len(definition)) + definition
    number = struct.pack("<I", 0)
    index = record(
        {"op": b"\4", "ver": struct.pack("<I", 1), "conn": number, "count": struct.pack("<I", 1)},
        struct.pack("<IIi", 1, 0, 0),
    )
    known = record({"op": b"\7", "conn": number, "topic": b"/rgb"}, words)
    head = {"op": b"\6", "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", at), "count": struct.pack("<I", 1)}
    head |= {"start_time": struct.pack("<II", 1, 0), "end_time": struct.pack("<II", 2, 0)}
    chunks = record(head, number + struct.pack("<I", 1))
    counts = {"op": b"\3", "index_pos": struct.pack("<Q", at + len(body) + len(index))}
    counts |= {"conn_count": struct.pack("<I", 1), "chunk_count": struct.pack("<I", 1)}
    head = record(counts, b"")
    padded = record(counts, b" " * (4096 - len(head)))
    return _file(here, "walk.bag", start + padded + body + index + known + chunks)


def _precomputed(here: Path) -> list[str]:
    write_source(here / "walk")
    (here / "made").mkdir()
    (here / "made" / "precomputed.json").write_text(
        '{"format": "list3r-precomputed", "version": 1, "scale": "metric", "model": "x"}'
    )
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": (2**31,)})
    data = zipped(("frames.npy", _npy(np.arange(4))), ("depth.npy", 2**31), ("confidence.npy", head.getvalue()))
    (here / "made" / "chunk_000.npz").write_bytes(data)
    how = str(here / "made")
    return ["build", str(here / "walk"), "-m", str(here / "m.l3r"), "--reconstruction", "precomputed", "--weights", how]


def _npy(array: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _lying_npy(count: int) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": (count, 3)})
    return out.getvalue() + bytes(2400)


def _manifest(here: Path) -> list[str]:
    (here / "videos.txt").write_text('{"source": ' + "[" * 2_000_000 + "}\n")
    return ["batch", str(here / "videos.txt"), "--out", str(here / "out")]


# ------------------------------------------------------------------------------------------- memories


def _memory(here: Path, *statements: tuple[str, tuple[Any, ...]], command: str = "list", more: str = "") -> list[str]:
    path = write_subject(here / "m.l3r")
    with contextlib.closing(connected(path, "rw")) as database:
        for statement in ("journal_mode=WAL", "ignore_check_constraints=ON"):
            database.execute(f"PRAGMA {statement}").fetchall()
        database.begin("IMMEDIATE")
        for sql, arguments in statements:
            database.execute(sql, arguments)
        database.commit()
    return [*command.split(), str(path), *more.split()]


def _track(here: Path) -> list[str]:
    """A mask track with arrays that unpack to two gigabytes."""
    blob = zipped(*((f"{k}.npy", 2**27) for k in range(16)))
    return _memory(here, ("UPDATE local_instances SET track = ?", (blob,)), command="seen", more="2")


def _claimed(here: Path) -> list[str]:
    blob = pack({"frames": np.zeros(2**25, np.int64)})
    return _memory(here, ("UPDATE local_instances SET track = ?", (blob,)), command="seen", more="2")


def _aliases(here: Path) -> list[str]:
    numbers = "WITH RECURSIVE n(k) AS (VALUES(1000) UNION ALL SELECT k + 1 FROM n LIMIT 100000)"
    chain = f"{numbers} INSERT INTO aliases SELECT k, k + 1 FROM n"
    return _memory(
        here, (chain, ()), ("UPDATE aliases SET instance = 1000 WHERE id = 100999", ()), command="show", more="1000"
    )


def _values(here: Path) -> list[str]:
    text = "[" + "[]," * 12_000_000 + "[]]"
    return _memory(here, ("UPDATE sessions SET cuts = ?", (text,)), command="info")


def _label(here: Path) -> list[str]:
    return _memory(here, ("UPDATE instances SET label = ?", ("x" * 20_000_000,)))


def _sparse(here: Path) -> list[str]:
    path = write_subject(here / "m.l3r")
    os.truncate(path, 2**40)
    return ["repair", str(path), "--out", str(here / "mended.l3r")]


def _picture(here: Path) -> list[str]:
    path = write_subject(here / "m.l3r")
    (here / "bomb.png").write_bytes(png(20_000, 20_000))
    return ["similar", str(path), "--image", str(here / "bomb.png")]


def _stored_picture(here: Path) -> list[str]:
    change = ("UPDATE keyframes SET jpeg = ?", (png(20_000, 20_000),))
    return _memory(here, change, command="picture", more=f"2 --out {here / 'out.jpg'}")


BOMBS: dict[str, Callable[[Path], list[str]]] = {
    "PNG of 400 megapixels": lambda h: _walk(h, "rgb/*.png", png(20_000, 20_000)),
    "PNG of 400 megapixels, colour, build": lambda h: _walk(h, "rgb/*.png", png(20_000, 20_000, 8, 3), "build"),
    "depth PNG of 900 megapixels": lambda h: _walk(h, "depth/*.png", png(30_000, 30_000, 16)),
    "PNG to ask with": _picture,
    "PNG stored in a memory": _stored_picture,
    "JPEG that claims 65,500 x 65,500": lambda h: _walk(h, "rgb/*.png", jpeg(65_500, 65_500)),
    "depth npy that claims 48 GB": lambda h: _walk(h, "depth/*.png", _lying_npy(2**31)),
    "npz of precomputed depth": _precomputed,
    "blob of arrays in a memory": _track,
    "array of 256 MiB in a memory": _claimed,
    "label of 20 MB": _label,
    "100,000 chained aliases in a circle": _aliases,
    "JSON of 12 million lists in a memory": _values,
    "repair of a file of a terabyte with a hole": _sparse,
    "JSON of 12 million lists": lambda h: (
        [*_file(h, "transforms.json", b"[" + b"[]," * 12000000 + b"[]]")[:1], str(h)]
    ),
    "JSON 2 million deep": lambda h: [*_file(h, "transforms.json", b"[" * 2000000)[:1], str(h)],
    "list of 60 million lines": lambda h: _walk(h, "rgb.txt", b"\n" * 60_000_000),
    "line of 30 million numbers": lambda h: _walk(h, "groundtruth.txt", b"1 " * 30_000_000),
    "zip: metadata of 4 GB": lambda h: _r3d(h, 2**32),
    "zip: metadata of bzip2": lambda h: _r3d(h, 2**30, zipfile.ZIP_BZIP2),
    "zip: metadata of 60 MB of lists": lambda h: _r3d(h, b"[" + b"[]," * 20_000_000 + b"[]]"),
    "zip: 600,000 members": _crowded_zip,
    "zip: depth of LZFSE": _r3d_depth,
    "sens: frames of nothing in a hole of 4 GB": _sens,
    "sens: depth that claims 65,535 x 65,535": _sens_depth,
    "bag: chunk of bzip2": _bag,
    "video that claims 50 million frames": lambda h: _file(h, "walk.mp4", mp4(50_000_000)),
    "video that claims 2 billion frames": lambda h: _file(h, "walk.mp4", mp4(2_000_000_000)),
    "video whose fragment claims 50 million": lambda h: _file(h, "walk.mp4", mp4(50_000_000, fragments=True)),
    "video that claims 65,535 x 65,535": lambda h: _file(h, "walk.mp4", mp4(10, (65_535, 65_535))),
    "manifest of JSON 2 million deep": _manifest,
    "cloud npy that claims 48 GB": lambda h: [
        "eval",
        "cloud",
        *_file(h, "a.npy", _lying_npy(2**31))[1:],
        *_file(h, "b.npy", _lying_npy(2**31))[1:],
    ],
}

"""Findings 9, 12 and 13: sources that are wrong without a word, that are waited for, and that take all memory."""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from hostile.findings.place import Place, first, lie
from hostile.packed import png

# ------------------------------------------------------------------------------------------- 9: no word about it


def _poses(change: Callable[[np.ndarray], None]) -> Callable[[Place], str]:
    """A folder in the layout of 7-Scenes with poses that are no rigid motions."""

    def look(place: Place) -> str:
        root = _seven_scenes(place)
        for path in root.glob("*.pose.txt"):
            T = np.eye(4)
            change(T)
            np.savetxt(path, T)
        return _noted(place, root, "rigid")

    return look


def _seven_scenes(place: Place, depth: int = 1500, frames: int = 4) -> Path:
    root = place.folder / "seven"
    root.mkdir()
    for k in range(frames):
        noise = np.random.default_rng(k).integers(0, 255, (480, 640, 3), np.uint8)
        Image.fromarray(noise).save(root / f"frame-{k:06d}.color.png", compress_level=1)
        Image.fromarray(np.full((480, 640), depth, np.uint16)).save(root / f"frame-{k:06d}.depth.png")
        np.savetxt(root / f"frame-{k:06d}.pose.txt", np.eye(4))
    np.savetxt(root / "camera-intrinsics.txt", [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    return root


def _noted(place: Place, root: Path, word: str, *more: object) -> str:
    """Whether `inspect` has a word about it, or refuses it."""
    ended = place.ask("inspect", root, *more)
    said = word in " ".join(ended.message.split())
    return first(ended.bad, "" if said or ended.status == 2 else "accepted without a note")


def _depth(value: int, word: str) -> Callable[[Place], str]:
    return lambda place: _noted(place, _seven_scenes(place, value), word)


def _small_depth(value: int) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        root = place.walk()
        for path in (root / "depth").iterdir():
            Image.fromarray(np.full((48, 64), value, np.uint16)).save(path)
        return _noted(place, root, "hardly indoors")

    return look


def wrong_distortion(place: Place) -> str:
    return _noted(place, _seven_scenes(place), "distortion of", "--distortion", "1e10,0,0,0")


def scale_of_another_layout(place: Place) -> str:
    return _noted(place, place.walk(), "depth-scale", "--depth-scale", 1000)


def _scale_against_motion(times: float) -> Callable[[Place], str]:
    """A wall with texture 2 m away, the camera moves 0.4 m sideways; the layout says nothing of units."""

    def look(place: Place) -> str:
        root = _posed_wall(place)
        if "depth-scale" in (quiet := place.ask("inspect", root)).message and "times" in quiet.message:
            return f"noted where the scale is right: {quiet.message[-200:]}"
        return _noted(place, root, "motion", "--depth-scale", 1000 * times)

    return look


def _posed_wall(place: Place) -> Path:
    """7-Scenes again, with depth and poses that agree."""
    root, frames = place.folder / "wall", 8
    root.mkdir()
    small = np.random.default_rng(0).integers(0, 255, (60, 100), np.uint8)
    wall = np.asarray(Image.fromarray(small).resize((800, 480), Image.Resampling.BICUBIC))
    for k in range(frames):
        shift = 15 * k
        picture = np.repeat(wall[:, shift : shift + 640, None], 3, axis=2)
        Image.fromarray(picture).save(root / f"frame-{k:06d}.color.png", compress_level=1)
        Image.fromarray(np.full((480, 640), 2000, np.uint16)).save(root / f"frame-{k:06d}.depth.png")
        T = np.eye(4)
        T[0, 3] = shift * 2.0 / 585
        np.savetxt(root / f"frame-{k:06d}.pose.txt", T)
    np.savetxt(root / "camera-intrinsics.txt", [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    return root


def equal_times(place: Place) -> str:
    root = place.walk()
    shutil.rmtree(root / "depth")
    (root / "depth.txt").unlink()
    (root / "rgb.txt").write_text("".join(f"1.0 rgb/{k}.png\n" for k in range(4)))
    return _noted(place, root, "ascend")


def half_unreadable(place: Place) -> str:
    root = place.walk(frames=8)
    for path in sorted((root / "rgb").iterdir())[1::2]:
        path.write_bytes(path.read_bytes()[:100])
    return _noted(place, root, "cannot be used")


# ------------------------------------------------------------------------------------------- 12: waiting


def _waited(name: str, command: str, device: str | None = None) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        root = place.walk()
        (root / name).unlink()
        if device is None:
            os.mkfifo(root / name)
        else:
            (root / name).symlink_to(device)
        more = ("-m", place.folder / "m.l3r", "--workers", 1) if command == "build" else ()
        return place.ask(command, root, *more, longest_s=40).beyond(10, 1000)

    return look


def pipe_as_archive(place: Place) -> str:
    made = _precomputed(place)
    os.mkfifo(made / "chunk_000.npz")
    return _build_precomputed(place, made).bad


def pipe_as_journal(place: Place) -> str:
    memory = place.memory()
    os.mkfifo(f"{memory}-journal")
    commands = [("list",), ("show", 2), ("query", "find", "mug"), ("verify",), ("label", 2, "mug"), ("repair",)]
    found = []
    for name, *more in commands:
        words = (name, more[0], memory, *more[1:]) if name == "query" else (name, memory, *more)
        found.append(place.ask(*words, longest_s=8).bad)
    return f"{sum(map(bool, found))} of {len(found)} commands: {first(*found)}" if any(found) else ""


# ------------------------------------------------------------------------------------------- 13: amplification


def _precomputed(place: Place) -> Path:
    made = place.folder / "made"
    made.mkdir()
    head = {"format": "list3r-precomputed", "version": 1, "scale": "metric", "model": "x"}
    (made / "precomputed.json").write_text(json.dumps(head))
    return made


def _build_precomputed(place: Place, made: Path):  # type: ignore[no-untyped-def]
    how = ("--reconstruction", "precomputed", "--weights", made, "--workers", 1)
    return place.ask("build", place.walk(), "-m", place.folder / "m.l3r", *how, longest_s=30)


def archive(place: Place) -> str:
    made, head = _precomputed(place), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": (4, 11585, 11585)})
    with zipfile.ZipFile(made / "chunk_000.npz", "w", zipfile.ZIP_DEFLATED) as packed:
        with packed.open("frames.npy", "w") as member:
            np.save(member, np.arange(4))
        with packed.open("depth.npy", "w", force_zip64=True) as member:
            member.write(head.getvalue())
            for _ in range(2**11):
                member.write(bytes(2**20))
    return _build_precomputed(place, made).beyond(10, 1000)


def _picture(kind: str, side: int, bits: int) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        root = place.walk()
        data = png(side, side, bits)
        for path in (root / kind).iterdir():
            path.write_bytes(data)
        return place.ask("inspect", root, longest_s=60).beyond(10, 800)

    return look


def chained_aliases(place: Place) -> str:
    numbers = "WITH RECURSIVE n(k) AS (VALUES(1000) UNION ALL SELECT k + 1 FROM n LIMIT 100000)"
    chain = f"{numbers} INSERT INTO aliases SELECT k, CASE k WHEN 100999 THEN 2 ELSE k + 1 END FROM n"
    memory = lie(place.memory(), chain)
    words = (("show", memory, 1000), ("list", memory), ("merges", memory))
    return first(*(place.ask(*w, longest_s=40).beyond(10, 1000) for w in words))


def long_label(place: Place) -> str:
    memory, text = place.memory(), "ab cd " * 3_300_000
    place.do(
        lambda: lie(memory, f"UPDATE instances SET label = '{text}' WHERE id = 2") and 0, 60
    )  # its memory is not ours
    words = (("list", memory), ("show", memory, 2), ("query", "find", memory, "mug"), ("info", memory))
    return first(*(place.ask(*w).beyond(10, 500) for w in words))


def repair_of_a_hole(place: Place) -> str:
    """A file of a terabyte with a hole, and no more than 300 MB may be written here."""
    memory = place.memory("holes/m.l3r")
    os.truncate(memory, 2**40)
    ended = place.ask("repair", memory, longest_s=60, limit={resource.RLIMIT_FSIZE: 300 * 2**20})
    left = [p for p in memory.parent.iterdir() if (p != memory and ".repair" in p.name) or "-repair-" in p.name]
    size = sum(p.stat().st_blocks * 512 for p in left) // 2**20
    written = "writes until there is no more room" if "File too large" in ended.message else ""
    return first(f"leaves {left[0].name[:24]} of {size} MB" if left else written, ended.beyond(10, 1000))


ROWS: dict[str, Callable[[Place], str]] = {
    "9 mirrored poses": _poses(lambda T: T.__setitem__((slice(3), 0), -T[:3, 0])),
    "9 poses that stretch": _poses(lambda T: T.__setitem__((slice(3), slice(3)), 1.3 * T[:3, :3])),
    "9 translations of 1e200": _poses(lambda T: T.__setitem__((0, 3), 1e200)),
    "9 last row of poses 0,0,0,2": _poses(lambda T: T.__setitem__((3, 3), 2.0)),
    "9 distortion of 1e10": wrong_distortion,
    "9 depth all 0": _depth(0, "unknown everywhere"),
    "9 depth all 65535": _depth(65535, "unknown everywhere"),
    "9 depth of 0.2 mm": _small_depth(1),
    "9 depth of 5 mm, in 1/5000 m": _small_depth(25),
    "9 --depth-scale 5 times off, of a layout with units": scale_of_another_layout,
    "9 --depth-scale 5 times too large, against motion": _scale_against_motion(5.0),
    "9 --depth-scale 5 times too small, against motion": _scale_against_motion(0.2),
    "9 all time stamps equal": equal_times,
    "9 half of the source unreadable": half_unreadable,
    "12 a picture of rgb.txt is a pipe; inspect": _waited("rgb/0.png", "inspect"),
    "12 a picture of rgb.txt is a pipe; build": _waited("rgb/0.png", "build"),
    "12 a picture of depth.txt is a pipe; inspect": _waited("depth/0.png", "inspect"),
    "12 a picture is /dev/zero; inspect": _waited("rgb/0.png", "inspect", "/dev/zero"),
    "12 a chunk of --reconstruction precomputed is a pipe": pipe_as_archive,
    "12 MEMORY-journal is a pipe; six commands": pipe_as_journal,
    "13 npz of 2 MB that unpacks to 2 GB; build": archive,
    "13 PNG of 20,000 x 20,000; inspect": _picture("rgb", 20_000, 8),
    "13 depth PNG of 30,000 x 30,000; inspect": _picture("depth", 30_000, 16),
    "13 100,000 chained aliases": chained_aliases,
    "13 a label of 20 MB; four commands": long_label,
    "13 repair of a file with a hole": repair_of_a_hole,
}

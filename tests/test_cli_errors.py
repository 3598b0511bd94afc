"""Bad input through the real program: exit status 2, one or two lines that name the fix, nothing left behind."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import sqlite3
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from list3r.cli.app import run
from list3r.memory.store.store import Store
from tests.conftest import write_small_room
from tests.program import as_user, in_process


def check_refused(result: subprocess.CompletedProcess[str], pattern: str) -> None:
    """Status 2, nothing on standard output, at most two lines of error that match."""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("note:")]
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert 1 <= len(lines) <= 2, result.stderr
    assert lines[0].startswith("error: ")
    assert re.search(pattern, result.stderr), result.stderr


def write_frames(folder: Path, count: int = 4, *, depth_size: tuple[int, int] = (64, 48), poses: bool = True) -> Path:
    """A tiny TUM folder with a flat wall."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    color = Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    depth = Image.fromarray(np.full((depth_size[1], depth_size[0]), 10000, np.uint16))
    for k in range(count):
        color.save(folder / f"rgb/{k}.png")
        depth.save(folder / f"depth/{k}.png")
    for name in ("rgb", "depth"):
        (folder / f"{name}.txt").write_text("".join(f"{k * 0.1:.1f} {name}/{k}.png\n" for k in range(count)))
    if poses:
        (folder / "groundtruth.txt").write_text("".join(f"{k * 0.1:.1f} 0 0 0 0 0 0 1\n" for k in range(count)))
    (folder / "calibration.txt").write_text("60 60 31.5 23.5\n")
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good and bad sources and memories."""
    root = tmp_path_factory.mktemp("bad")
    write_frames(root / "good")
    write_frames(root / "unposed", poses=False)
    write_frames(root / "small-depth", depth_size=(32, 20))
    corrupt = write_frames(root / "corrupt", count=6)
    for k in range(5):
        (corrupt / f"rgb/{k}.png").write_bytes(b"not a picture")
    shutil.copytree(corrupt, root / "ruined")
    (root / "ruined/rgb/5.png").write_bytes(b"not a picture")
    listed = write_frames(root / "unlisted")
    (listed / "depth.txt").unlink()
    (root / "empty").mkdir()
    pictures = root / "pictures"
    pictures.mkdir()
    shutil.copy(root / "good/rgb/0.png", pictures / "0.png")
    shutil.copy(root / "good/rgb/0.png", pictures / "1.png")
    (root / "zeros").mkdir()
    (root / "zeros/0.png").touch()
    (root / "text.mp4").write_text("this is no video")
    (root / "zero.mp4").touch()
    (root / "note.txt").write_text("hello")
    with Store.create(root / "room.l3r") as store, store.transaction():
        write_small_room(store)
    shutil.copy(root / "room.l3r", root / "newer.l3r")
    with sqlite3.connect(root / "newer.l3r") as database:
        database.execute("PRAGMA user_version = 99")
    database.close()
    with sqlite3.connect(root / "other.db") as database:
        database.execute("CREATE TABLE t (x)")
    database.close()
    shutil.copy(root / "room.l3r", root / "later.l3r")
    with sqlite3.connect(root / "later.l3r") as database:
        database.execute("PRAGMA user_version = 99")
        database.execute("CREATE TABLE of_a_later_program (x)")
    database.close()
    for name, manifest in (
        ("pre", '{"format": "list3r-precomputed", "version": 1, "scale": "relative"}'),
        ("cut", "{"),
    ):
        (root / name).mkdir()
        (root / name / "precomputed.json").write_text(manifest)
    (root / "cut.npz").write_bytes(b"PK\x03\x04 and no more")
    whole = (root / "room.l3r").read_bytes()
    (root / "torn.l3r").write_bytes(whole[: len(whole) // 3])
    (root / "memory.png").write_bytes(whole)
    return root


CASES = {
    "absent source": ("build {p}/nothing -m {p}/new.l3r", "nothing.*(exist|found)"),
    "empty folder": ("build {p}/empty -m {p}/new.l3r", "empty"),
    "inspect an empty folder": ("inspect {p}/empty", "empty"),
    "not a video": ("build {p}/text.mp4 -m {p}/new.l3r", "text.mp4"),
    "zero bytes": ("build {p}/zero.mp4 -m {p}/new.l3r", "zero.mp4"),
    "pictures of zero bytes": ("build {p}/zeros -m {p}/new.l3r --intrinsics 60,60,32,24", "zeros"),
    "not a source at all": ("inspect {p}/note.txt", "note.txt"),
    "depth of another size": ("build {p}/small-depth -m {p}/new.l3r", "32x20.*--depth-intrinsics|--depth-intrinsics"),
    "no depth": ("build {p}/pictures -m {p}/new.l3r --intrinsics 60,60,32,24 --reconstruction rgbd", "no depth"),
    "depth list missing": ("build {p}/unlisted -m {p}/new.l3r --reconstruction rgbd", "depth"),
    "all corrupt": ("build {p}/ruined -m {p}/new.l3r --workers 1", "none of 6 frames tried can be decoded"),
    "no poses to be given": ("build {p}/unposed -m {p}/new.l3r --poses given", "no poses.*estimate"),
    "memory is a folder": ("build {p}/good -m {p}/empty", "is a folder"),
    "memory in no folder": ("build {p}/good -m {p}/no/where/new.l3r", "does not exist"),
    "memory exists": ("build {p}/good -m {p}/room.l3r", "--resume.*--force"),
    "resume of another source": ("build {p}/good -m {p}/room.l3r --resume", "begun from walk"),
    "force onto a stranger's file": ("build {p}/good -m {p}/note.txt --force", "not a memory"),
    "force onto another database": ("build {p}/good -m {p}/other.db --force", "not a LIST3R memory"),
    "intrinsics of three": ("build {p}/good -m {p}/new.l3r --intrinsics 60,60,32", "--intrinsics.*four numbers"),
    "intrinsics in words": ("build {p}/good -m {p}/new.l3r --intrinsics a,b,c,d", "--intrinsics.*not a number"),
    "negative focal length": ("build {p}/good -m {p}/new.l3r --intrinsics=-60,60,32,24", "intrinsics"),
    "a transform that is none": ("build {p}/good -m {p}/new.l3r --depth-to-color 1,2", "--depth-to-color"),
    "depth scale zero": ("build {p}/good -m {p}/new.l3r --depth-scale 0", "depth scale"),
    "every zero": ("build {p}/good -m {p}/new.l3r --every 0", "every 0"),
    "frames backwards": ("build {p}/good -m {p}/new.l3r --frames 9:3", "9"),
    "frames beyond the end": ("build {p}/good -m {p}/new.l3r --frames 90:99", "90"),
    "overlap as long as the chunk": ("build {p}/good -m {p}/new.l3r --chunk 20 --overlap 20", "overlap 20"),
    "workers below none": ("build {p}/good -m {p}/new.l3r --workers -1", "--workers -1"),
    "unknown engine": ("build {p}/good -m {p}/new.l3r --engine dask", "--engine dask.*local or ray"),
    "cluster without its engine": ("build {p}/good -m {p}/new.l3r --address a:1", "--address a:1.*--engine ray"),
    "cluster in this process": ("build {p}/good -m {p}/new.l3r --engine ray --workers 0", "--workers 0.*1 or more"),
    "cluster of what is live": ("build {p}/good -m {p}/new.l3r --live --engine ray", "leave out --engine"),
    "unknown poses": ("build {p}/good -m {p}/new.l3r --poses guess", "--poses guess"),
    "unknown model": ("build {p}/good -m {p}/new.l3r --reconstruction magic", "--reconstruction magic"),
    "unknown kind": ("build {p}/good -m {p}/new.l3r --kind magic", "magic"),
    "debug folder under a file": ("build {p}/good -m {p}/new.l3r --debug {p}/note.txt/x", "note.txt"),
    "unknown option": ("build {p}/good -m {p}/new.l3r --magic", "--magic"),
    "unknown command": ("magic", "magic"),
    "edit without its group": ("label {p}/room.l3r 2 mug", "list3r edit label"),
    "no memory": ("info {p}/nothing.l3r", "does not exist"),
    "not a memory": ("info {p}/note.txt", "not a memory"),
    "another database": ("list {p}/other.db", "not a LIST3R memory"),
    "newer schema": ("list {p}/newer.l3r", "newer list3r .schema 99"),
    "torn file": ("list {p}/torn.l3r", "torn.l3r"),
    "unknown id": ("show {p}/room.l3r 77", "no instance 77"),
    "id that is no number": ("show {p}/room.l3r mug", "ID.*integer"),
    "nearest to an unknown id": ("nearest {p}/room.l3r 77", "no instance 77"),
    "nearest to nothing": ("nearest {p}/room.l3r", "--point"),
    "nearest to half a point": ("nearest {p}/room.l3r --point 1,2", "--point.*three numbers"),
    "nearest to no number": ("nearest {p}/room.l3r --point nan,0,0", "finite"),
    "no neighbours wanted": ("nearest {p}/room.l3r --point 0,0,0 -k 0", "k"),
    "within no region": ("within {p}/room.l3r", "--box.*--radius"),
    "within a negative sphere": ("within {p}/room.l3r --point 0,0,0 --radius=-1", "radius"),
    "within an inverted box": ("within {p}/room.l3r --box 1,1,1,0,0,0", "box|lower|corner"),
    "unknown predicate": ("relations {p}/room.l3r --predicate likes", "likes"),
    "similar to an unknown id": ("similar {p}/room.l3r 77", "no instance 77"),
    "unknown format": ("export {p}/room.l3r --to stl --out {p}/new.stl", "stl"),
    "export into no folder": ("export {p}/room.l3r --to json --out {p}/no/new.json", "no"),
    "export onto a folder": ("export {p}/room.l3r --to json --out {p}/empty", "empty"),
    "export onto the memory": ("export {p}/room.l3r --to json --out {p}/room.l3r", "room.l3r"),
    "trajectory that is none": ("eval trajectory {p}/note.txt {p}/room.l3r", "note.txt"),
}

MORE_CASES = {
    "go on and begin anew": ("build {p}/good -m {p}/new.l3r --resume --force", "--resume.*--force.*one of them"),
    "update: go on and give up": ("update {p}/room.l3r {p}/good --resume --force", "--resume.*--force.*one of them"),
    "chunks of no frames": ("build {p}/good -m {p}/new.l3r --chunk 0", "chunk length 0"),
    "chunks that share nothing": ("build {p}/good -m {p}/new.l3r --overlap 0", "overlap 0"),
    "weights of what has none": (
        "build {p}/good -m {p}/new.l3r --weights {p}/empty",
        "no network does the reconstruction.*--recon",
    ),
    "weights without a name": ("build {p}/good -m {p}/new.l3r --weights discovery=", "is empty"),
    "classes without a detector": ("build {p}/good -m {p}/new.l3r --detector-classes {p}/note.txt", "--detector FILE"),
    "classes that are not there": (
        "detect {p}/room.l3r --detector {p}/note.txt --detector-classes {p}/no",
        r"no cannot be read \(No such file",
    ),
    "how to read which video": ("detect {p}/room.l3r --detector {p}/x.param --every 5", "--source SOURCE"),
    "a manifest cut off": (
        "build {p}/good -m {p}/new.l3r --reconstruction precomputed --weights {p}/cut",
        "is not valid JSON",
    ),
    "a manifest without files": (
        "build {p}/good -m {p}/new.l3r --reconstruction precomputed --weights {p}/pre",
        ".npz",
    ),
    "a transform in no file": ("inspect {p}/good --depth-to-color {p}/no.txt", "no such file"),
    "depth that is not there": (
        "inspect {p}/pictures --depth-scale 5 --registered",
        "leave out --depth-scale and --reg",
    ),
    "another layout": ("inspect {p}/good --kind replica", "not in the replica layout"),
    "overlay onto a memory": ("inspect {p}/good --overlay {p}/room.l3r", "png"),
    "overlay that is named as a picture": ("inspect {p}/good --overlay {p}/memory.png", "memory file"),
    "overlay onto the source": ("inspect {p}/good --overlay {p}/good/rgb/0.png", "picture of the source"),
    "demo of one frame": ("demo --out {p}/demo --frames 1", "--frames.*greater than or equal to 2"),
    "demo of a negative seed": ("demo --out {p}/demo --seed -1", "--seed.*greater than or equal to 0"),
    "demo without workers": ("demo --out {p}/demo --workers 0", "--workers.*greater than or equal to 1"),
    "precompute onto a file": ("precompute {p}/good --out {p}/note.txt", "note.txt cannot be created.*another"),
    "precompute of broken pictures": ("precompute {p}/corrupt --out {p}/broken", "5 of 6 frames cannot be used"),
    "embed of nothing": ("embed {p}/nothing.l3r", "does not exist"),
    "more sure than sure": ("list {p}/room.l3r --min-confidence 7", "--min-confidence 7"),
    "a session of no camera": ("seen {p}/room.l3r 3 --session 9", "--session 9 needs a camera"),
    "a depth of no camera": ("seen {p}/room.l3r 3 --max-depth 3", "--max-depth belongs to a camera"),
    "a session of a box": ("within {p}/room.l3r --box 0,0,0,1,1,1 --session 9", "--session 9 needs a camera"),
    "who looks": ("find {p}/room.l3r mug --from here", "viewpoint 'here'"),
    "sizes that leave nothing": (
        "nearest {p}/room.l3r mug --min-size 3 --max-size 1",
        "min_size 3 above max_size 1",
    ),
    "repair onto itself": ("repair {p}/torn.l3r --out {p}/torn.l3r", "the damaged file itself"),
    "repair of a later memory": ("repair {p}/later.l3r", "update list3r"),
    "repair of another database": ("repair {p}/other.db", "not a LIST3R memory"),
    "covisibility that is none": ("eval revisits {p}/cut.npz {p}/room.l3r", "not a covisibility file"),
    "every zero of a cloud": ("eval cloud {p}/good {p}/room.l3r --every 0", "--every.*greater than or equal to 1"),
    "every zero of revisits": ("eval revisits {p}/good {p}/room.l3r --every 0", "--every.*greater than or equal to 1"),
    "times that never meet": (
        "eval trajectory {p}/good {p}/room.l3r --tolerance nan",
        "--tolerance.*greater than or equal to 0",
    ),
}


AS_USER = ("not a video", "all corrupt", "memory exists")
"""Cases that run as a process too: libraries that print by themselves, and the exit status."""


@pytest.mark.slow
@pytest.mark.parametrize("case", [*CASES, *MORE_CASES])
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(
    case: str, place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command, pattern = (CASES | MORE_CASES)[case]
    before = {p: p.stat().st_mtime_ns for p in place.iterdir() if p.is_file()}
    words = [word.format(p=place) for word in command.split()]
    status = run(words)
    told = capfd.readouterr()
    check_refused(subprocess.CompletedProcess(words, status, told.out, told.err), pattern)
    if case in AS_USER:
        check_refused(as_user(*words), pattern)
    assert {p: p.stat().st_mtime_ns for p in place.iterdir() if p.is_file()} == before
    assert not (place / "new.l3r").exists()


def test_a_full_disk_is_named_and_nothing_half_written_is_left(place: Path, tmp_path: Path) -> None:
    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    result = as_user("build", place / "good", "-m", tmp_path / "new.l3r", "--workers", "1", before=small_files)
    check_refused(result, "disk.*--resume")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["build {p}/good -m {pipe}", "build {p}/good -m {pipe} --force", "info {pipe}"])
def test_what_is_no_ordinary_file_stays_what_it_is(command: str, place: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    check_refused(in_process(*(word.format(p=place, pipe=pipe) for word in command.split())), "device or pipe")
    assert pipe.is_fifo()


def test_verify_says_of_a_torn_file_that_it_is_damaged(place: Path) -> None:
    result = in_process("verify", place / "torn.l3r", "--json")
    assert result.returncode == 1
    assert json.loads(result.stdout)["matches"][0]["sound"] is False
    assert result.stderr == ""


@pytest.mark.parametrize("command", ["verify {p}/note.txt", "verify {p}/other.db", "verify {p}/newer.l3r"])
def test_verify_of_what_is_no_memory_is_wrong_input(command: str, place: Path) -> None:
    check_refused(in_process(*(word.format(p=place) for word in command.split())), "not a|update list3r")


def test_a_memory_that_cannot_be_read_is_named(place: Path, tmp_path: Path) -> None:
    loop = tmp_path / "loop.l3r"
    loop.symlink_to(loop)
    check_refused(in_process("info", loop), "loop.l3r")


@pytest.mark.parametrize("arguments", [(), ("edit",), ("eval",)])
def test_without_a_command_the_help_is_shown(arguments: tuple[str, ...]) -> None:
    result = in_process(*arguments)
    assert "Usage: list3r" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr


def test_the_name_of_a_format_leads_to_export() -> None:
    found = in_process("plan", "house.l3r")
    assert found.returncode == 2
    assert "list3r export MEMORY --to plan" in found.stderr

"""Every format that can be read, by one table: a new reader is held to the same law at once."""

from __future__ import annotations

import json
import random
import re
import zipfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from list3r.cli.app import run
from list3r.frames.base import BadFrame
from list3r.frames.options import KINDS, SourceOptions
from list3r.frames.source import FOLDERS, open_source
from list3r.memory.core.errors import List3rError
from tests import recordings, recordings_robots
from tests.frames_scenes import write_replica, write_seven_scenes, write_tum

Members = dict[str, bytes]


def write_images(root: Path) -> Path:
    for k, shot in enumerate(recordings.shots()):
        recordings.put(root / f"images/{k}.jpg", recordings.jpeg(shot.color))
        depth = recordings.plane_depth(shot.T_world_cam, recordings.K, shot.color.shape[:2])
        recordings.put(root / f"depth/{k}.png", recordings.png(recordings.millimetres(depth)))
    rows = [" ".join(map(str, shot.T_world_cam.ravel())) for shot in recordings.shots()]
    recordings.put(root / "poses.txt", "\n".join(rows))
    return root


def write_film(root: Path) -> Path:
    root.mkdir(parents=True)
    recordings_robots.write_video(root / "walk.mp4", [shot.color for shot in recordings.shots()])
    return root / "walk.mp4"


def write_spool(root: Path) -> Path:
    for k, shot in enumerate(recordings.shots()):
        recordings.put(root / f"rgb/{k}.jpg", recordings.jpeg(shot.color))
    recordings.put(root / "frames.txt", "".join(f"{k / 15:.6f} rgb/{k}.jpg\n" for k in range(recordings.COUNT)))
    return root


def write_phone_spool(root: Path) -> Path:
    """What is kept of Record3D over USB."""
    with zipfile.ZipFile(recordings.write_record3d(root / "whole")) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    (root / "whole/walk.r3d").unlink()
    (root / "whole").rmdir()
    said = json.loads(members.pop("metadata"))
    for name, data in members.items():
        recordings.put(root / name.replace("rgbd/", "rgb/"), data)
    rows = [f"{k / 15:.6f} rgb/{k}.jpg {' '.join(map(str, pose))}\n" for k, pose in enumerate(said["poses"])]
    recordings.put(root / "frames.txt", "".join(rows))
    recordings.put(root / "metadata", json.dumps({key: said[key] for key in ("w", "h", "dw", "dh", "K")}))
    return root


FORMATS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "record3d": (recordings.write_record3d, "lzfse"),
    "stray": (recordings.write_stray, ""),
    "record3d exr": (recordings.write_record3d_exr, ""),
    "polycam": (recordings.write_polycam, ""),
    "scannerapp": (recordings.write_scannerapp, ""),
    "arkitscenes": (recordings.write_arkitscenes, ""),
    "scannet": (recordings.write_scannet, ""),
    "scannet .sens": (recordings.write_sens, ""),
    "scannetpp": (recordings.write_scannetpp, "lz4"),
    "rosbag": (recordings.write_bag, "rosbags"),
    "rosbag db3": (lambda root: recordings.write_bag(root, "db3"), "rosbags"),
    "rosbag .bag": (lambda root: recordings.write_bag(root, "bag"), "rosbags"),
    "lerobot": (lambda root: recordings_robots.write_lerobot(root, wrist=False), "pyarrow"),
    "euroc": (recordings.write_euroc, ""),
    "nerfstudio": (recordings.write_nerfstudio, ""),
    "7scenes": (lambda root: write_seven_scenes(root, count=3), ""),
    "tum": (lambda root: write_tum(root, count=3), ""),
    "replica": (write_replica, ""),
    "colmap": (recordings.write_colmap, ""),
    "colmap binary": (lambda root: recordings.write_colmap(root, binary=True), ""),
    "colmap rig": (recordings_robots.write_colmap_rig, ""),
    "images": (write_images, ""),
    "video": (write_film, ""),
    "live": (write_spool, ""),
    "live record3d": (write_phone_spool, "lzfse"),
}
"""By kind, and what else tells the writer: a recording of that format, and the package that it takes."""
WITHOUT_WRITER = {"aria": "no package writes the streams of Aria glasses; tests/test_frames_aria.py holds its parts"}
OPTIONS = {
    "lerobot": SourceOptions(episode=1),
    "images": SourceOptions(depth_scale=1000.0),
    "tum": SourceOptions(intrinsics=(70.0, 70.0, 39.5, 29.5)),
}
TELL_THEMSELVES = ("lerobot", "rosbag")
"""Name features and topics that are not read, not files."""
NUMBER = re.compile(rb"-?\d+\.\d+(e-?\d+)?")


def test_every_kind_is_in_the_table() -> None:
    written = {name.split(" ")[0] for name in FORMATS}
    assert written | set(WITHOUT_WRITER) == {*KINDS, *FOLDERS} - {"auto"}


@pytest.fixture(params=FORMATS)
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    write, package = FORMATS[request.param]
    if package and find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    return request.param, write(tmp_path / "whole" / "walk")


@pytest.mark.slow
def test_a_damaged_member_is_a_bad_frame_or_one_clear_line(recording: tuple[str, Path], tmp_path: Path) -> None:
    name, path = recording
    options = OPTIONS.get(name, SourceOptions())
    assert look(path, options) is None
    for number, (damage, members) in enumerate(damaged(members_of(path))):
        place = write_members(tmp_path / f"damaged-{number}", path, members)
        before = sorted(tmp_path.rglob("*"))
        said = look(place, options)
        assert said is None or ("\n" not in said and 10 < len(said) < 500), (damage, said)
        assert sorted(tmp_path.rglob("*")) == before, damage


def test_a_recording_of_nothing_but_noise_is_refused_and_leaves_nothing(
    recording: tuple[str, Path], tmp_path: Path
) -> None:
    _, path = recording
    noise = {name: random.Random(name).randbytes(len(data)) for name, data in members_of(path).items()}
    place = write_members(tmp_path / "noise", path, noise)
    before = sorted(tmp_path.rglob("*"))
    assert run(["build", str(place), "-m", str(tmp_path / "a.l3r"), "--workers", "0"]) == 2
    assert sorted(tmp_path.rglob("*")) == before


def test_what_lies_in_a_recording_and_is_not_read_is_named(recording: tuple[str, Path], tmp_path: Path) -> None:
    name, path = recording
    members = members_of(path)
    if len(members) == 1 or name.split(" ")[0] in TELL_THEMSELVES:
        pytest.skip("a file without members, or one whose reader tells it in its own words")
    place = write_members(tmp_path / "more", path, {**members, "motion9.imu": b"x", "scan9/room.glb": b"x"})
    notes = open_source(place, OPTIONS.get(name, SourceOptions())).info.notes
    (said,) = [note for note in notes if note.startswith("not read: ")]
    assert "motion9.imu" in said and "scan9" in said, said


def look(path: Path, options: SourceOptions) -> str | None:
    """Read a source from end to end: what it is refused with, None where it is read."""
    try:
        source = open_source(path, options)
        for frame in source.read(0, source.info.frame_count):
            if isinstance(frame, BadFrame):
                assert frame.reason and "\n" not in frame.reason
                continue
            assert frame.depth is None or (np.isfinite(frame.depth).all() and (frame.depth >= 0).all())
            assert frame.depth is None or frame.depth.shape == frame.color.shape[:2]
            T = frame.T_source_cam
            assert T is None or np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    except List3rError as error:
        return str(error)
    return None


def damaged(members: Members) -> Iterator[tuple[str, Members]]:
    """Recordings in which a member, or all of its kind, are missing, empty, cut off, noise, or without numbers."""
    for group in groups(members):
        for all_of_it in (False, True):
            names = group if all_of_it else group[len(group) // 2 : len(group) // 2 + 1]
            if all_of_it and len(group) == 1:
                continue
            whose = f"{'all ' if all_of_it else ''}{names[0]}"
            yield f"{whose} missing", {k: v for k, v in members.items() if k not in names}
            changes: dict[str, Callable[[bytes], bytes]] = {
                "empty": lambda data: b"",
                "cut off": lambda data: data[: len(data) // 2],
                "noise": lambda data: random.Random(len(data)).randbytes(len(data)),
                "without numbers": lambda data: NUMBER.sub(b"nan", data),
            }
            for damage, change in changes.items():
                new = {k: change(v) if k in names else v for k, v in members.items()}
                if new != members:
                    yield f"{whose} {damage}", new
    if members:
        yield "a name that leads out", {**members, "../../../evil": b"x"}


def groups(members: Members) -> list[list[str]]:
    """Names by folder and ending."""
    found: dict[tuple[str, str], list[str]] = {}
    for name in sorted(members):
        found.setdefault((str(Path(name).parent), Path(name).suffix), []).append(name)
    return list(found.values())


def members_of(path: Path) -> Members:
    """Members of a folder, of a zip, or the one file."""
    if path.is_dir():
        return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    return {path.name: path.read_bytes()}


def write_members(root: Path, like: Path, members: Members) -> Path:
    """Write members as they were, a folder or a file; only an archive can hold a name that leads out."""
    root.mkdir()
    place = root / like.name
    if like.suffix == ".r3d":
        with zipfile.ZipFile(place, "w") as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return place
    folder = place if like.is_dir() else root
    for name, data in members.items():
        if ".." not in name:
            recordings.put(folder / name, data)
    return place

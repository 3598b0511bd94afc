"""Recordings of phones and tools: after reading, depth through every pose lies on the wall that was filmed."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import BadFrame, Camera, Frame, SourceInfo
from list3r.frames.decoding.decode import sure_depth
from list3r.frames.inspection import SourceReport
from list3r.frames.options import SourceOptions
from list3r.frames.readers.phones.record3d import PhoneCamera
from list3r.frames.source import open_source
from list3r.memory.core.errors import List3rError, SourceError
from tests.recordings import (
    COUNT,
    DEPTH_HEIGHT,
    DEPTH_WIDTH,
    WITH_DEPTH,
    arkit,
    off_plane,
    png,
    put,
    shots,
    write_arkitscenes,
    write_colmap,
    write_euroc,
    write_nerfstudio,
    write_polycam,
    write_record3d,
    write_scannet,
    write_scannetpp,
    write_sens,
    write_stray,
)
from tests.recordings_robots import T_RIG_SIDE, write_colmap_rig


def frames_of(path: Path, **options: object) -> list[Frame]:
    source = open_source(path, SourceOptions(**options))  # type: ignore[arg-type]
    found = list(source.read(0, source.info.frame_count))
    assert all(isinstance(f, Frame) for f in found), [f for f in found if isinstance(f, BadFrame)]
    return [f for f in found if isinstance(f, Frame)]


def world_points(frame: Frame, camera: object) -> np.ndarray:
    assert frame.depth is not None and frame.T_source_cam is not None
    row, column = np.nonzero(frame.depth > 0)
    z = frame.depth[row, column].astype(float)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(z))], 1)  # type: ignore[attr-defined]
    return (z[:, None] * rays) @ frame.T_source_cam[:3, :3].T + frame.T_source_cam[:3, 3]


@pytest.mark.parametrize("kind", WITH_DEPTH)
def test_depth_through_every_pose_lies_on_the_wall(kind: str, tmp_path: Path) -> None:
    path = WITH_DEPTH[kind](tmp_path / "walk")
    info = open_source(path).info
    assert info.has_depth and info.has_poses and info.scale_kind == "metric" and info.frame_count == COUNT
    assert info.kind == {"sens": "scannet"}.get(kind, kind)
    for frame, shot in zip(frames_of(path), shots(), strict=True):
        off = off_plane(world_points(frame, info.camera))
        # depth is moved by at most half a colour pixel, which the tilted wall turns into some millimetres
        # (and depth that is finer than the pictures, of ScanNet++, by more than one that is coarser)
        assert np.median(off) < (0.003 if kind == "scannetpp" else 0.002) and np.quantile(off, 0.95) < 0.012
        assert len(off) > 0.5 * frame.color.shape[0] * frame.color.shape[1]
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)


@pytest.mark.parametrize("kind", WITH_DEPTH)
def test_a_recording_opens_again_alike_and_tells_its_poses(kind: str, tmp_path: Path) -> None:
    path = WITH_DEPTH[kind](tmp_path / "walk")
    first, again = open_source(path), open_source(path)
    assert first.info.fingerprint == again.info.fingerprint
    poses = first.read_poses()  # type: ignore[attr-defined]
    assert [k for k, _, _ in poses] == list(range(COUNT))
    second = next(iter(again.read(1, 2)))
    assert isinstance(second, Frame) and np.allclose(second.T_source_cam, poses[1][2])


def test_what_the_sensor_is_not_sure_of_is_unknown(tmp_path: Path) -> None:
    sure = frames_of(write_record3d(tmp_path / "a"))[0].depth
    half = frames_of(write_record3d(tmp_path / "b", left=1))[0].depth
    assert sure is not None and half is not None
    width = sure.shape[1]
    assert (half[:, : width // 2 - 2] == 0).all() and (half[:, width // 2 + 3 :] > 0).mean() > 0.9


@pytest.mark.parametrize("code", [1, 127])
@pytest.mark.parametrize("write", [write_stray, write_polycam, write_arkitscenes])
def test_confidence_in_either_code_says_the_same(write: Callable[[Path], Path], code: int, tmp_path: Path) -> None:
    path = write(tmp_path / "walk")
    files = [p for p in path.rglob("*.png") if p.parent.name == "confidence"]
    levels = np.tile(np.repeat(np.array([0, 1, 2], np.uint8), DEPTH_WIDTH // 3), (DEPTH_HEIGHT, 1))
    levels = np.pad(levels, ((0, 0), (0, DEPTH_WIDTH - levels.shape[1])), mode="edge")
    for file in files:
        put(file, png((levels * np.float32(code if code == 1 else 127.5)).astype(np.uint8)))
    depth = frames_of(path)[0].depth
    assert depth is not None
    third = depth.shape[1] // 3
    assert (depth[:, : third - 4] == 0).all() and (depth[:, third + 4 :] > 0).mean() > 0.9
    for file in files:
        put(file, png(np.zeros((DEPTH_HEIGHT, DEPTH_WIDTH), np.uint8)))
    assert any("not sure of any depth" in note for note in open_source(path).info.notes)


def test_half_sure_in_either_code_is_not_sure(tmp_path: Path) -> None:
    raw = np.full((1, 3), 7, np.uint16)
    for code in (np.array([[0, 1, 2]], np.uint8), np.array([[0, 127, 255]], np.uint8)):
        assert sure_depth(raw, code, 1).tolist() == [[0, 7, 7]] and sure_depth(raw, code, 2).tolist() == [[0, 0, 7]]


def test_the_front_camera_of_a_phone_has_no_poses(tmp_path: Path) -> None:
    info = open_source(write_record3d(tmp_path, poses=[[0, 0, 0, 1, 0, 0, 0]] * COUNT)).info
    assert not info.has_poses and info.has_depth and any("front camera" in note for note in info.notes)
    size = {"w": 720, "h": 960, "dw": 720, "dh": 960, "K": [600, 0, 0, 0, 600, 0, 360, 480, 1]}
    assert PhoneCamera.of(tmp_path, size).depth_size == (960, 720)


def test_an_unpacked_recording_reads_as_the_file_does(tmp_path: Path) -> None:
    packed = write_record3d(tmp_path / "a")
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path / "b")
    for one, other in zip(frames_of(packed), frames_of(tmp_path / "b"), strict=True):
        assert (one.depth == other.depth).all() and (one.color == other.color).all()


def test_a_model_of_colmap_has_poses_in_its_own_unit(tmp_path: Path) -> None:
    for binary in (False, True):
        path = write_colmap(tmp_path / str(binary), binary=binary)
        info = open_source(path).info
        assert info.kind == "colmap" and info.has_poses and not info.poses_metric and not info.has_depth
        assert info.camera is not None and info.camera.cx == pytest.approx(79.5)
        for frame, shot in zip(frames_of(path), shots(), strict=True):
            expected = shot.T_world_cam.copy()
            expected[:3, 3] *= 3
            assert np.allclose(frame.T_source_cam, expected, atol=1e-6)


def test_a_camera_stated_for_other_pixels_is_brought_to_the_pictures(tmp_path: Path) -> None:
    doubled = {"fl_x": 280.0, "fl_y": 280.0, "cx": 159.5, "cy": 119.5, "w": 320, "h": 240}
    info = open_source(write_nerfstudio(tmp_path / "walk", **doubled)).info
    assert info.camera is not None
    assert (info.camera.fx, info.camera.cx, info.camera.cy) == pytest.approx((140.0, 79.5, 59.5))


def test_a_camera_stated_for_turned_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="120x160; they are turned"):
        open_source(write_nerfstudio(tmp_path / "walk", w=120, h=160, cx=59.5, cy=79.5))


def test_a_mask_takes_depth_away(tmp_path: Path) -> None:
    path = write_nerfstudio(tmp_path / "walk")
    content = json.loads((path / "transforms.json").read_text())
    from tests.recordings import png

    shown = np.full((120, 160), 255, np.uint8)
    shown[:60] = 0
    put(path / "masks/0.png", png(shown))
    content["frames"][0]["mask_path"] = "masks/0.png"
    put(path / "transforms.json", json.dumps(content))
    depth = frames_of(path)[0].depth
    assert depth is not None and (depth[:60] == 0).all() and (depth[62:] > 0).mean() > 0.9


def test_frames_that_lost_tracking_have_no_pose(tmp_path: Path) -> None:
    frames = frames_of(write_sens(tmp_path, lost=2))
    assert [f.T_source_cam is None for f in frames] == [False, False, True, False]
    poses = [[0, 0, 0, 1, 0, 0, 0]] * (COUNT - 1) + [[0, 0, 0, float("nan"), 0, 0, 0]]
    assert frames_of(write_record3d(tmp_path / "r", poses=poses))[-1].T_source_cam is None


def test_optimised_cameras_of_polycam_are_preferred(tmp_path: Path) -> None:
    path = write_polycam(tmp_path / "walk")
    for name in ("images", "cameras"):
        (path / "keyframes" / name).rename(path / "keyframes" / f"corrected_{name}")
    assert any("optimised" in note for note in open_source(path).info.notes)
    assert len(frames_of(path)) == COUNT


def test_pictures_of_a_fisheye_become_those_of_a_pinhole(tmp_path: Path) -> None:
    lens = {"k1": 0.1, "k2": -0.02, "k3": 0.01, "k4": 0.0}
    path = write_nerfstudio(tmp_path / "walk", camera_model="OPENCV_FISHEYE", **lens)
    column, row = np.meshgrid(np.arange(160), np.arange(120))
    where = np.stack([column, row, np.zeros_like(row)], axis=2).astype(np.uint8)
    for picture in (path / "images").iterdir():
        put(picture.with_suffix(".png"), png(where[:, :, ::-1]))
        picture.unlink()
    said = json.loads((path / "transforms.json").read_text())
    for frame in said["frames"]:
        frame["file_path"] = frame["file_path"].replace(".jpg", ".png")
        del frame["depth_file_path"]
    put(path / "transforms.json", json.dumps(said))
    shutil.rmtree(path / "depth")
    seen = frames_of(path)[0].color.astype(float)
    x, y = (np.array([100, 60, 40]) - 79.5) / 140, (np.array([60, 90, 30]) - 59.5) / 140
    angle = np.arctan(np.hypot(x, y))
    bent = angle * (1 + 0.1 * angle**2 - 0.02 * angle**4 + 0.01 * angle**6) / np.hypot(x, y)
    found = seen[[60, 90, 30], [100, 60, 40]]
    assert np.abs(found[:, 0] - (140 * x * bent + 79.5)).max() < 1.0
    assert np.abs(found[:, 1] - (140 * y * bent + 59.5)).max() < 1.0


def test_scans_of_either_packing_are_read_and_one_that_is_neither_refused(tmp_path: Path) -> None:
    one, other = (write_scannetpp(tmp_path / p, packed=p) for p in ("lz4", "deflate"))
    for a, b in zip(frames_of(one), frames_of(other), strict=True):
        assert a.depth is not None and b.depth is not None and np.abs(a.depth - b.depth).max() < 6e-4
    assert [f.index for f in frames_of(one / "iphone")] == list(range(COUNT))
    put(one / "iphone/depth.bin", (5).to_bytes(4, "little") + b"noise")
    with pytest.raises(SourceError, match="no known way"):
        open_source(one)
    put(other / "iphone/depth.bin", b"\xff" * 64)
    with pytest.raises(SourceError, match="toolkit"):
        open_source(other)


def test_pictures_with_cameras_of_their_own_are_carried_to_one(tmp_path: Path) -> None:
    root = write_colmap(tmp_path)
    model = root / "sparse/0"
    column, row = np.meshgrid(np.arange(200), np.arange(150))
    cameras = []
    for k, focal in enumerate((120.0, 140.0, 160.0, 140.0)):
        width, height = (160, 120) if k != 2 else (164, 122)
        cameras.append(f"{k + 1} PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}")
        where = np.stack([column, row, np.zeros_like(row)], axis=2)[:height, :width].astype(np.uint8)
        put(root / f"images/{k:04d}.png", png(where[:, :, ::-1]))
        (root / f"images/{k:04d}.jpg").unlink()
    put(model / "cameras.txt", "\n".join(cameras) + "\n")
    lines = [line for line in (model / "images.txt").read_text().replace(".jpg", ".png").splitlines() if line]
    own = [f"{line.rsplit(' ', 2)[0]} {k + 1} {k:04d}.png\n\n" for k, line in enumerate(lines)]
    put(model / "images.txt", "".join(own))
    info, frames = open_source(root).info, frames_of(root)
    assert info.camera is not None and info.camera.fx == pytest.approx(140.0)
    assert [f.color.shape for f in frames] == [(120, 160, 3)] * 4
    for frame, focal, middle in zip(frames, (120.0, 140.0, 160.0, 140.0), (79.5, 79.5, 81.5, 79.5), strict=True):
        for u in (60, 100):  # the ray of a pixel of the shared camera, seen by the picture's own
            assert abs(frame.color[60, u, 0] - (focal * (u - 79.5) / 140.0 + middle)) < 1.0


@pytest.mark.parametrize("binary", [True, False])
def test_cameras_of_a_rig_stand_where_it_holds_them(binary: bool, tmp_path: Path) -> None:
    path = write_colmap_rig(tmp_path, binary=binary)
    info, frames = open_source(path).info, frames_of(path)
    assert any("2 cameras of rigs" in note for note in info.notes) and len(frames) == 2 * COUNT
    for k, shot in enumerate(shots()):  # one camera after the other, though their names take turns
        assert np.allclose(frames[k].T_source_cam, shot.T_world_cam, atol=1e-6)
        assert np.allclose(frames[COUNT + k].T_source_cam, shot.T_world_cam @ T_RIG_SIDE, atol=1e-6)


def _short(path: Path, name: str, missing: int) -> Path:
    file = path / "sparse/0" / name
    file.write_bytes(file.read_bytes()[:-missing])
    return path


def _uncalibrated(path: Path) -> Path:
    file = path / "sparse/0/rigs.txt"
    head, _, _ = file.read_text().rpartition("CAMERA 2")
    return _put(file, f"{head}CAMERA 2 0\n").parents[2]


def _without(path: Path, name: str) -> Path:
    (path / "sparse/0" / name).unlink()
    return path


BROKEN = {
    "a rig that is cut off": lambda root: _short(write_colmap_rig(root), "rigs.bin", 8),
    "frames that are cut off": lambda root: _short(write_colmap_rig(root), "frames.bin", 40),
    "cameras that are cut off": lambda root: _short(write_colmap(root, binary=True), "cameras.bin", 4),
    "a rig that is missing": lambda root: _without(write_colmap_rig(root), "rigs.bin"),
    "frames that are missing": lambda root: _without(write_colmap_rig(root), "frames.bin"),
    "a camera with no place on its rig": lambda root: _uncalibrated(write_colmap_rig(root, binary=False)),
    "a zip without metadata": lambda root: _zip(root / "a.r3d", {"rgbd/0.jpg": b"x"}),
    "a zip that ends early": lambda root: _cut(write_record3d(root)),
    "metadata that is no JSON": lambda root: _zip(root / "a.r3d", {"metadata": b"{", "rgbd/0.jpg": b"x"}),
    "metadata without a camera": lambda root: _zip(root / "a.r3d", {"metadata": b"{}", "rgbd/0.jpg": b"x"}),
    "a camera of no numbers": lambda root: write_record3d(root, K=["a"] * 9),
    "depth of an absurd size": lambda root: write_record3d(root, dw=10**6, dh=10**6),
    "a sens file of noise": lambda root: _put(root / "a.sens", b"\xff" * 400),
    "a sens file cut in its header": lambda root: _cut(write_sens(root), 100),
    "transforms without frames": lambda root: _put(root / "transforms.json", "{}").parent,
    "a name that leads out": lambda root: write_nerfstudio(root, frames=[{"file_path": "../../etc/passwd"}]),
    "a camera of all directions": lambda root: write_nerfstudio(root, camera_model="EQUIRECTANGULAR"),
    "units of nothing": lambda root: write_nerfstudio(root, depth_unit_scale_factor=0),
    "a camera of stray that is none": lambda root: _put(write_stray(root) / "camera_matrix.csv", "1,2\n").parent,
    "odometry of words": lambda root: _put(write_stray(root) / "odometry.csv", "head\n" + "a," * 9).parent,
    "a camera of polycam that is none": lambda root: _polycam_camera(root, "{}"),
    "a camera matrix of scannet that is none": lambda root: _put(
        write_scannet(root) / "intrinsic/intrinsic_depth.txt", "1 2\n"
    ).parents[1],
    "a model of colmap of noise": lambda root: _put(write_colmap(root) / "sparse/0/cameras.txt", "1 NO 2\n").parents[2],
}


def _put(path: Path, data: bytes | str) -> Path:
    put(path, data)
    return path


def _zip(path: Path, members: dict[str, bytes]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def _cut(path: Path, count: int | None = None) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: count or len(data) // 2])
    return path


def _polycam_camera(root: Path, text: str) -> Path:
    path = write_polycam(root)
    for camera in (path / "keyframes/cameras").iterdir():
        camera.write_text(text)
    return path


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_one_clear_line(name: str, tmp_path: Path) -> None:
    path = BROKEN[name](tmp_path / "walk")
    with pytest.raises(List3rError) as caught:
        open_source(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_members_that_are_damaged_are_bad_frames(tmp_path: Path) -> None:
    path = write_sens(tmp_path)
    data = bytearray(path.read_bytes())
    place = data.rfind(b"\x78\x9c")  # the last depth image
    data[place + 2 : place + 40] = b"\x00" * 38
    path.write_bytes(data)
    source = open_source(path)
    found = list(source.read(0, COUNT))
    assert [isinstance(f, BadFrame) for f in found] == [False, False, False, True]


def test_a_sens_file_that_ends_early_gives_the_frames_it_has(tmp_path: Path) -> None:
    path = write_sens(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    info = open_source(path).info
    assert info.frame_count == COUNT - 1 and any("ends after 3 of 4 frames" in note for note in info.notes)


def test_depth_that_unpacks_to_far_more_than_it_should_is_a_bad_frame(tmp_path: Path) -> None:
    import lzfse

    path = write_record3d(tmp_path)
    with zipfile.ZipFile(path) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    members["rgbd/3.depth"] = lzfse.compress(bytes(40_000_000))
    _zip(path, members)
    found = list(open_source(path).read(0, COUNT))
    assert [isinstance(f, BadFrame) for f in found] == [False, False, False, True]


def test_depth_and_poses_are_not_lost_without_a_word(tmp_path: Path) -> None:
    path = write_stray(tmp_path / "walk")
    with pytest.raises(SourceError, match="give the folder"):
        open_source(path / "rgb.mp4")
    assert open_source(path / "rgb.mp4", SourceOptions(kind="video")).info.kind == "video"
    with pytest.raises(SourceError, match="use nerfstudio"):
        open_source(write_nerfstudio(tmp_path / "n"), SourceOptions(kind="images"))


def test_arkit_poses_are_flipped_once(tmp_path: Path) -> None:
    T = shots()[2].T_world_cam
    from list3r.frames.recordings.axes import pose_of_arkit

    assert np.allclose(pose_of_arkit(arkit(T)), T)
    assert not np.allclose(pose_of_arkit(T), T)


def test_poses_of_a_body_are_carried_to_its_camera(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "walk")
    info = open_source(path).info
    assert info.kind == "euroc" and info.has_poses and info.fps == pytest.approx(20.0)
    for frame, shot in zip(frames_of(path), shots(), strict=True):
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)
    put(path / "mav0/cam0/sensor.yaml", "intrinsics: [1, 2]\n")
    with pytest.raises(SourceError, match="four numbers fx,fy,cx,cy"):
        open_source(path)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (write_record3d, ("in metres, seen from where the colour is", "--poses prior", "metric, by the depth")),
        (write_euroc, ("none", "--poses given", "metric, by the poses")),
        (write_colmap, ("none", "--poses given", "relative, in the unit of the poses")),
    ],
)
def test_what_build_makes_of_a_source_is_said(
    write: Callable[[Path], Path], said: tuple[str, ...], tmp_path: Path
) -> None:
    lines = SourceReport(open_source(write(tmp_path / "walk")).info).lines()
    told = [next(line for line in lines if line.startswith(name)) for name in ("depth", "poses", "scale")]
    assert all(part in line for part, line in zip(said, told, strict=True)), told


def test_what_is_needed_is_told_from_what_would_help() -> None:
    def missing(depth: bool, camera: Camera | None) -> tuple[str, ...]:
        return SourceInfo("tum", "walk", 9, 30.0, camera, depth, False, "").missing

    assert missing(True, Camera(64, 48, 60.0, 60.0, 31.5, 23.5)) == ()
    assert "give --intrinsics" in missing(True, None)[0]
    assert "build estimates them" in missing(False, None)[1]

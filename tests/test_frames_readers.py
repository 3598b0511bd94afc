"""Every layout of folder gives the frames, cameras and poses that were written to it."""

from __future__ import annotations

import copy
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame, FrameSource
from list3r.frames.inspection import SourceReport, draw_registration
from list3r.frames.readers.tum import associate, poses_at
from list3r.frames.source import SourceOptions, check_bad_share, open_source, require_camera
from list3r.memory.core.errors import ExportError, OptionError, SourceError
from tests.frames_scenes import (
    color_image,
    depth_image,
    moved,
    write_png,
    write_replica,
    write_seven_scenes,
    write_tum,
)


def frames_of(source: FrameSource, start: int = 0, stop: int | None = None) -> list[Frame]:
    found = list(source.read(start, source.info.frame_count if stop is None else stop))
    assert all(isinstance(f, Frame) for f in found), found
    return [f for f in found if isinstance(f, Frame)]


def test_seven_scenes_is_registered_and_posed_at_the_colour_camera(tmp_path: Path) -> None:
    source = open_source(write_seven_scenes(tmp_path / "s"))
    info = source.info
    assert (info.kind, info.frame_count, info.has_depth, info.has_poses, info.scale_kind) == (
        "7scenes",
        4,
        True,
        True,
        "metric",
    )
    assert info.camera is not None and info.camera.fx == 524.0 and not info.camera.distortion
    assert info.depth_camera is not None and info.T_color_depth is not None
    frames = frames_of(source)
    assert [f.index for f in frames] == [0, 1, 2, 3] and frames[3].time_s == pytest.approx(0.1)
    for k, frame in enumerate(frames):
        assert frame.color.shape == (480, 640, 3) and frame.depth is not None
        known = frame.depth[frame.depth > 0]
        assert known.size > 0.75 * 640 * 480 and np.allclose(known, 1.5, atol=1e-6)
        # p_depth = p_color - t, so the colour camera stands at -t in the depth camera's frame.
        expected = moved(0.1 * k, 0, 0) @ np.linalg.inv(info.T_color_depth)
        np.testing.assert_allclose(frame.T_source_cam, expected, atol=1e-9)


def test_seven_scenes_naming_with_another_camera_is_taken_as_registered(tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "s", nominal=570.0)
    source = open_source(root)
    assert source.info.depth_camera is None and require_camera(source.info).fx == 570.0
    np.testing.assert_allclose(frames_of(source)[2].T_source_cam, moved(0.2, 0, 0))
    said = open_source(write_seven_scenes(tmp_path / "k"), SourceOptions(registered=True))
    assert said.info.depth_camera is None and require_camera(said.info).fx == 585.0


def test_a_sequence_may_lie_one_folder_down_but_only_one(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "seq-01", 2)
    assert open_source(tmp_path).info.frame_count == 2
    write_seven_scenes(tmp_path / "seq-02", 2)
    with pytest.raises(SourceError, match="seq-01"):
        open_source(tmp_path)


def test_tum_is_brought_together_by_time(tmp_path: Path) -> None:
    source = open_source(write_tum(tmp_path / "walk"), SourceOptions(intrinsics=(70, 70, 39.5, 29.5)))
    frames = frames_of(source)
    assert source.info.kind == "tum" and source.info.fps == pytest.approx(10.0)
    for k, frame in enumerate(frames):
        assert frame.time_s == pytest.approx(10.0 + 0.1 * k)
        np.testing.assert_array_equal(frame.color, color_image(k)[..., ::-1])
        assert frame.depth is not None and np.allclose(frame.depth, 1.0 + 0.1 * k, atol=1e-4)
        assert frame.T_source_cam is not None and frame.T_source_cam[0, 3] == pytest.approx(0.1 * k, abs=1e-6)


def test_tum_leaves_out_and_counts_colour_without_depth(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "walk")
    lines = (root / "depth.txt").read_text().splitlines()
    (root / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]) + "\n")
    info = open_source(root, SourceOptions(intrinsics=(70, 70, 39.5, 29.5))).info
    assert info.frame_count == 4 and any("1 of 5" in note for note in info.notes)


def test_association_is_one_to_one_within_the_gap() -> None:
    pairs = associate(np.array([0.0, 0.01, 1.0, 2.0]), np.array([0.008, 1.03, 2.015]), 0.02)
    assert pairs.tolist() == [[1, 0], [3, 2]]
    assert associate(np.array([0.0]), np.array([0.01]), 0.02).tolist() == [[0, 0]]


def test_poses_are_interpolated_over_short_gaps_and_absent_over_long_ones() -> None:
    half_turn = [0, 0, np.sin(0.1), np.cos(0.1)]
    poses = np.array([[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, *half_turn], [5, 0, 0, 0, 0, 0, 1]], float)
    found = poses_at(np.array([0.01, 0.05, 0.11, 0.5, 0.995, 2.0]), np.array([0.0, 0.1, 1.0]), poses)
    first, middle = found[0], found[1]
    assert first is not None and middle is not None and first[0, 3] == pytest.approx(0.1)
    assert np.arctan2(middle[1, 0], middle[0, 0]) == pytest.approx(0.1)
    assert found[2] is not None and found[2][0, 3] == 1.0
    assert found[3] is None and found[4] is not None and found[4][0, 3] == 5.0 and found[5] is None


def test_tum_camera_comes_from_option_file_name_or_default(tmp_path: Path) -> None:
    root = tmp_path / "walk"
    write_tum(root, 2)
    for k in range(2):
        write_png(root / f"rgb/{k}.png", color_image(k, 640, 480))
        write_png(root / f"depth/{k}.png", depth_image(1.0, 5000, 640, 480))
    plain = open_source(root).info
    assert require_camera(plain).fx == 525.0 and any("assumed" in note for note in plain.notes)
    (root / "calibration.txt").write_text("# camera\n500 501 320 240 -0.05 0 0 0 0\n")
    written = open_source(root).info
    assert (require_camera(written).fx, require_camera(written).fy) == (500.0, 501.0)
    assert require_camera(open_source(root, SourceOptions(intrinsics=(400, 400, 320, 240))).info).fx == 400.0
    (root / "calibration.txt").unlink()
    named = root.rename(tmp_path / "rgbd_dataset_freiburg3_cabinet")
    assert require_camera(open_source(named).info).fx == 535.4


def test_replica_poses_keep_to_the_numbers_of_their_frames(tmp_path: Path) -> None:
    write_replica(tmp_path, count=5)
    for k in (0, 2):
        (tmp_path / f"results/frame{k:06d}.jpg").unlink()
    source = open_source(tmp_path)
    frames = [f for f in source.read(0, 3) if isinstance(f, Frame)]
    assert [f.T_source_cam[2, 3] for f in frames if f.T_source_cam is not None] == [1, 3, 4]
    assert "5 poses for 3 frames" in " ".join(source.info.notes)


def test_depth_that_begins_late_is_depth(tmp_path: Path) -> None:
    write_replica(tmp_path, count=14)
    for k in range(11):
        (tmp_path / f"results/depth{k:06d}.png").unlink()
    source = open_source(tmp_path)
    assert source.info.has_depth
    assert [type(f) for f in source.read(10, 12)] == [BadFrame, Frame]


def test_depth_with_fractions_is_metres(tmp_path: Path) -> None:
    write_tum(tmp_path, count=3)
    (tmp_path / "calibration.txt").write_text("70 70 39.5 29.5")
    text = (tmp_path / "depth.txt").read_text()
    (tmp_path / "depth.txt").write_text(text.replace(".png", ".npy"))
    for k in range(3):
        depth = np.full((60, 80), 1.25, np.float32)
        depth[0], depth[1] = np.nan, np.inf
        np.save(tmp_path / f"depth/{k}.npy", depth)
    source = open_source(tmp_path)
    frame = next(source.read(0, 1))
    assert isinstance(frame, Frame) and frame.depth is not None
    assert np.all(frame.depth[2:] == 1.25) and not frame.depth[:2].any()
    assert "--depth-scale" in " ".join(source.info.notes)
    scaled = next(open_source(tmp_path, SourceOptions(depth_scale=0.5)).read(0, 1))
    assert isinstance(scaled, Frame) and scaled.depth is not None and np.all(scaled.depth[2:] == 2.5)


def test_replica_has_its_scale_camera_and_trajectory(tmp_path: Path) -> None:
    source = open_source(write_replica(tmp_path / "room0"))
    frames = frames_of(source)
    assert source.info.kind == "replica" and require_camera(source.info).fx == 70.0
    assert frames[2].depth is not None and np.allclose(frames[2].depth, 2.0, atol=1e-3)
    np.testing.assert_allclose(frames[2].T_source_cam, moved(0, 0, 2))


def test_images_come_in_natural_order_with_poses_and_calibration(tmp_path: Path) -> None:
    for k in (10, 2, 1):
        write_png(tmp_path / f"view{k}.png", color_image(k))
    write_png(tmp_path / ".hidden.png", color_image(0))
    bare = open_source(tmp_path).info
    assert bare.camera is None and any("--intrinsics" in what for what in bare.missing)
    with pytest.raises(SourceError, match="--intrinsics"):
        require_camera(bare)
    (tmp_path / "calibration.txt").write_text("70 70 39.5 29.5")
    np.savetxt(tmp_path / "poses.txt", [moved(k, 0, 0)[:3].ravel() for k in (1, 2, 10)])
    source = open_source(tmp_path)
    frames = frames_of(source)
    for frame, k in zip(frames, (1, 2, 10), strict=True):
        np.testing.assert_array_equal(frame.color, color_image(k)[..., ::-1])
        np.testing.assert_allclose(frame.T_source_cam, moved(k, 0, 0))
    assert source.info.scale_kind == "relative" and not source.info.has_depth and source.info.has_poses


def test_images_with_depth_beside_them_need_its_units(tmp_path: Path) -> None:
    for k in range(3):
        write_png(tmp_path / f"color/{k}.png", color_image(k))
        (tmp_path / "depth").mkdir(exist_ok=True)
        np.save(tmp_path / f"depth/{k}.npy", np.full((60, 80), 1.25, np.float32))
    with pytest.raises(SourceError, match="--depth-scale"):
        open_source(tmp_path)
    source = open_source(tmp_path, SourceOptions(depth_scale=1.0, intrinsics=(70, 70, 39.5, 29.5)))
    depth = frames_of(source)[1].depth
    assert depth is not None and np.all(depth == np.float32(1.25))


def test_every_start_and_stop_keep_the_numbers_of_the_source(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "walk", 9)
    source = open_source(root, SourceOptions(every=3, start=1, stop=8, intrinsics=(70, 70, 39.5, 29.5)))
    frames = frames_of(source)
    assert [f.index for f in frames] == [1, 4, 7]
    np.testing.assert_array_equal(frames_of(source, 1, 2)[0].color, frames[1].color)
    with pytest.raises(OptionError):
        open_source(root, SourceOptions(start=9))


def test_read_gives_the_same_in_pieces_and_after_opening_again(tmp_path: Path) -> None:
    root, options = write_seven_scenes(tmp_path / "s"), SourceOptions()
    whole = frames_of(open_source(root, options))
    again = open_source(root, copy.deepcopy(options))
    pieces = frames_of(again, 0, 2) + frames_of(again, 2, 4)
    for a, b in zip(whole, pieces, strict=True):
        assert a.index == b.index and np.array_equal(a.color, b.color) and np.array_equal(a.depth, b.depth)


def test_the_fingerprint_follows_what_shapes_frames_only(tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "s")
    mark = open_source(root).info.fingerprint
    os.utime(root / "frame-000000.color.png")
    assert open_source(root).info.fingerprint == mark
    assert open_source(root, SourceOptions(kind="7scenes")).info.fingerprint == mark
    assert open_source(root, SourceOptions(every=2)).info.fingerprint != mark
    assert open_source(root, SourceOptions(max_depth_m=3.0)).info.fingerprint != mark
    assert open_source(root.rename(tmp_path / "elsewhere")).info.fingerprint == mark
    root = tmp_path / "elsewhere"
    (root / "frame-000003.pose.txt").unlink()
    assert open_source(root).info.fingerprint != mark


def test_the_account_is_honest_and_fits_json(tmp_path: Path) -> None:
    info = open_source(write_seven_scenes(tmp_path / "s")).info
    report = SourceReport(info)
    told = report.as_dict()
    assert told["depth_registered"] is False and told["size"] == [640, 480] and told["poses"] is True
    assert any(line.startswith("note") for line in report.lines())
    without = SourceReport(replace(info, camera=None, depth_camera=None, has_depth=False, T_color_depth=None))
    bare = without.as_dict()
    assert bare["camera"] is None and bare["depth_registered"] is False
    assert any("unknown" in line for line in without.lines())
    json.dumps(told, allow_nan=False)


def test_overlays_are_written_or_refused(tmp_path: Path) -> None:
    source = open_source(write_seven_scenes(tmp_path / "s"))
    numbers = draw_registration(source, tmp_path / "o.png", 2)
    sheet = cv2.imread(str(tmp_path / "o.png"))
    assert sheet is not None and sheet.shape == (480 * len(numbers), 1280, 3)
    with pytest.raises(ExportError):
        draw_registration(source, tmp_path / "absent" / "o.png")


# ------------------------------------------------------------------------------------------ damage


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def test_a_damaged_frame_is_handed_out_as_bad_and_the_rest_goes_on(tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "s", 8)
    cut(root / "frame-000001.color.png", 0.5)
    cut(root / "frame-000002.depth.png", 0.5)
    (root / "frame-000003.depth.png").unlink()
    (root / "frame-000004.color.png").write_bytes(b"")
    write_png(root / "frame-000005.color.png", color_image(5, 320, 240))
    write_png(root / "frame-000006.depth.png", depth_image(1.0, 1000, 320, 240))
    (root / "frame-000007.pose.txt").write_text("nan " * 16)
    found = list(open_source(root).read(0, 8))
    assert [f.index for f in found] == list(range(8))
    bad = [f for f in found if isinstance(f, BadFrame)]
    assert [f.index for f in bad] == [1, 2, 3, 4, 5, 6]
    for frame, word in zip(bad, ("cut off", "cut off", "missing", "empty", "320x240", "320x240"), strict=True):
        assert word in frame.reason
    last = found[7]
    assert isinstance(last, Frame) and last.T_source_cam is None


def test_a_cut_jpeg_is_bad_not_grey(tmp_path: Path) -> None:
    root = write_replica(tmp_path / "room", 4)
    cut(root / "results/frame000002.jpg", 0.6)
    found = list(open_source(root).read(0, 4))
    assert isinstance(found[2], BadFrame) and isinstance(found[3], Frame)


def test_flipped_bytes_never_raise(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "walk", 6)
    rng = np.random.default_rng(0)
    for k in range(1, 6):
        path = root / f"depth/{k}.png"
        data = bytearray(path.read_bytes())
        for at in rng.integers(8, len(data) - 16, 20):
            data[at] ^= 0x55
        path.write_bytes(bytes(data))
    source = open_source(root, SourceOptions(intrinsics=(70, 70, 39.5, 29.5)))
    assert len(list(source.read(0, 6))) == 6


def test_over_half_bad_is_an_error() -> None:
    check_bad_share(5, 10)
    with pytest.raises(SourceError, match="6 of 10"):
        check_bad_share(6, 10)


def absent(root: Path) -> Path:
    return root / "absent"


def empty_folder(root: Path) -> Path:
    return root


def unknown_layout(root: Path) -> Path:
    (root / "notes.txt").write_text("hello")
    return root


def zero_bytes(root: Path) -> Path:
    (root / "a.mp4").write_bytes(b"")
    return root / "a.mp4"


def text_file(root: Path) -> Path:
    (root / "a.txt").write_text("hello\n" * 50)
    return root / "a.txt"


def noise_file(root: Path) -> Path:
    (root / "a.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    return root / "a.mp4"


def one_image(root: Path) -> Path:
    write_png(root / "a.png", color_image(0))
    return root / "a.png"


def wrong_depth_size(root: Path) -> Path:
    write_tum(root, 2)
    for k in range(2):
        write_png(root / f"depth/{k}.png", depth_image(1, 5000, 40, 30))
    return root


def only_broken_images(root: Path) -> Path:
    for k in range(4):
        (root / f"{k}.jpg").write_bytes(b"\xff\xd8 not an image")
    return root


def broken_list(root: Path) -> Path:
    write_tum(root, 2)
    (root / "rgb.txt").write_text("yesterday rgb/0.png\n")
    return root


def no_common_time(root: Path) -> Path:
    write_tum(root, 2)
    (root / "depth.txt").write_text("99.0 depth/0.png\n")
    return root


def broken_calibration(root: Path) -> Path:
    write_tum(root, 2)
    (root / "calibration.txt").write_text("525\n")
    return root


@pytest.mark.parametrize(
    "make",
    [
        absent,
        empty_folder,
        unknown_layout,
        zero_bytes,
        text_file,
        noise_file,
        one_image,
        wrong_depth_size,
        only_broken_images,
        broken_list,
        no_common_time,
        broken_calibration,
    ],
)
def test_what_is_no_source_is_refused_in_one_line(tmp_path: Path, make: object) -> None:
    assert callable(make)
    options = SourceOptions(intrinsics=(70, 70, 39.5, 29.5)) if make is wrong_depth_size else SourceOptions()
    with pytest.raises(SourceError) as caught:
        open_source(make(tmp_path), options)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value) or "--" in str(caught.value)


def test_a_depth_scale_that_cannot_be_is_doubted(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "walk")
    said = SourceOptions(intrinsics=(70, 70, 39.5, 29.5), depth_scale=5.0)
    assert any("--depth-scale" in note for note in open_source(root, said).info.notes)


def test_a_wrong_depth_size_names_the_option(tmp_path: Path) -> None:
    root = wrong_depth_size(tmp_path)
    with pytest.raises(SourceError, match="--depth-intrinsics"):
        open_source(root, SourceOptions(intrinsics=(70, 70, 39.5, 29.5)))
    mended = SourceOptions(intrinsics=(70, 70, 39.5, 29.5), depth_intrinsics=(35, 35, 19.5, 14.5))
    depth = frames_of(open_source(root, mended))[0].depth
    assert depth is not None and depth.shape == (60, 80) and (depth > 0).mean() > 0.9


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_said(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir()
    (tmp_path / "locked").chmod(0)
    try:
        with pytest.raises(SourceError, match="permission"):
            open_source(tmp_path / "locked")
    finally:
        (tmp_path / "locked").chmod(0o700)


def test_intrinsics_of_another_image_size_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="outside"):
        open_source(write_tum(tmp_path / "walk"), SourceOptions(intrinsics=(525, 525, 320, 240)))

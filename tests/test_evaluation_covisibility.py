"""Covisibility: facts of a plain wall, laws, and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from list3r.evaluation.covisibility import (
    Covisibility,
    CovisibilitySettings,
    covisibility,
    read_covisibility,
    write_covisibility,
)
from list3r.frames.base import Camera
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.geometry import rotation_exp

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall(positions: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Cameras that look along +z at the plane z = 2: depth maps and poses."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return np.stack([np.full((48, 64), 2.0 - z, np.float32) for _, _, z in positions]), poses


def test_a_step_aside_along_a_wall_shares_what_is_left_of_the_picture() -> None:
    width = 2.0 * 64 / 60
    depth, poses = wall([(0, 0, 0), (width / 4, 0, 0), (width / 2, 0, 0), (2 * width, 0, 0)])
    share = covisibility(depth, poses, CAMERA, CovisibilitySettings(points=64 * 48))
    assert share[0] == pytest.approx([1.0, 0.75, 0.5, 0.0], abs=0.01)
    assert np.allclose(share, share.T, atol=0.01)


def test_a_close_look_lies_inside_a_wide_one_but_not_the_other_way_round() -> None:
    depth, poses = wall([(0, 0, 0), (0, 0, 1.0)])
    share = covisibility(depth, poses, CAMERA)
    assert share[1, 0] == 1.0
    assert share[0, 1] == pytest.approx(0.25, abs=0.03)


def test_what_is_hidden_is_not_shared_and_unknown_depth_tells_nothing() -> None:
    depth, poses = wall([(0, 0, 0), (0, 0, 0), (0, 0, 0)])
    depth[1, :, :32] = 1.0
    depth[2, :, :16] = 0.0
    share = covisibility(depth, poses, CAMERA)
    assert share[0, 1] == pytest.approx(0.5, abs=0.05)
    assert share[0, 2] == 1.0
    assert share[2, 0] == 1.0


def test_the_other_side_of_the_room_is_not_shared() -> None:
    depth, poses = wall([(0, 0, 0), (0, 0, 0)])
    poses[1, :3, :3] = rotation_exp(np.array([0, np.pi, 0]))
    assert covisibility(depth, poses, CAMERA)[0, 1] == 0.0


def test_the_back_of_a_thin_wall_is_not_its_front() -> None:
    depth, poses = wall([(0, 0, 0), (0, 0, 4.05)])
    poses[1, :3, :3] = rotation_exp(np.array([0, np.pi, 0]))
    depth[1] = 2.0
    assert covisibility(depth, poses, CAMERA)[0, 1] == 0.0


def test_a_steep_floor_on_a_coarse_map_shares_itself() -> None:
    y = np.arange(48)[:, None] - 23.5
    depth = np.where(y > 2, 1.2 * 60 / np.maximum(y, 1e-3), 0).astype(np.float32) * np.ones((1, 64), np.float32)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3], poses[1, 2, 3] = 0.05, 0.05
    share = covisibility(np.stack([depth, depth]), poses, CAMERA)
    assert share.min() > 0.9


def test_frames_without_pose_or_depth_are_not_known() -> None:
    depth, poses = wall([(0, 0, 0)] * 4)
    poses[1], depth[2] = np.nan, 0.0
    share = covisibility(depth, poses, CAMERA)
    assert np.isnan(share[[1, 2]]).all()
    assert np.isnan(share[:, [1, 2]]).all()
    assert share[0, 3] == 1.0


def test_scale_does_not_matter() -> None:
    depth, poses = wall([(0, 0, 0), (0.7, 0.1, 0.2)])
    small = poses.copy()
    small[:, :3, 3] *= 0.1
    again = covisibility(0.1 * depth, small, CAMERA)
    assert np.allclose(again, covisibility(depth, poses, CAMERA), atol=0.01)


def test_shapes_that_do_not_fit_are_named() -> None:
    depth, poses = wall([(0, 0, 0)])
    with pytest.raises(OptionError, match="64x48"):
        covisibility(depth[:, :10], poses, CAMERA)
    with pytest.raises(OptionError, match="poses"):
        covisibility(depth, poses[0], CAMERA)
    with pytest.raises(OptionError, match="ascend"):
        Covisibility(np.array([3, 1]), np.zeros(2), np.ones((2, 2), np.float32))
    with pytest.raises(OptionError, match=r"\(2, 2\)"):
        Covisibility(np.array([1, 3]), np.zeros(2), np.ones((3, 2), np.float32))


def test_files_come_back_and_others_are_named(tmp_path: Path) -> None:
    found = Covisibility(np.array([0, 4]), np.array([0.0, 0.1]), np.array([[1, 0.5], [np.nan, 1]], np.float32))
    write_covisibility(tmp_path / "c.npz", found)
    back = read_covisibility(tmp_path / "c.npz")
    assert np.array_equal(back.frame, found.frame)
    assert np.array_equal(back.share, found.share, equal_nan=True)
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    np.save(tmp_path / "one.npz.npy", np.zeros(3))
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "odd.npz", frame=[1, 2], time_s=[0.0], share=np.ones((2, 2)))
    for name, words in (
        ("other.npz", "no array frame or time_s or share"),
        ("text.npz", "text.npz"),
        ("one.npz.npy", "one.npz"),
        ("odd.npz", "odd.npz"),
        ("absent.npz", "absent.npz"),
    ):
        with pytest.raises(SourceError, match=words):
            read_covisibility(tmp_path / name)

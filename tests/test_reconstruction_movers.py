"""A thing that moves before the camera does not drag the camera along."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.motion.residuals import surfaces
from list3r.reconstruction.motion.settings import ResidualMoverSettings
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from list3r.reconstruction.rgbd.view import make_view
from tests.rgbd_scenes import CAMERA, frames_along, pose_errors, walk

SPEED_M_PER_S = 0.3


def carried(frame: Frame, at: tuple[float, float, float], share: float = 0.2, seed: int = 5) -> Frame:
    """The frame with a textured board before the camera, its centre `at` camera coordinates, over `share` of it."""
    assert frame.depth is not None
    rng = np.random.default_rng(seed)
    tile = cv2.resize(rng.uniform(30, 220, (24, 24, 3)).astype(np.float32), (512, 512), interpolation=cv2.INTER_CUBIC)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    x = ((u - CAMERA.cx) / CAMERA.fx * at[2] - at[0]) / (np.sqrt(share) * CAMERA.width / CAMERA.fx * at[2])
    y = ((v - CAMERA.cy) / CAMERA.fy * at[2] - at[1]) / (np.sqrt(share) * CAMERA.height / CAMERA.fy * at[2])
    on = (np.abs(x) < 0.5) & (np.abs(y) < 0.5)
    look = cv2.remap(tile, ((x + 0.5) * 511).astype(np.float32), ((y + 0.5) * 511).astype(np.float32), cv2.INTER_LINEAR)
    depth, color = frame.depth.copy(), frame.color.copy()
    noise = np.random.default_rng((seed, frame.index)).normal(size=depth.shape)
    depth[on] = (at[2] * (1 - 0.05 * np.cos(np.pi * x) * np.cos(np.pi * y)) + 0.0024 * noise)[on]
    color[on] = np.clip(look, 0, 255)[on].astype(np.uint8)
    return replace(frame, depth=depth, color=color)


def place(k: int) -> tuple[float, float, float]:
    """Where the board is in frame `k`: it swings sideways."""
    return 0.2 * np.sin(SPEED_M_PER_S / 0.2 * k / 30), 0.03, 1.2


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 12])
def test_a_near_mover_does_not_drag_the_camera(first: int) -> None:
    poses = walk(24)
    frames = [carried(f, place(k)) if k >= first else f for k, f in enumerate(frames_along(poses))]
    result = RgbdReconstructor()(frames, CAMERA)
    shift, _ = pose_errors(result.T_chunk_cam[result.posed], poses[result.posed])
    assert result.posed.all()
    assert shift.max() < 0.02


def test_surfaces_are_parted_by_steps_of_depth() -> None:
    frame, noise = carried(frames_along(walk(1))[0], place(0)), SensorNoise()
    assert frame.depth is not None
    view = make_view(frame.color, frame.depth, CAMERA.shrunk(160), noise)
    boards = [m for m in surfaces(view, ResidualMoverSettings(), noise) if m[view.depth.shape[0] // 2, 80]]
    assert len(boards) == 1
    assert abs(float(boards[0].mean()) - 0.2) < 0.05
    assert float(np.median(view.depth[boards[0] & (view.depth > 0)])) == pytest.approx(1.17, abs=0.05)

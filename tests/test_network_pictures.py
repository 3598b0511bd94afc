"""Pictures of networks lie in frames as each loader puts them; points keep their rays; joint windows are whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module

import cv2
import numpy as np
import pytest

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import TrackingError
from list3r.reconstruction.base import WindowSide, backproject, reconstruct_jointly
from list3r.reconstruction.feedforward.output import WindowOutput, to_reconstruction
from list3r.reconstruction.feedforward.pictures import Loader, Placement, fitted, pictures
from list3r.reconstruction.feedforward.points import camera_of, from_points, in_camera
from list3r.reconstruction.registry import ModelOptions, make_reconstructor
from tests import neural_scenes
from tests.rgbd_scenes import CAMERA, pose_errors

HD, PHONE, SQUARE = (1080, 1920), (1920, 1080), (600, 600)
EXPECTED = {
    # 255,000 px: 1920 x 1080 is scaled by sqrt(255000 / 2073600) to 673.3 x 378.7, 48 x 27 patches
    "pi3": {HD: Placement((378, 672), (378, 672)), PHONE: Placement((672, 378), (672, 378))},
    # 518 wide and 291.4 high, 21 patches; portrait: 518 high, 21 patches wide, white on either side
    "vggt": {HD: Placement((294, 518), (294, 518)), PHONE: Placement((518, 294), (518, 518), left=112)},
    # 1.778 is nearest to 1.762; 294 / 1080 covers: 522.67 wide, of which the middle 518
    "mapanything": {
        HD: Placement((294, 522), (294, 518), left=-2),
        PHONE: Placement((522, 294), (518, 294), top=-2),
        SQUARE: Placement((518, 518), (518, 518)),
    },
    # 504 wide and 283.5 high: 20.25 patches
    "da3": {HD: Placement((280, 504), (280, 504)), PHONE: Placement((504, 280), (504, 280))},
    # 512 x 288 is 32 x 18 patches of 16; squares lose a quarter
    "cut3r": {
        HD: Placement((288, 512), (288, 512)),
        PHONE: Placement((512, 288), (512, 288)),
        SQUARE: Placement((512, 512), (384, 512), top=-64),
    },
}


@pytest.mark.parametrize("name", EXPECTED)
def test_pictures_are_placed_as_the_networks_own_loaders_do(name: str) -> None:
    loader: Loader = import_module(f"list3r.reconstruction.networks.{name}").NETWORK.loader
    for size, expected in EXPECTED[name].items():
        placed = loader.place(*size)
        assert placed == expected
        frame = np.full((*size, 3), 90, np.uint8)
        (seen,) = pictures([frame], placed, loader.resample)
        assert seen.shape == (*placed.size, 3)
        whole = placed.whole(np.ones((1, *placed.size), np.float32))[0]
        assert whole.shape == placed.inner
        assert (seen == 90).all(axis=2).sum() == whole.sum() and set(np.unique(seen)) <= {90, 255}


@pytest.mark.parametrize("name", ["vggt", "mapanything", "cut3r"])
def test_a_pixel_of_the_picture_is_the_pixel_of_the_frame(name: str) -> None:
    """A dot in the frame is seen where the intrinsics of the picture say."""
    loader: Loader = import_module(f"list3r.reconstruction.networks.{name}").NETWORK.loader
    for height, width in (PHONE, (1000, 1500)):
        camera = Camera(width, height, 1000.0, 1000.0, 0.3 * width, 0.6 * height)
        placed = loader.place(height, width)
        frame = np.zeros((height, width, 3), np.uint8)
        cv2.circle(frame, (round(camera.cx), round(camera.cy)), 25, (255, 255, 255), -1)
        (seen,) = pictures([frame], placed, loader.resample)
        inside = np.zeros(placed.size, bool)
        inside[
            max(placed.top, 0) : placed.top + placed.inner[0], max(placed.left, 0) : placed.left + placed.inner[1]
        ] = 1
        rows, columns = np.nonzero((seen[..., 0] > 128) & inside)
        K = placed.camera_matrix(camera)
        assert (columns.mean(), rows.mean()) == pytest.approx((K[0, 2], K[1, 2]), abs=0.7)


def plane(camera: Camera, count: int = 3) -> WindowOutput:
    """Cameras side by side before a tilted plane."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    depth = np.tile(2.0 / (1.0 - 0.2 * x), (count, camera.height, 1)).astype(np.float32)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(count)
    focal, principal = np.tile([camera.fx, camera.fy], (count, 1)), np.tile([camera.cx, camera.cy], (count, 1))
    return WindowOutput(T, depth, np.ones_like(depth), focal, principal)


def test_a_principal_point_off_the_centre_is_kept() -> None:
    small = Camera(64, 48, 60.0, 62.0, 20.0, 30.0)
    made = to_reconstruction(neural_scenes.film(3), Camera(128, 96, 1.0, 1.0, 0.0, 0.0), plane(small))
    assert (made.camera.fx, made.camera.fy) == (120.0, 124.0)
    assert (made.camera.cx, made.camera.cy) == (40.5, 60.5)
    points = backproject(made.depth[0], made.camera)[10:-10, 10:-10].reshape(-1, 3)
    assert np.allclose(points[:, 2] - 0.2 * points[:, 0], 2.0, atol=2e-3)


def test_known_intrinsics_take_the_place_of_the_networks_own() -> None:
    """Each pixel's point is the one on its true ray that is nearest to the network's."""
    own, true = Camera(64, 48, 60.0, 60.0, 31.5, 23.5), Camera(64, 48, 66.0, 64.0, 30.0, 25.0)
    said = plane(own)
    made = to_reconstruction(neural_scenes.film(3), true, said, known=True)
    assert made.camera == true
    ours, theirs = backproject(made.depth[1], true), backproject(said.depth[1], own)
    rays = backproject(np.ones_like(said.depth[1]), true)
    known = made.depth[1] > 0
    assert known.mean() > 0.9
    across = np.einsum("nk,nk->n", (ours - theirs)[known], rays[known])
    assert np.abs(across).max() < 1e-4
    again = to_reconstruction(neural_scenes.film(3), own, said, known=True)
    assert np.allclose(again.depth[1][known], said.depth[1][known], rtol=1e-6)


def test_a_pose_is_where_points_are_seen_at_their_pixels() -> None:
    camera = Camera(64, 48, 60.0, 62.0, 30.0, 25.0)
    local = backproject(plane(camera).depth[0], camera) + np.float32(0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.3, -0.5, 0.1]))[0], (0.5, -1.0, 2.0)
    common = (local @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    common[:5] += 3.0
    K = np.array([60.0, 62.0, 30.0, 25.0])
    found = camera_of(common, np.ones((48, 64), np.float32), K)
    assert np.allclose(found, T, atol=1e-3)
    assert np.allclose(in_camera(found, common)[10:], local[10:], atol=1e-2)
    assert np.isnan(camera_of(common * np.nan, np.ones((48, 64), np.float32), K)).all()
    said = from_points(T[None], local[None], np.ones((1, 48, 64), np.float32))
    assert np.allclose(np.r_[said.focal[0], said.principal[0]], K, atol=1e-2)
    assert np.allclose(said.depth[0], local[..., 2], rtol=1e-4)


@pytest.fixture
def upstream(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    neural_scenes.use_upstream(monkeypatch)
    yield
    neural_scenes.forget_upstream()


def half_size(frames: list[Frame]) -> list[Frame]:
    return [replace(f, color=cv2.resize(f.color, (160, 120), interpolation=cv2.INTER_AREA)) for f in frames]


def test_two_cameras_share_a_joint_window_in_one_gauge(upstream: None, tmp_path: object) -> None:
    film = neural_scenes.film(12)
    path = neural_scenes.weights("vggt", tmp_path / "weights", film)  # type: ignore[operator]
    model = make_reconstructor("vggt", ModelOptions(device="cpu", weights=str(path)))
    frames = neural_scenes.rgb_only(film)
    sides = [
        WindowSide(frames[:5], CAMERA, camera_known=True),
        WindowSide(half_size(frames[7:]), CAMERA.resized(120, 160), camera_known=True),
    ]
    one, two = reconstruct_jointly(model, sides)
    assert (one.camera.width, two.camera.width) == (320, 160) and two.frame_indices.tolist() == [7, 8, 9, 10, 11]
    truth = [f for k, f in enumerate(film) if k < 5 or k >= 7]
    scale = np.median((one.depth / np.stack([f.depth for f in truth[:5] if f.depth is not None]))[one.depth > 0])
    T = np.concatenate([one.T_chunk_cam, two.T_chunk_cam])
    T[:, :3, 3] /= scale
    shift, turn = pose_errors(T, np.stack([f.T_source_cam for f in truth if f.T_source_cam is not None]))
    assert shift.max() < 5e-3 and turn.max() < 0.1
    with pytest.raises(TrackingError, match="different cameras"):
        reconstruct_jointly(lambda frames, camera: one, sides)


def test_a_joint_window_that_does_not_fit_is_thinned_and_never_split(upstream: None, tmp_path: object) -> None:
    film = neural_scenes.film(16)
    path = neural_scenes.weights("vggt", tmp_path / "weights", film)  # type: ignore[operator]
    counted = neural_scenes.upstream("vggt")
    counted.most = 9  # type: ignore[attr-defined]
    model = make_reconstructor("vggt", ModelOptions(device="cpu", weights=str(path), camera_known=False))
    frames = neural_scenes.rgb_only(film)
    sides = [WindowSide(part, CAMERA, camera_known=False) for part in (frames[:8], frames[8:])]
    one, two = reconstruct_jointly(model, sides)
    assert one.frame_indices.tolist() == [0, 2, 4, 6] and two.frame_indices.tolist() == [8, 10, 12, 14]
    assert counted.largest_pass == 8  # type: ignore[attr-defined]
    counted.most = 7  # type: ignore[attr-defined]
    with pytest.raises(TrackingError, match="do not fit into the memory at once"):
        reconstruct_jointly(make_reconstructor("vggt", ModelOptions(device="cpu", weights=str(path))), sides)


def test_frames_of_another_shape_are_fitted_into_the_picture() -> None:
    placed = fitted(Camera(320, 180, 1, 1, 0, 0), (392, 518))
    assert placed == Placement((291, 518), (392, 518), top=50)

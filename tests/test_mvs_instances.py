"""Things found on depth that was computed from colour."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.instances.geometric.support import without_rims
from list3r.instances.geometric.views import chunk_views, forget_views
from list3r.instances.library import build_library
from list3r.instances.settings import InstanceSettings
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import LocalInstance, LocalLibrary
from list3r.reconstruction.base import DepthNoise, Reconstruction
from list3r.reconstruction.mvs.stereo import PosedFrames, dense_depth, stereo_noise
from tests.rgbd_scenes import BOXES, CAMERA, frames_along, walk

COUNT = 24


def reconstructed(seed: int) -> tuple[list[Frame], np.ndarray, Reconstruction]:
    T = walk(COUNT, speed=2.0)
    frames = frames_along(T, seed=seed)
    depth, confidence = dense_depth(PosedFrames(frames, np.ones(COUNT, bool), T, CAMERA))
    reconstruction = Reconstruction(
        frame_indices=np.arange(COUNT),
        posed=np.ones(COUNT, bool),
        T_chunk_cam=T,
        camera=CAMERA,
        depth=depth,
        confidence=confidence,
        scale_kind="metric",
        keyframes=np.arange(0, COUNT, 8),
        depth_noise=stereo_noise(depth, confidence),
    )
    return frames, T, reconstruction


def at(library: LocalLibrary, frame: int, T: np.ndarray, point: np.ndarray) -> LocalInstance | None:
    """The instance seen where a point of the world lies in a frame."""
    local = np.linalg.inv(T[frame]) @ np.append(point, 1.0)
    x, y = (CAMERA.matrix() @ local[:3] / local[2])[:2].round().astype(int)
    for instance in library.instances:
        for row in np.flatnonzero(instance.track.frames == frame):
            if decode_mask(instance.track.masks[row], instance.track.image_size)[y, x]:
                return instance
    return None


@pytest.mark.slow
def test_a_box_in_the_pattern_of_the_box_under_it_is_told_from_it_in_half_of_the_textures() -> None:
    apart = 0
    for seed in (101, 103, 104, 105):
        frames, T, reconstruction = reconstructed(seed)
        library = build_library(frames, reconstruction)
        fronts = [np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]) for low, high in BOXES[:2]]
        under, box = (at(library, 12, T, point) for point in fronts)
        assert under is not None
        apart += box is not None and box.local_id != under.local_id
    assert apart >= 2


def test_outlines_before_something_farther_are_left_out() -> None:
    depth = np.full((40, 40), 2.0, np.float32)
    depth[10:30, 10:30] = 1.0
    depth[10:30, 24:30] = 0.9
    labels = np.zeros((40, 40), np.int32)
    labels[10:30, 10:24], labels[10:30, 24:30], labels[5, 5:15] = 1, 2, 3
    kept = without_rims(labels, depth, 3)
    assert (kept[11:29, 11:24] == 1).all(), "what stands before it takes nothing from it"
    assert (kept[11:29, 25:29] == 2).all() and not kept[11:29, 24].any() and not kept[11:29, 10].any()
    assert (kept[5, 5:15] == 3).all(), "hardly more than outline"


def test_frames_that_share_their_errors_do_not_confirm_an_edge() -> None:
    T = walk(COUNT)
    frames = frames_along(T, seed=101, noise=False)
    depth = np.stack([f.depth for f in frames if f.depth is not None])
    seen = {}
    for noise in (None, DepthNoise(0.0, 0.002)):
        reconstruction = Reconstruction(
            np.arange(COUNT), np.ones(COUNT, bool), T, CAMERA, depth, (depth > 0).astype(np.float16), "metric",
            np.arange(0, COUNT, 8), depth_noise=noise,
        )  # fmt: skip
        views = chunk_views(frames, reconstruction, InstanceSettings())
        view = views.view(views.anchors[0])
        seen[noise is None] = view.confirmed
        if noise is not None:
            assert views.noise_scale == 1.0
            assert np.allclose(view.reading, noise.sigma(views.small_depth(views.anchors[0])), rtol=1e-5)
        forget_views()
    assert seen[True].mean() > seen[False].mean() > 0.8
    assert (seen[False] & ~seen[True]).mean() < 0.01


def test_confidence_of_stereo_tells_the_deviation_of_its_depth() -> None:
    noise = DepthNoise(0.0, 0.002, 0.02)
    sigma, depth = np.array([0.005, 0.02, 0.06], np.float32), np.array([0.5, 1.0, 4.0], np.float32)
    confidence = (1.0 / (1.0 + (sigma / 0.02) ** 2)).astype(np.float16)
    assert np.allclose(noise.doubt(depth, confidence), sigma * depth, rtol=0.02)
    assert not DepthNoise(0.0, 0.002).doubt(depth, confidence).any()


def test_a_thing_narrower_than_the_deviation_of_its_depth_is_none() -> None:
    T = walk(COUNT)
    frames = frames_along(T, seed=101, noise=False)
    depth = np.stack([f.depth for f in frames if f.depth is not None])
    found = {}
    for sure in (0.9, 0.02):
        confidence = np.where(depth > 0, sure, 0.0).astype(np.float16)
        reconstruction = Reconstruction(
            np.arange(COUNT), np.ones(COUNT, bool), T, CAMERA, depth, confidence, "metric",
            np.arange(0, COUNT, 8), depth_noise=DepthNoise(0.0, 0.002, 0.02),
        )  # fmt: skip
        found[sure] = build_library(frames, reconstruction).instances
    things = {sure: [i for i in library if not i.structure and i.plane is None] for sure, library in found.items()}
    assert len(things[0.9]) >= 3
    assert len(things[0.02]) < len(things[0.9])
    assert sum(i.structure for i in found[0.02]) == sum(i.structure for i in found[0.9])

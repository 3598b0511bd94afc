"""Support of edges: what is shared, what stands still, and that everything in the picture has its say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from list3r.association.overlap.alignment import align
from list3r.association.overlap.balance import balanced_support
from list3r.association.overlap.inconsistency import displacement, inconsistency
from list3r.association.overlap.regions import EdgeSupportSettings, Mask, confident, divide
from list3r.association.overlap.shared_points import Pairs, shared_pairs, shared_samples
from list3r.association.overlap.support import static_support
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import encode_mask
from list3r.memory.core.records import LocalInstance, LocalLibrary, MaskTrack, Support
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.keyframe_record import frame_samples
from list3r.reconstruction.settings import SampleSettings
from tests.association_scenes import BOX, BOXES, CAMERA, FLOOR, MOVER, WALL, Thing, film

S_V = Sim3.exp([-0.3, 0.6, 0.1, -0.2, 0.4, 0.9, -0.3])
SETTINGS = EdgeSupportSettings()
PERSON = Thing(MOVER, (-0.6, 0.2, 1.9), (0.35, 1.1), (0.03, 0.0, 0.0))


def fit(pairs: Pairs, mask: Mask) -> Sim3:
    return align(pairs.p_u[mask], pairs.p_v[mask], pairs.weight[mask], pairs.frame[mask], False).S_v_u


def test_shared_samples_are_the_same_pixels_of_the_same_frames() -> None:
    u, v = film(frames=10), film(first=6, frames=10)
    pick_u, pick_v = shared_samples(u, v)
    assert np.array_equal(u.frame[pick_u], v.frame[pick_v])
    assert np.array_equal(u.pixel[pick_u], v.pixel[pick_v])
    assert set(u.frame[pick_u].tolist()) == {6, 7, 8, 9}
    pairs = shared_pairs(u, v)
    assert len(pairs) == len(pick_u)
    assert np.allclose(pairs.cam_v[:, :2] / pairs.cam_v[:, 2:] * 140 + [79.5, 59.5], pixel_xy(pairs), atol=0.01)


def pixel_xy(pairs: Pairs) -> np.ndarray:
    return np.column_stack([pairs.pixel % 160, pairs.pixel // 160])


def test_confidence_is_relative_to_the_median() -> None:
    u, v = film(), film(S_chunk_world=S_V)
    low = np.where(v.instance == BOX, 0.01, 0.8).astype(np.float32)
    pairs = shared_pairs(replace(u, confidence=u.confidence * 0.01), replace(v, confidence=low * 0.01))
    assert np.array_equal(confident(pairs, SETTINGS), pairs.instance_v != BOX)


def test_regions_are_instances_and_blocks_of_the_rest() -> None:
    u, v = film(), film(S_chunk_world=S_V)
    without_wall = np.where(u.instance == WALL, -1, u.instance).astype(np.int32)
    pairs = shared_pairs(replace(u, instance=without_wall), v)
    regions = divide(pairs, pairs.instance_u, CAMERA, SETTINGS)
    assert set(regions.label.tolist()) == {-1, FLOOR, BOX, 4}
    assert 2 <= (regions.label == -1).sum() <= 12
    assert regions.count.sum() == len(pairs)


def test_what_moves_along_its_rays_is_caught_though_delta_is_zero() -> None:
    """A thing pushed along its rays has no pixel residual in the frames themselves."""
    u, v = film((*BOXES, PERSON)), film((*BOXES, PERSON), S_V, mover_depth=1.2)
    pairs = shared_pairs(u, v)
    regions = divide(pairs, pairs.instance_u, CAMERA, SETTINGS)
    none = np.zeros(len(pairs), bool)
    off = displacement(pairs, S_V, CAMERA, ~none, none)
    found = inconsistency(off, regions, pairs.frame, CAMERA, SETTINGS)
    mover = int(np.flatnonzero(regions.label == MOVER)[0])
    assert found.delta_px.max() < 0.1
    assert found.moving[mover]
    assert found.moving.sum() == 1


def test_a_wrong_frame_is_not_a_mover() -> None:
    u, v = film(noise=0.003), film(S_chunk_world=S_V, noise=0.003, seed=1)
    T = v.T_chunk_cam.copy()
    off = Sim3.exp([0.2, 0.1, 0.0, 0.02, 0.05, 0.0, 0.0])
    wrong = v.frame < 6
    points = np.where(wrong[:, None], off.apply(v.points), v.points).astype(np.float32)
    T[:6] = off.as_matrix() @ T[:6]
    found = static_support(shared_pairs(u, replace(v, points=points, T_chunk_cam=T)), CAMERA, fit, SETTINGS)
    assert not found.removed.any()


def test_depth_errorsed_things_come_in_again_and_every_frame_has_one_say() -> None:
    u, v = film(noise=0.003), film(S_chunk_world=S_V, noise=0.003, seed=1)
    doubt = np.where(u.instance == BOX, 0.01, 0.8).astype(np.float32)
    pairs = shared_pairs(replace(u, confidence=doubt), replace(v, confidence=doubt))
    static = static_support(pairs, CAMERA, fit, SETTINGS)
    support = balanced_support(pairs, static, CAMERA, SETTINGS)
    assert not static.confident[pairs.instance_u == BOX].any()
    assert support.used[pairs.instance_u == BOX].mean() > 0.9
    assert np.allclose(np.bincount(support.frame, support.weight), 1.0, atol=1e-6)
    assert len(support.weight) <= SETTINGS.budget


def test_a_region_on_which_the_chunks_disagree_has_less_say() -> None:
    u, v = film(noise=0.002), film(S_chunk_world=S_V, noise=0.002, seed=1)
    rng = np.random.default_rng(0)
    wobble = np.repeat(rng.normal(size=24), len(v.frame) // 24)[:, None] * 0.03 * (v.instance == FLOOR)[:, None]
    eye = v.T_chunk_cam[v.frame][:, :3, 3]
    spoilt = replace(v, points=(v.points + wobble * (v.points - eye)).astype(np.float32))
    said = []
    for other in (v, spoilt):
        pairs = shared_pairs(u, other)
        static = static_support(pairs, CAMERA, fit, replace(SETTINGS, least_depth=1.0, least_pixels=1.0))
        support = balanced_support(pairs, static, CAMERA, replace(SETTINGS, least_patches=10**6))
        floor = pairs.instance_u[support.used] == FLOOR
        said.append(support.weight[floor].mean() / support.weight.mean())
    assert said[1] < 0.7 * said[0]


def test_the_order_of_samples_does_not_matter() -> None:
    u, v = film(noise=0.003), film(S_chunk_world=S_V, noise=0.003, seed=1)
    order = np.random.default_rng(0).permutation(len(u.frame))
    shuffled = replace(u, **{n: getattr(u, n)[order] for n in ("frame", "pixel", "points", "confidence", "instance")})
    one, two = shared_pairs(u, v), shared_pairs(shuffled, v)
    assert np.array_equal(one.p_u, two.p_u)


def make_chunk(first: int, count: int, boxes: bool) -> tuple[Reconstruction, LocalLibrary]:
    """A chunk of frames `first` to `first + count` with or without one small instance."""
    camera = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
    frames = np.arange(first, first + count)
    depth = np.full((count, 240, 320), 2.0, np.float32)
    mask = np.zeros((240, 320), bool)
    mask[100:130, 80:110] = True
    track = MaskTrack(
        frames=frames,
        boxes_xyxy=np.tile([80, 100, 110, 130], (count, 1)).astype(np.float32),
        centers_xy=np.tile([94.5, 114.5], (count, 1)).astype(np.float32),
        areas_px=np.full(count, 900, np.int32),
        visible_fraction=np.ones(count, np.float32),
        masks=(encode_mask(mask),) * count,
        image_size=(240, 320),
    )
    support = Support(np.zeros((1, 3), np.float32), np.ones(1, np.float32), np.zeros((1, 3), np.uint8))
    thing = LocalInstance(5, track, np.ones(4, np.float32) / 2, support, 1.0)
    return Reconstruction(
        frame_indices=frames,
        posed=np.ones(count, bool),
        T_chunk_cam=np.tile(np.eye(4), (count, 1, 1)),
        camera=camera,
        depth=depth,
        confidence=np.ones(depth.shape, np.float16),
        scale_kind="relative",
        keyframes=np.arange(0, count, 5),
    ), LocalLibrary((thing,) if boxes else (), np.zeros((0, 2), np.int32), "test@1/4")


def test_samples_are_finer_at_the_ends_and_on_small_things_and_shared_whatever_was_found() -> None:
    settings = SampleSettings(end_frames=4)
    u, v = (frame_samples(*make_chunk(*where), settings) for where in ((0, 12, True), (8, 12, False)))
    count = dict(zip(*np.unique(u.frame, return_counts=True), strict=True))
    plain = dict(zip(*np.unique(v.frame, return_counts=True), strict=True))
    assert (plain[8], plain[13]) == (32 * 24, 16 * 12)
    assert count[0] > plain[8]
    assert count[5] > plain[13]
    held = u.instance == 5
    row, column = u.pixel // 320, u.pixel % 320
    assert np.array_equal(held, (row >= 100) & (row < 130) & (column >= 80) & (column < 110))
    assert len(shared_samples(u, v)[0]) == 4 * 32 * 24


def test_samples_are_rounded_far_below_noise() -> None:
    reconstruction, library = make_chunk(0, 6, True)
    samples = frame_samples(reconstruction, library)
    back = samples.points[:, :2] / samples.points[:, 2:] * 250 + [159.5, 119.5]
    pixel = np.column_stack([samples.pixel % 320, samples.pixel // 320])
    assert np.abs(back - pixel).max() < 0.02
    assert np.abs(samples.points[:, 2] - 2.0).max() < 2e-4

"""Things that move before the camera: found, followed, kept apart from what stays."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.instances.library import build_library
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import LocalLibrary
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.motion.free_space import SmallFrames, movers_in_free_space
from list3r.reconstruction.motion.tracks import track_movers
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from tests.rgbd_scenes import BOXES, CAMERA, render, walk

FRAMES = 48
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def walker(k: int) -> Box:
    """A tall box that crosses the picture at 1.2 m/s, y down."""
    x = -1.1 + 0.04 * k
    return (x - 0.18, -0.6, 1.15), (x + 0.18, 1.0, 1.4)


def carried(k: int) -> Box:
    """A box that stands beside another, is lifted and carried, and is put down."""
    go = float(np.clip((k - 14) / 16.0, 0.0, 1.0))
    x, lift = -0.5 + 0.9 * go, 0.3 * np.sin(np.pi * go)
    return (x - 0.12, -0.05 - lift, 1.25), (x + 0.12, 0.2 - lift, 1.45)


def filmed(mover: object) -> list[Frame]:
    """A walk through the room with a box that moves, or none."""
    out = []
    for k, T in enumerate(walk(FRAMES)):
        boxes = BOXES if mover is None else (*BOXES, mover(k))  # type: ignore[operator]
        out.append(render(T, boxes=boxes, index=k, time_s=k / 30))
    return out


@lru_cache(maxsize=4)
def built(name: str, poses: str) -> tuple[list[Frame], Reconstruction, LocalLibrary]:
    frames = filmed({"walker": walker, "carried": carried, "none": None}[name])
    result = RgbdReconstructor(poses=poses)(frames, CAMERA)
    return frames, result, build_library(frames, result)


def truth(mover: object, frames: np.ndarray) -> np.ndarray:
    return np.array([np.mean(mover(int(k)), axis=0) for k in frames])  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.parametrize("poses", ["given", "estimate"])
def test_what_walks_by_is_one_dynamic_instance_with_its_track(poses: str) -> None:
    frames, result, library = built("walker", poses)
    moving = [i for i in library.instances if i.dynamic]
    assert len(moving) == 1
    motion = moving[0].motion
    assert motion is not None
    T_world_chunk = frames[0].T_source_cam if poses == "estimate" else np.eye(4)
    assert T_world_chunk is not None
    places = motion.positions @ T_world_chunk[:3, :3].T + T_world_chunk[:3, 3]
    away = np.linalg.norm((places - truth(walker, motion.frames))[:, [0, 2]], axis=1)
    assert len(motion.frames) >= 24
    assert away.max() < 0.15
    assert result.posed.all()


def test_masks_lie_on_the_mover() -> None:
    frames, _, library = built("walker", "given")
    track = next(i.track for i in library.instances if i.dynamic)
    for frame, mask in list(zip(track.frames, track.masks, strict=True))[::6]:
        still, now = render(walk(FRAMES)[frame], index=int(frame)), frames[frame]
        assert still.depth is not None and now.depth is not None
        there = still.depth - now.depth > 0.1
        found = decode_mask(mask, track.image_size)
        if there.sum() > 2000:
            assert (found & there).sum() > 0.9 * found.sum()
            assert (found & there).sum() > 0.7 * there.sum()


def test_what_stays_does_not_see_the_mover() -> None:
    _, result, library = built("walker", "given")
    assert result.movers is not None
    for position in range(0, FRAMES, 7):
        taken = np.kron(result.movers[position] > 0, np.ones((2, 2), bool))[: CAMERA.height, : CAMERA.width]
        assert not result.depth[position][taken].any()
        assert not result.confidence[position][taken].any()
    low, high = np.array([-1.3, -0.7, 1.1]), np.array([1.0, 0.15, 1.45])
    for instance in library.instances:
        inside = np.all((instance.support.points > low) & (instance.support.points < high), axis=1)
        assert instance.dynamic or inside.mean() < 0.05


def test_the_other_things_are_those_of_the_still_room() -> None:
    _, _, still = built("none", "given")
    _, _, moved = built("walker", "given")
    assert sum(not i.dynamic for i in moved.instances) >= 0.8 * len(still.instances)


@pytest.mark.parametrize("poses", ["given", "estimate"])
def test_nothing_moves_in_a_still_room(poses: str) -> None:
    _, result, library = built("none", poses)
    assert result.movers is None
    assert not any(i.dynamic for i in library.instances)


def test_a_thing_carried_away_is_followed_from_rest_to_rest() -> None:
    _, _, library = built("carried", "given")
    moving = [i for i in library.instances if i.dynamic]
    assert len(moving) == 1
    motion = moving[0].motion
    assert motion is not None
    away = np.linalg.norm(motion.positions - truth(carried, motion.frames), axis=1)
    assert np.median(away) < 0.12
    assert motion.frames[0] <= 14 and motion.frames[-1] >= 40
    middle = np.quantile(moving[0].support.points, [0.02, 0.98], axis=0).mean(axis=0)
    assert np.linalg.norm(middle - np.mean(carried(FRAMES), axis=0)) < 0.12


def test_degenerate_chunks_have_no_movers() -> None:
    frames = filmed(walker)[:3]
    poses = np.array([f.T_source_cam for f in frames])
    depths = [f.depth for f in frames]
    for posed in (np.zeros(3, bool), np.array([True, False, False])):
        assert movers_in_free_space(SmallFrames.of(depths, poses, posed, CAMERA, 160)) is None
    nothing = SmallFrames.of([None] * 3, poses, np.ones(3, bool), CAMERA, 160)
    assert movers_in_free_space(nothing) is None
    empty = SmallFrames.of([np.zeros_like(frames[0].depth)] * 3, poses, np.ones(3, bool), CAMERA, 160)
    assert movers_in_free_space(empty, {0: np.ones((120, 160), bool)}) is None
    masks = np.zeros(empty.depth.shape, bool)
    masks[0, 10:20, 10:20] = True
    assert track_movers(masks, [f.color for f in frames], np.arange(3.0), empty) is None


def test_a_blob_that_goes_nowhere_is_no_mover() -> None:
    frames = filmed(None)[:12]
    poses = np.array([f.T_source_cam for f in frames])
    small = SmallFrames.of([f.depth for f in frames], poses, np.ones(12, bool), CAMERA, 160)
    bare = [render(T, boxes=BOXES[:2], index=k).depth for k, T in enumerate(poses)]
    masks = np.array([b[::2, ::2] - f.depth[::2, ::2] > 0.15 for b, f in zip(bare, frames, strict=True)])
    assert masks.any(axis=(1, 2)).all()
    assert track_movers(masks, [f.color for f in frames], np.arange(12) / 30, small) is None


def test_frames_without_depth_are_left_out() -> None:
    frames = [replace(f, depth=None) if f.index in (5, 20) else f for f in filmed(walker)]
    result = RgbdReconstructor(poses="given")(frames, CAMERA)
    assert result.movers is not None and not result.movers[[5, 20]].any()

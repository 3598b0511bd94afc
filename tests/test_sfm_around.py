"""Chunks mapped with frames around them: which ones, that they help and are no part of it; which map is believed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame
from list3r.frames.chunking.borrowing import frames_around
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.geometry import umeyama
from list3r.reconstruction.sfm.consistency import contradicted
from list3r.reconstruction.sfm.links import context_step
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap, agreed, build_maps, first_pairs
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor
from list3r.reconstruction.sfm.settings import LinkSettings, MappingSettings
from list3r.reconstruction.sfm.tracks import CornerTracks
from tests.rgbd_scenes import CAMERA
from tests.test_sfm import FRAMES, Held, centres, walk


@pytest.mark.parametrize(
    ("span", "shot", "step", "count", "before", "behind"),
    [
        ((10, 14), (0, 24), 3, 2, [4, 7], [16, 19]),
        ((10, 14), (0, 24), 3, 9, [1, 4, 7], [16, 19, 22]),
        ((10, 14), (9, 15), 3, 2, [], []),
        ((0, 14), (0, 24), 5, 2, [], [18, 23]),
        ((10, 24), (0, 24), 1, 2, [8, 9], []),
    ],
)
def test_frames_around_a_stretch_are_at_even_steps_and_of_its_shot(
    span: tuple[int, int], shot: tuple[int, int], step: int, count: int, before: list[int], behind: list[int]
) -> None:
    early, late = frames_around(Held(walk(), CAMERA), span, shot, step, count)
    assert [f.index for f in early] == before and [f.index for f in late] == behind


def test_a_frame_around_that_cannot_be_decoded_is_left_out() -> None:
    class Broken(Held):
        def read_every(self, start: int, stop: int, step: int):
            return (BadFrame(f.index, "broken") if f.index == 7 else f for f in super().read_every(start, stop, step))

    early, _ = frames_around(Broken(walk(), CAMERA), (10, 14), (0, 24), 3, 2)
    assert [f.index for f in early] == [4]


@pytest.mark.slow
def test_frames_around_help_and_are_no_part_of_the_chunk() -> None:
    asked: list[tuple[int, int]] = []

    def around(step: int, count: int) -> tuple[Sequence[Frame], Sequence[Frame]]:
        asked.append((step, count))
        return frames_around(Held(walk(), CAMERA), (8, 16), (0, FRAMES), 2, 4)

    chunk = walk()[8:16]
    (part,) = SfmReconstructor().parts(chunk, CAMERA, around)
    assert len(asked) == 1 and asked[0][0] >= 1
    assert part.frame_indices.tolist() == list(range(8, 16)) and part.posed.all()
    S = umeyama(part.T_chunk_cam[:, :3, 3], centres(chunk), with_scale=True)
    assert np.linalg.norm(S.apply(part.T_chunk_cam[:, :3, 3]) - centres(chunk), axis=1).max() < 0.005


@pytest.mark.slow
@pytest.mark.data
def test_a_chunk_with_little_motion_is_not_bent(shared_data: Path) -> None:
    """The camera moves 0.2 m and sees 0.8 to 3 m deep: alone, the near comes out 1.2 times too far by the far."""
    options = SourceOptions(intrinsics=(525.0, 525.0, 320.0, 240.0), distortion=(-0.025,))
    source = open_source(shared_data / "redkitchen", options)
    assert source.info.camera is not None
    start, stop = 770, 870
    frames = [f for f in source.read(start, stop) if isinstance(f, Frame)]
    model = SfmReconstructor()
    grays = [np.asarray(f.color.mean(axis=2), np.uint8) for f in frames]
    segment = model._segments(
        frames, grays, source.info.camera, partial(frames_around, source, (start, stop), (0, 1000))
    )[0]
    ratios, depths = [], []
    for k in segment.T_map_cam:
        xy, found = segment.depths(k)
        at = np.rint(xy).astype(int)
        sensor = np.asarray(frames[k].depth)[at[:, 1], at[:, 0]]
        ratios.append((found / np.maximum(sensor, 1e-3))[sensor > 0])
        depths.append(sensor[sensor > 0])
    ratio, depth = np.concatenate(ratios), np.concatenate(depths)
    assert 0.9 < np.median(ratio[depth < 1.3]) / np.median(ratio[depth > 2.2]) < 1.12


@pytest.mark.parametrize(("keyframes", "frames", "step"), [(10, 100, 20), (2, 100, 25), (100, 100, 2), (3, 3, 2)])
def test_the_faster_the_picture_changes_the_nearer_are_the_frames_around(
    keyframes: int, frames: int, step: int
) -> None:
    none = tuple(np.zeros(0, np.int64) for _ in range(frames))
    nowhere = tuple(np.zeros((0, 2), np.float32) for _ in range(frames))
    tracks = CornerTracks(
        none, nowhere, tuple(range(keyframes)), np.zeros(frames, np.int64), np.zeros(frames, np.float32)
    )
    assert context_step(tracks, LinkSettings()) == step


def sized(keyframes: int, error_px: float) -> list[SparseMap]:
    return [SparseMap({k: np.eye(4) for k in range(keyframes)}, {}, CAMERA, 0.0, error_px)]


@pytest.mark.parametrize(
    ("grown", "same"),
    [
        ([sized(10, 0.4)], False),
        ([sized(10, 0.4), sized(10, 0.401)], True),
        ([sized(10, 0.4), sized(10, 0.44)], False),
        ([sized(10, 0.4), sized(9, 0.4)], False),
        ([sized(10, 0.4), [], sized(10, 0.4)], True),
        ([[], []], False),
        ([sized(10, 0.4) + sized(4, 0.4), sized(10, 0.4) + sized(4, 0.4)], False),
    ],
)
def test_two_maps_agree_in_their_keyframes_and_their_error(grown: list[list[SparseMap]], same: bool) -> None:
    assert agreed(grown, MappingSettings()) is same


def test_maps_are_also_grown_from_what_shares_most_in_the_second_and_the_last_third() -> None:
    none = KeyframeView(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))
    keys = range(0, 60, 2)
    steps = {(a, b): np.zeros((200 - (b - a), 2), np.int64) for a in keys for b in keys if a < b <= a + 20}
    steps[24, 34] = steps[50, 58] = np.zeros((500, 2), np.int64)  # five and four keyframes on
    steps[30, 32] = steps[4, 14] = steps[52, 100] = np.zeros((900, 2), np.int64)  # next, first third, not its own
    problem = MapProblem({**dict.fromkeys(keys, none), 100: none}, steps, context=frozenset([100]))
    assert first_pairs(problem, MappingSettings()) == [(24, 34), (50, 58)]
    assert first_pairs(MapProblem(dict.fromkeys(range(3), none), {}), MappingSettings()) == []


def test_pairs_of_which_nothing_was_verified_contradict_nothing() -> None:
    none = np.zeros((0, 2), np.float32)
    assert contradicted({0: np.eye(4), 1: np.eye(4)}, {(0, 1): (none, none)}, CAMERA) == set()


def test_views_beside_are_in_no_map() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform((-1.0, -0.8, 1.5), (1.0, 0.8, 3.0), (200, 3))
    views = {}
    for key, x in enumerate((0.0, 0.2, 0.4, 0.6)):
        seen = points - (x, 0.0, 0.0)
        xy = seen[:, :2] / seen[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
        views[key] = KeyframeView(np.arange(200), xy.astype(np.float32))
    rows = np.stack([np.arange(200)] * 2, axis=1)
    pairs = {(a, b): rows for a in range(4) for b in range(a + 1, 4)}
    (whole,) = build_maps(MapProblem(views, pairs), CAMERA)
    (part,) = build_maps(MapProblem(views, pairs, context=frozenset({0, 3})), CAMERA)
    assert sorted(whole.T_map_cam) == [0, 1, 2, 3] and sorted(part.T_map_cam) == [1, 2]
    assert set(part.seen) <= {1, 2}

"""Keyframes tied by local features where nothing can be followed: truth recovered, what contradicts itself left out."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import Camera, Frame
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import umeyama
from list3r.reconstruction.features.detectors import make_detector
from list3r.reconstruction.features.learned import LearnedDetector
from list3r.reconstruction.registry import ModelOptions, make_reconstructor
from list3r.reconstruction.sfm.consistency import contradicted, epipolar_errors
from list3r.reconstruction.sfm.frame_poses import PosedSegment, pose_segments
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures, likely_pairs, make_finder, match_features
from list3r.reconstruction.sfm.links import keyframe_problem
from list3r.reconstruction.sfm.mapping import build_maps
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor
from list3r.reconstruction.sfm.settings import FinderSettings, SfmSettings
from list3r.reconstruction.sfm.tracks import follow_corners
from tests.rgbd_scenes import CAMERA
from tests.test_sfm import pose


@lru_cache(maxsize=2)
def kitchen(data: Path, every: int) -> tuple[tuple[Frame, ...], Camera]:
    """Frames so far apart that nothing can be followed from one to the next."""
    lens = {"intrinsics": (525.0, 525.0, 320.0, 240.0), "distortion": (-0.025,)}
    source = open_source(data / "redkitchen", SourceOptions(every=every, start=400, stop=400 + 12 * every, **lens))
    assert source.info.camera is not None
    return tuple(f for f in source.read(0, 12) if isinstance(f, Frame)), source.info.camera


def segments(frames: tuple[Frame, ...], camera: Camera, detector: LearnedDetector | None) -> list[PosedSegment]:
    """The poses of a chunk, without its dense depth."""
    model = SfmReconstructor(detector=detector)
    grays = [np.asarray(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), np.uint8) for f in frames]
    return model._segments(frames, grays, camera)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("kind", "every"), [("sift", 16), ("aliked/aliked-t16.pth", 20)])
def test_frames_far_apart_are_posed_together(kind: str, every: int, shared_data: Path):
    frames, camera = kitchen(shared_data, every)
    weights = shared_data.parent / "weights" / kind
    if kind != "sift" and not weights.is_file():
        pytest.skip(f"{weights} is not there")
    detector = None if kind == "sift" else make_detector(kind.split("/")[0], weights)
    found = segments(frames, camera, detector)[0]
    posed = sorted(found.T_map_cam)
    assert len(posed) >= len(frames) - 2
    made = np.stack([found.T_map_cam[k][:3, 3] for k in posed])
    true = np.stack([np.asarray(frames[k].T_source_cam)[:3, 3] for k in posed])
    off = np.linalg.norm(umeyama(made, true, with_scale=True).apply(made) - true, axis=1)
    assert np.sqrt((off**2).mean()) < 0.05
    assert all(len(found.seen[k][0]) >= 20 for k in posed), "each frame tells the depth of what it sees"


@pytest.mark.data
def test_chosen_pairs_are_those_that_see_the_same(shared_data: Path):
    frames, _ = kitchen(shared_data, 16)
    grays = [np.asarray(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), np.uint8) for f in frames]
    find, s = make_finder(grays, None, None, FinderSettings(partners=2)), FinderSettings(partners=2)
    features = {k: find(k) for k in range(len(grays))}
    pairs = likely_pairs(features, set(), s)
    assert pairs == sorted(set(pairs)) and len(pairs) <= 2 * len(grays)
    assert np.mean([b - a == 1 for a, b in pairs]) > 0.5, "neighbours look most alike"
    assert not set(likely_pairs(features, set(pairs), s)) & set(pairs)
    a, b = pairs[0]
    forth, back = match_features(features[a], features[b]), match_features(features[b], features[a])
    assert len(set(map(tuple, forth)) & set(map(tuple, back[:, ::-1]))) > 0.6 * len(forth)


def test_pictures_without_features_have_no_partners():
    none = LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), 0.85)
    assert likely_pairs({0: none, 1: none}, set(), FinderSettings()) == []
    assert likely_pairs({}, set(), FinderSettings()) == []


def seen_from(poses: dict[int, np.ndarray]) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
    """Where cameras see the same points of a room, by pairs."""
    points = np.random.default_rng(3).uniform((-1, -0.8, 1.5), (1, 0.8, 3.5), (120, 3))
    xy = {}
    for k, T in poses.items():
        local = (points - T[:3, 3]) @ T[:3, :3]
        xy[k] = (local[:, :2] / local[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)).astype(np.float32)
    return {(a, b): (xy[a], xy[b]) for a in poses for b in poses if a < b}


def test_matches_lie_on_the_epipolar_lines_of_true_poses():
    poses = {k: pose(0.1 * k, 0.02 * k**2, -0.4, 0.03 * k) for k in range(5)}
    for (a, b), xy in seen_from(poses).items():
        assert epipolar_errors(*xy, poses[a], poses[b], CAMERA).max() < 1e-2


def test_a_keyframe_in_a_wrong_place_is_taken_out_and_no_other():
    poses = {k: pose(0.1 * k, 0.02 * k**2, -0.4, 0.03 * k) for k in range(6)}
    seen = seen_from(poses)
    assert contradicted(poses, seen, CAMERA) == set()
    wrong = {**poses, 5: pose(0.2, -0.6, 0.3, 0.4)}
    assert contradicted(wrong, seen, CAMERA) == {5}
    assert contradicted(wrong, {}, CAMERA) == set(), "what nothing is known of is not contradicted"


def test_what_can_be_followed_needs_no_features():
    from tests.test_sfm import walk

    grays = [np.asarray(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), np.uint8) for f in walk()]
    tracks = follow_corners(grays)

    def find(position: int) -> LocalFeatures:
        raise AssertionError("features were asked for")

    problem = keyframe_problem(tracks, grays, finder=find)
    assert not problem.matched and set(problem.views) == set(tracks.keyframes)


def test_keyframes_known_by_features_alone_keep_their_poses():
    """Each frame begins a run of its own: no corner is followed, yet all are posed and see points."""
    from tests.test_sfm import FRAMES, walk

    grays = [np.asarray(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), np.uint8) for f in walk()][::3]
    tracks = follow_corners(grays)
    empty = tuple(np.arange(40) + 1000 * k for k in range(len(grays)))
    apart = replace(
        tracks,
        ids=empty,
        xy=tuple(np.random.default_rng(k).uniform(5, 100, (40, 2)).astype(np.float32) for k in range(len(grays))),
        keyframes=tuple(range(len(grays))),
        run=np.arange(len(grays)),
    )
    problem = keyframe_problem(apart, grays)
    assert problem.matched == frozenset(problem.pairs)
    maps = build_maps(problem, CAMERA, settings=SfmSettings().mapping)
    segment = pose_segments(maps, apart, grays)[0]
    assert sorted(segment.T_map_cam) == list(range(FRAMES // 3))
    assert min(len(xy) for xy, _ in segment.seen.values()) >= 20


def test_weights_of_local_features_that_are_not_there_are_named():
    with pytest.raises(OptionError, match="nowhere"):
        make_reconstructor("sfm", ModelOptions(device="cpu", local_features="aliked", feature_weights="nowhere"))

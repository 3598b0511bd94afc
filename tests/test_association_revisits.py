"""Revisits: the same place is found again with the right pose, another place is not, and the reason is given."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from scipy.stats import chi2

from list3r.association.paper.loops import loops_by_score
from list3r.association.revisits.frame_search import TRAINED, FeatureIndex, SearchSettings, choose, find_candidates
from list3r.association.revisits.instance_similarity import InstanceSimilarity
from list3r.association.revisits.scaled_verification import _fit, _similarities, verify_scaled
from list3r.association.revisits.search import RevisitSettings, find_loops
from list3r.association.revisits.verification import VerificationSettings, verify
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Edge, FrameSamples, Keyframe
from list3r.memory.store.derived import Derived
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.features.local import match, relative_pose
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.keyframe_record import frame_samples, make_keyframes
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from tests.rgbd_scenes import CAMERA, frames_along, pose_errors, walk

VIEW = (140.0, 140.0, 79.5, 59.5)
GAUGE = Sim3.exp([0.3, -0.2, 0.5, 0.2, 0.4, -0.1, 0.0]).as_matrix()


class Chunks:
    """A store of chunks with keyframes alone."""

    def __init__(
        self, done: list[tuple[Keyframe, ...]], scale_kind: str = "metric", known: Sequence[Edge] = ()
    ) -> None:
        self.done, self.scale_kind, self.known = done, scale_kind, known
        self.derived = Derived()
        self.chunks = SimpleNamespace(
            all=self._all,
            checksums=lambda: {k: id(ks) for k, ks in enumerate(done)},
            checksum=lambda chunk_id: id(self.done[chunk_id]),
            samples=lambda chunk_id: FrameSamples.empty(),
            feature_space=lambda chunk_id: "test@1/4",
        )
        self.keyframes = SimpleNamespace(get=self._keyframe, descriptors=self._descriptors)
        self.local_instances = SimpleNamespace(
            nodes=lambda chunk_ids: [], signature=lambda chunk_id: (0,), dynamic=lambda chunk_id: []
        )
        self.edges = SimpleNamespace(all=lambda: list(known))

    def _all(self, session_id: int | None = None) -> list[ChunkRow]:
        place = (1.0, 1.0, 0.0, 0.0)
        return [
            ChunkRow(k, 0, k, 0, 0, 0, Sim3.identity(), place, (240, 320), self.scale_kind)
            for k in range(len(self.done))
        ]

    def _keyframe(self, chunk_id: int, frame_index: int) -> Keyframe:
        return next(k for k in self.done[chunk_id] if k.frame_index == frame_index)

    def _descriptors(self, chunk_ids: Sequence[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
        wanted = range(len(self.done)) if chunk_ids is None else chunk_ids
        rows = [(c, k) for c in wanted for k in self.done[c]]
        keys = np.array([(c, k.frame_index) for c, k in rows], np.int64).reshape(-1, 2)
        return keys, np.array([k.descriptor for _, k in rows], np.float32)


def keyframes_at(start: float, seed: int = 0, first: int = 0, gauge: np.ndarray | None = None) -> tuple[Keyframe, ...]:
    """One keyframe of a chunk, in a gauge of its own."""
    frames = [replace(f, index=first) for f in frames_along(walk(1, start=start), seed=seed)]
    result = RgbdReconstructor(poses="given")(frames, CAMERA)
    if gauge is not None:
        result = replace(result, T_chunk_cam=gauge @ result.T_chunk_cam)
    return make_keyframes(frames, result, keep_jpeg=True)


@pytest.fixture(scope="module")
def here() -> Keyframe:
    return keyframes_at(0.0)[0]


@pytest.fixture(scope="module")
def again() -> Keyframe:
    return keyframes_at(0.7, first=200, gauge=GAUGE)[0]


@pytest.mark.parametrize("most", [0, 2])
def test_a_network_is_asked_a_bounded_number_of_times_where_features_fail(here: Keyframe, most: int) -> None:
    # five places that look the same and whose features are those of something else
    rng = np.random.default_rng(0)
    other = [
        replace(here, frame_index=300 * k, keypoint_descriptors=rng.permuted(here.keypoint_descriptors, axis=1))
        for k in range(6)
    ]
    asked: list[Sequence[int]] = []
    store = Chunks([(k,) for k in other], scale_kind="relative")
    edges = find_loops(store, 5, lambda *ends: asked.append(ends), RevisitSettings(second_opinions=most))  # type: ignore[arg-type,func-returns-value]
    assert len(asked) == most
    assert len(edges) >= 4 and not any(e.accepted for e in edges)
    said = [e.reason for e in edges if "cannot be reconstructed together" in e.reason]
    assert len(said) == most


def test_a_network_is_not_asked_where_features_tell(here: Keyframe, again: Keyframe) -> None:
    asked: list[Sequence[int]] = []
    far = replace(here, frame_index=150, keypoint_descriptors=here.keypoint_descriptors[:0])
    store = Chunks([(here,), (far,), (again,)], scale_kind="relative")
    edges = find_loops(store, 2, lambda *ends: asked.append(ends), RevisitSettings(second_opinions=3))  # type: ignore[arg-type,func-returns-value]
    assert not asked and [e.accepted for e in edges] == [True]


def test_a_keyframe_holds_what_it_says(here: Keyframe) -> None:
    assert np.linalg.norm(here.descriptor) == pytest.approx(1.0, abs=1e-5)
    assert here.keypoint_descriptors.dtype == np.uint8
    assert len(here.keypoints_xy) == len(here.keypoint_descriptors) == len(here.points_cam) > 100
    assert here.depth_small.shape == (120, 160)
    assert here.jpeg[:2] == b"\xff\xd8"
    known = np.isfinite(here.points_cam[:, 0])
    u = here.points_cam[known, 0] / here.points_cam[known, 2] * CAMERA.fx + CAMERA.cx
    assert np.allclose(u, here.keypoints_xy[known, 0], atol=0.01)


def test_a_revisit_is_verified_with_the_right_pose(here: Keyframe, again: Keyframe) -> None:
    edge = verify(here, again, 0, 2)
    assert edge.accepted, edge.reason
    assert (edge.kind, edge.frames) == ("loop", (0, 200))
    found = np.stack([np.eye(4), edge.S_v_u.as_matrix()])
    shift, turn = pose_errors(found, np.stack([np.eye(4), GAUGE]))
    assert shift[1] < 0.02
    assert turn[1] < 0.5
    assert edge.confidence > 0.7
    assert edge.covariance is not None
    off = (Sim3.from_matrix(GAUGE).inverse() @ edge.S_v_u).log()[:6]
    inside = float(off @ np.linalg.solve(edge.covariance[:6, :6], off))
    assert 0.0 < inside < chi2.ppf(0.99, 6)
    assert np.sqrt(np.diag(edge.covariance)[:6]).max() < 0.1
    assert not edge.covariance[6].any()


def test_another_place_is_rejected_with_a_reason(here: Keyframe) -> None:
    other = keyframes_at(0.0, seed=9, first=300)[0]
    edge = verify(here, other, 0, 2)
    assert not edge.accepted
    assert "features" in edge.reason
    assert edge.weight == 0.0


def test_a_place_with_something_in_front_is_rejected(here: Keyframe, again: Keyframe) -> None:
    depth = again.depth_small.copy()
    depth[20:100, 20:140] *= 0.6
    edge = verify(here, replace(again, depth_small=depth), 0, 2)
    assert not edge.accepted


def _before(keyframe: Keyframe, columns: slice, nearer: float) -> Keyframe:
    """A keyframe with a flat thing that hides part of its picture, so much nearer than what was seen there."""
    depth = keyframe.depth_small.copy()
    depth[20:100, columns] *= 1.0 - nearer
    return replace(keyframe, depth_small=depth)


@pytest.mark.parametrize("gone", [True, False])
def test_what_was_taken_away_or_put_there_between_two_sessions_does_not_speak_against_a_place(
    here: Keyframe, again: Keyframe, gone: bool
) -> None:
    u, v = (_before(here, slice(40, 120), 0.3), again) if gone else (here, _before(again, slice(40, 120), 0.3))
    edge = verify(u, v, 0, 2, later=True)
    assert edge.accepted, edge.reason
    shift, turn = pose_errors(np.stack([np.eye(4), edge.S_v_u.as_matrix()]), np.stack([np.eye(4), GAUGE]))
    assert (shift[1] < 0.02, turn[1] < 0.5) == (True, True)
    assert not verify(u, v, 0, 2).accepted
    both = _before(here, slice(10, 80), 0.3), _before(again, slice(80, 150), 0.3)
    assert not verify(*both, 0, 2, later=True).accepted


def _bare_room(T_world_cam: np.ndarray, picture: bool, seed: int) -> Keyframe:
    """A wall, a floor, and a picture 8 cm before the wall that hides most of it; features are known within 1.5 cm."""
    rays = np.stack(
        [*np.meshgrid((np.arange(160) - 79.5) / 140.0, (np.arange(120) - 59.5) / 140.0), np.ones((120, 160))], -1
    )
    ways, eye = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    depth = np.minimum((2.5 - eye[2]) / ways[..., 2], np.where(ways[..., 1] > 0, (1.2 - eye[1]) / ways[..., 1], np.inf))
    if picture:
        near = (2.42 - eye[2]) / ways[..., 2]
        at = eye + near[..., None] * ways
        depth = np.where((np.abs(at[..., 0]) < 0.8) & (np.abs(at[..., 1] + 0.1) < 0.6), near, depth)
    fixed, noise = np.random.default_rng(5), np.random.default_rng(seed)
    points = np.column_stack([fixed.uniform(-0.9, 0.9, 40), fixed.uniform(0.6, 1.2, 40), np.full(40, 2.5)])
    cam = (points - eye) @ T_world_cam[:3, :3] + noise.normal(0.0, 0.015, (40, 3))
    words = fixed.integers(0, 255, (40, 128)).astype(np.uint8)
    xy = cam[:, :2] / cam[:, 2:] * 140.0 + [79.5, 59.5]
    look = np.ones(4, np.float32) / 2
    return Keyframe(
        seed, np.eye(4), look, xy.astype(np.float32), words, cam.astype(np.float32), depth.astype(np.float32), VIEW
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_wall_is_not_taken_for_the_picture_that_hung_before_it(seed: int) -> None:
    """Features say within centimetres where the views are; a gate as wide as that keeps them there, a wider one does
    not."""
    rng = np.random.default_rng(seed)
    T_u_v = Sim3.exp([*rng.normal(0.0, 0.15, 3), *rng.normal(0.0, 0.06, 3), 0.0]).as_matrix()
    u, v = _bare_room(np.eye(4), True, 1 + 2 * seed), _bare_room(T_u_v, False, 2 + 2 * seed)
    chosen = VerificationSettings()
    wide = replace(chosen, registration=chosen.scaled_registration)
    point, true = np.array([[0.0, 0.0, 2.5]]), Sim3.from_matrix(np.linalg.inv(T_u_v))
    found = [verify(u, v, 0, 2, settings=s, later=True).S_v_u.apply(point) for s in (chosen, wide)]
    off = [float(np.linalg.norm(p - true.apply(point))) for p in found]
    assert off[0] < 0.03
    assert off[1] > 0.1


def test_a_revisit_of_chunks_without_scale_is_verified_with_its_scale(here: Keyframe, again: Keyframe) -> None:
    u, v = rescaled(here, 3.0), rescaled(again, 0.4)
    edge = verify_scaled(u, v, 0, 2)
    assert edge.accepted, edge.reason
    assert float(edge.S_v_u.scale) == pytest.approx(0.4 / 3.0, rel=0.02)
    point = np.array([[0.0, 0.0, 2.0]])
    truth = 0.4 * (point @ GAUGE[:3, :3].T + GAUGE[:3, 3])
    assert np.linalg.norm(edge.S_v_u.apply(3.0 * point) - truth) < 0.4 * 0.05
    true = Sim3(np.asarray(0.4 / 3.0), GAUGE[:3, :3], 0.4 * GAUGE[:3, 3])
    off = (true.inverse() @ edge.S_v_u).log()
    assert edge.covariance is not None
    assert float(off @ np.linalg.solve(edge.covariance, off)) < chi2.ppf(0.99, 7)
    assert 0.005 < np.sqrt(edge.covariance[6, 6]) < 0.05
    assert not verify_scaled(u, keyframes_at(0.0, seed=9, first=300)[0], 0, 2).accepted
    empty = replace(v, keypoints_xy=v.keypoints_xy[:0], keypoint_descriptors=v.keypoint_descriptors[:0])
    assert not verify_scaled(u, replace(empty, points_cam=v.points_cam[:0]), 0, 2).accepted


def rescaled(keyframe: Keyframe, factor: float) -> Keyframe:
    T = keyframe.T_chunk_cam.copy()
    T[:3, 3] *= factor
    points, depth = keyframe.points_cam * np.float32(factor), keyframe.depth_small * np.float32(factor)
    return replace(keyframe, T_chunk_cam=T, points_cam=points, depth_small=depth)


def test_triples_give_the_similarities_that_each_gives_by_itself() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 60, 3))
    a[:3] = a[0]
    triples = np.concatenate([[(0, 1, 2)], rng.integers(0, 60, (300, 3))])  # some determine nothing, one a collapse
    alone = [S for S in (_fit(b[t], a[t]) for t in triples) if S is not None]
    together = _similarities(b[triples], a[triples])
    assert len(alone) < len(triples)
    assert np.allclose(together.as_matrix(), [S.as_matrix() for S in alone], atol=1e-9)


def test_loops_are_found_among_stored_chunks(here: Keyframe, again: Keyframe) -> None:
    store = Chunks([(here,), keyframes_at(3.0, first=150), (again,)])
    edges = find_loops(store, 2)
    assert [(e.u, e.v) for e in edges if e.accepted] == [(0, 2)]
    assert all(e.u != 1 for e in edges)
    assert {"cosine", "s_det", "s_sem", "s_rel", "s_loop", "pairs"} <= set(edges[0].scores)
    assert find_loops(store, 0) == []


def test_loops_of_chunks_without_scale(here: Keyframe, again: Keyframe) -> None:
    store = Chunks([(rescaled(here, 2.0),), keyframes_at(3.0, first=150), (again,)], "relative")
    edges = [e for e in find_loops(store, 2) if e.accepted]
    assert [(e.u, e.v) for e in edges] == [(0, 2)]
    assert float(edges[0].S_v_u.scale) == pytest.approx(0.5, rel=0.02)


def test_what_fits_two_places_of_a_part_apart_is_not_believed(here: Keyframe, again: Keyframe) -> None:
    apart = Sim3.exp([4.0, 0, 0, 0, 0, 0, 0])
    kinds = {"kind": "adjacent", "confidence": 0.9, "weight": 0.9, "inliers": 99, "residual_m": 0.0, "accepted": True}
    between = Edge(0, 1, S_v_u=apart, reason="", scores={"spread": 3.0}, covariance=1e-6 * np.eye(7), **kinds)
    twin, elsewhere = replace(here, frame_index=100), keyframes_at(3.0, first=150)
    edges = find_loops(Chunks([(here,), (twin,), elsewhere, (again,)], known=[between]), 3)
    assert {e.u for e in edges} == {0, 1} and not any(e.accepted for e in edges)
    assert all("other places fit as well" in e.reason for e in edges)
    tied = Edge(
        1, 3, S_v_u=Sim3.from_matrix(GAUGE), reason="", scores={"spread": 3.0}, covariance=1e-6 * np.eye(7), **kinds
    )
    edges = find_loops(Chunks([(here,), (twin,), elsewhere, (again,)], known=[between, tied]), 3)
    assert [e.u for e in edges if e.accepted] == [1]


def test_things_tell_which_of_two_places_that_frames_say_is_right(here: Keyframe, again: Keyframe) -> None:
    apart = Sim3.exp([4.0, 0, 0, 0, 0, 0, 0])
    kinds = {"confidence": 0.9, "weight": 0.9, "inliers": 99, "residual_m": 0.0, "accepted": True, "reason": ""}
    said = {"scores": {"spread": 3.0}, "covariance": 1e-6 * np.eye(7), **kinds}
    between = Edge(0, 1, "adjacent", apart, **said)
    told = Edge(1, 3, "loop", Sim3.from_matrix(GAUGE), **said)
    twin, elsewhere = replace(here, frame_index=100), keyframes_at(3.0, first=150)
    with patch("list3r.association.revisits.search.InstanceSearch.edges", return_value=[told]):
        edges = find_loops(Chunks([(here,), (twin,), elsewhere, (again,)], known=[between]), 3)
    assert {e.u for e in edges if e.accepted} == {1}
    assert any(e.accepted and e is not told for e in edges)


def test_frames_less_alike_are_refused_only_where_nothing_is_verified(here: Keyframe, again: Keyframe) -> None:
    less = replace(again, keypoint_descriptors=again.keypoint_descriptors[::60], keypoints_xy=again.keypoints_xy[:0])
    memory = Chunks([(here,), (), (less,)])
    for edges, refused in (
        (find_loops(memory, 2), False),
        (loops_by_score(memory, 2, None, RevisitSettings(rule="score")), True),
    ):
        assert len(edges) == 1 and edges[0].scores["s_det"] < 0.85
        assert ("not alike enough" in edges[0].reason) is refused


def test_chunks_without_keyframes_or_with_broken_descriptors(here: Keyframe, again: Keyframe) -> None:
    nothing = here.keypoint_descriptors[:0]
    broken = replace(here, descriptor=np.full_like(here.descriptor, np.nan), keypoint_descriptors=nothing)
    assert find_loops(Chunks([(), (), ()]), 2) == []
    assert find_loops(Chunks([(here,), (), ()]), 2) == []
    assert find_loops(Chunks([(broken,), (), (again,)]), 2) == []
    assert find_loops(Chunks([(here,), (), (replace(broken, frame_index=200),)]), 2) == []
    blind = replace(again, keypoints_xy=again.keypoints_xy[:0])
    edges = find_loops(Chunks([(here,), (), (blind,)]), 2)
    assert edges
    assert not any(e.accepted for e in edges)


def test_descriptors_that_are_all_equal_stay_within_the_quota(here: Keyframe) -> None:
    def chunk(first: int) -> tuple[Keyframe, ...]:
        blind = replace(here, keypoints_xy=here.keypoints_xy[:0])
        return tuple(replace(blind, frame_index=first + 30 * k) for k in range(6))

    edges = find_loops(Chunks([chunk(200 * k) for k in range(8)]), 7)
    settings = SearchSettings()
    assert 0 < len(edges) <= settings.per_chunk
    assert max(sum(e.u == k for e in edges) for k in range(8)) <= settings.per_pair_of_sessions


def test_appending_chunks_gives_the_same_candidates_as_reading_all_at_once(here: Keyframe, again: Keyframe) -> None:
    chunks = [(here,), keyframes_at(3.0, first=100), (again,), (replace(here, frame_index=400),)]
    grown, whole = Chunks(chunks[:3]), Chunks(chunks)
    find_loops(grown, 2)
    grown.done = chunks
    a, b = find_loops(grown, 3), find_loops(whole, 3)
    assert [(e.u, e.frames, e.accepted, e.scores) for e in a] == [(e.u, e.frames, e.accepted, e.scores) for e in b]


def test_candidates_keep_their_distance_and_their_quota() -> None:
    stored = np.array([(0, 2 * k) for k in range(6)] + [(1, 100 + 40 * k) for k in range(14)])
    cosine = np.array([0.9 - 0.01 * k for k in range(6)] + [0.8 - 0.01 * k for k in range(14)], np.float32)
    new = np.array([900] * 6 + [900 + 30 * k for k in range(14)])
    found = choose(new, stored, cosine, TRAINED, SearchSettings())
    assert (found[0].u, found[0].frame_u) == (0, 0)
    assert sum(c.u == 0 for c in found) == 1
    assert sum(c.u == 1 for c in found) <= SearchSettings().per_pair
    assert all(a.cosine >= b.cosine for a, b in itertools.pairwise(found))
    again = choose(new, stored, cosine, TRAINED, SearchSettings(), {1})
    assert sum(c.u == 1 for c in again) == SearchSettings().per_pair_of_sessions


def test_features_vote_for_the_frame_that_shows_the_same_place() -> None:
    rng = np.random.default_rng(0)
    frames = [unit(rng.normal(size=(200, 32))) for _ in range(60)]
    index = FeatureIndex()
    for first in range(0, 60, 20):
        keys = np.array([(first, k) for k in range(first, first + 20)])
        index.add(keys, frames[first : first + 20])
    asked = unit(rng.normal(size=(200, 32)))
    asked[:30] = unit(frames[41][:30] + rng.normal(0, 0.04, (30, 32)))
    allowed = np.ones((1, 60), bool)
    rows, votes = index.search([asked], allowed, 5)
    assert rows[0, 0] == 41 and votes[0, 0] > 3 * votes[0, 1]
    allowed[0, 41] = False
    rows, votes = index.search([asked], allowed, 60)
    assert votes[rows == 41].max(initial=0.0) == 0.0


def test_a_place_seen_from_many_keyframes_is_found_all_the_same() -> None:
    rng = np.random.default_rng(0)
    place = unit(rng.normal(size=(200, 32)))
    frames = [place] * 15 + [unit(rng.normal(size=(200, 32))) for _ in range(30)]
    index = FeatureIndex()
    index.add(np.array([(0, k) for k in range(45)]), frames)
    rows, votes = index.search([place], np.ones((1, 45), bool), 45)
    of_place = votes[rows < 15]
    assert of_place.sum() > 20 * votes[rows >= 15].sum() and of_place.max() > 0.03


def unit(x: np.ndarray) -> np.ndarray:
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True), np.float32)


def test_frames_of_neighbouring_chunks_are_a_revisit_only_far_apart(here: Keyframe, again: Keyframe) -> None:
    far, near = (find_candidates(Chunks([(here,), (replace(again, frame_index=n),)]), 1) for n in (90, 70))
    assert [(c.frame_u, c.frame_v) for c in far] == [(0, 90)] and not near


def test_two_chunks_are_joined_at_frames_apart(here: Keyframe, again: Keyframe) -> None:
    then = replace(here, frame_index=40)
    now = [replace(again, frame_index=n) for n in (200, 203, 240)]
    between = [
        Edge(k, k + 1, "adjacent", Sim3.identity(), 0.9, 0.9, 99, 0.0, True, "", {"spread": 3.0}) for k in (0, 1)
    ]
    between[1] = replace(between[1], S_v_u=Sim3.from_matrix(GAUGE))
    edges = find_loops(Chunks([(here, then), (), tuple(now)], known=between), 2)
    frames = [e.frames for e in edges if e.accepted]
    assert len(frames) == 2
    (a, b), (c, d) = sorted(frames)
    assert {a, c} == {0, 40} and abs(b - d) >= 4


def test_a_metric_relation_is_not_refused_by_the_layout_of_instances(here: Keyframe, again: Keyframe) -> None:
    layout = InstanceSimilarity(0.9, 0.9, tuple((k, k) for k in range(6)), float(np.log(2.2)))
    store = [(here,), keyframes_at(3.0, first=150), (again,)]
    with patch("list3r.association.revisits.search.compare_instances", return_value=layout):
        for kind, accepted in (("metric", True), ("relative", False)):
            edges = find_loops(Chunks(store, kind), 2)
            assert any(e.accepted for e in edges) is accepted


def test_cosines_are_put_on_one_scale() -> None:
    assert TRAINED.score(0.5) == pytest.approx(0.5)
    assert TRAINED.score(0.85) == pytest.approx(0.85)
    assert TRAINED.score(1.0) == 1.0


def test_features_give_the_relative_pose(here: Keyframe, again: Keyframe) -> None:
    pairs = match(here.keypoint_descriptors, again.keypoint_descriptors, 0.85)
    pose = relative_pose(here.points_cam[pairs[:, 0]], again.points_cam[pairs[:, 1]], FeatureSettings(), SensorNoise())
    assert pose is not None
    truth = np.stack([walk(1)[0], walk(1, start=0.7)[0]])
    shift, turn = pose_errors(np.stack([np.eye(4), pose.T_a_b]), truth)
    assert shift[1] < 0.05
    assert turn[1] < 1.5
    assert match(here.keypoint_descriptors[:1], again.keypoint_descriptors, 0.85).shape == (0, 2)
    assert relative_pose(here.points_cam[:5], again.points_cam[:5], FeatureSettings(), SensorNoise()) is None


def test_frame_samples_are_the_same_pixels_in_every_chunk() -> None:
    frames = frames_along(walk(8))
    result = RgbdReconstructor(poses="given")(frames, CAMERA)
    posed = result.posed.copy()
    posed[1] = False
    samples = frame_samples(replace(result, posed=posed))
    assert set(samples.frame.tolist()) == {0, 2, 3, 4, 5, 6, 7}
    assert samples.camera_frames.tolist() == [0, 2, 3, 4, 5, 6, 7]
    per_frame = np.bincount(samples.frame)
    assert per_frame[0] >= 150
    row, column = samples.pixel // CAMERA.width, samples.pixel % CAMERA.width
    first = samples.frame == 5
    camera_points = np.linalg.inv(result.T_chunk_cam[5]) @ np.c_[samples.points[first], np.ones(first.sum())].T
    assert np.allclose(camera_points[2], result.depth[5][row[first], column[first]], atol=1e-4)

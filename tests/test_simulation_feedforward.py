"""Laws of the simulated feed-forward model, and its errors where its settings say that they are."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from benchmarks.feedforward_sim.descriptors import Appearance
from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
from benchmarks.feedforward_sim.pose_errors import PoseErrorSettings, bend
from benchmarks.feedforward_sim.runs import runs_of
from benchmarks.simulation.covisibility import covisibility
from benchmarks.simulation.presets import make_video
from benchmarks.simulation.returns import make_return
from benchmarks.simulation.video import SimulatedVideo
from list3r.frames.chunking.chunks import ChunkSpan
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3, rotation_log, umeyama
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import FrameSamples

SPAN = ChunkSpan(2, 140, 240)


@pytest.fixture(scope="module")
def video() -> SimulatedVideo:
    return make_video("dynamic", 131)


@pytest.fixture(scope="module")
def twins() -> SimulatedVideo:
    return make_video("twins", 131)


def true_points(video: SimulatedVideo, s: FrameSamples) -> np.ndarray:
    row, column = np.divmod(s.pixel, video.camera.width)
    return video.points(s.frame, row, column)


def still(video: SimulatedVideo, s: FrameSamples) -> np.ndarray:
    ids = video.ids.reshape(len(video.ids), -1)[s.frame, s.pixel]
    return ~np.isin(ids, [m.id for m in video.movers])


def fit(video: SimulatedVideo, s: FrameSamples) -> tuple[Sim3, np.ndarray]:
    """S_world_chunk by the points that stand still, letting go of the worst; what is off then, metres."""
    truth, use = true_points(video, s), still(video, s)
    for _ in range(3):
        S = umeyama(s.points[use], truth[use], with_scale=True)
        off = np.linalg.norm(S.apply(s.points) - truth, axis=1)
        use = still(video, s) & (off <= 3 * np.median(off) + 1e-9)
    return S, off


def side_error(video: SimulatedVideo, u: FrameSamples, v: FrameSamples) -> float:
    """How far the second side lies from where the first says it should, metres."""
    S_u, S_v = fit(video, u)[0], fit(video, v)[0]
    middle = true_points(video, v).mean(axis=0, keepdims=True)
    return float(np.linalg.norm(S_u.apply(S_v.inverse().apply(middle)) - middle))


@pytest.mark.slow
def test_same_seed_same_chunk_and_another_seed_another(video: SimulatedVideo) -> None:
    one, two, other = (FeedForwardModel(video, seed=n).chunk(SPAN) for n in (5, 5, 6))
    for f in fields(FrameSamples):
        assert np.array_equal(getattr(one.samples, f.name), getattr(two.samples, f.name))
    assert len(one.library.instances) == len(two.library.instances)
    for a, b in zip(one.library.instances, two.library.instances, strict=True):
        assert np.array_equal(a.feature, b.feature) and np.array_equal(a.support.points, b.support.points)
    assert not np.allclose(one.T_chunk_cam, other.T_chunk_cam)


def test_chunks_do_not_depend_on_each_other(video: SimulatedVideo) -> None:
    model = FeedForwardModel(video, seed=5)
    model.chunk(ChunkSpan(0, 0, 100))
    model(0, range(20), 0, range(300, 320))
    assert np.array_equal(model.chunk(SPAN).T_chunk_cam, FeedForwardModel(video, seed=5).chunk(SPAN).T_chunk_cam)


def test_exact_settings_give_the_truth_up_to_a_similarity(video: SimulatedVideo) -> None:
    chunk = FeedForwardModel(video, FeedForwardSettings.exact(), seed=1).chunk(SPAN)
    S, off = fit(video, chunk.samples)
    assert off.max() < 5e-4  # samples are rounded
    assert np.linalg.norm(S.apply(chunk.T_chunk_cam[:, :3, 3]) - video.T_world_cam[140:240, :3, 3], axis=1).max() < 1e-4
    assert abs(float(S.scale) - 1) > 1e-3
    assert np.all(chunk.samples.confidence == 1)
    assert len({float(fit(video, FeedForwardModel(video, seed=n).chunk(SPAN).samples)[0].scale) for n in range(3)}) == 3


@pytest.mark.slow
def test_two_cameras_in_one_window_see_the_same_room() -> None:
    """Where a second camera takes over, its points lie on what the first one saw, in truth and in a window of both."""
    video = make_return("seasons", 103)
    cut = video.cuts[0]
    assert video.later_camera is not None and video.later_camera.fx < 0.95 * video.camera.fx
    rows, columns = (a.ravel() for a in np.mgrid[4:48:8, 4:64:8])
    shared = covisibility(video, np.arange(0, cut, 5), np.arange(cut, len(video.time_s), 5))
    first, second = (np.flatnonzero(shared.max(axis=1 - n) > 0.5) * 5 + n * cut for n in (0, 1))

    def seen(frames: np.ndarray) -> np.ndarray:
        return video.points(np.repeat(frames, len(rows)), np.tile(rows, len(frames)), np.tile(columns, len(frames)))

    gap = cKDTree(seen(first)).query(seen(second))[0]
    assert np.median(gap) < 0.1
    u, v = (int(k) * 5 + n * cut for n, k in enumerate(np.unravel_index(np.argmax(shared), shared.shape)))
    near_u, near_v = (
        [f for f in range(u - 8, u + 9, 4) if 0 <= f < cut],
        [f for f in range(v - 8, v + 9, 4) if f >= cut],
    )
    window = FeedForwardModel(video, FeedForwardSettings.exact(), seed=1)(0, near_u, 0, near_v)
    assert window is not None
    both = [np.concatenate([getattr(window.u, name), getattr(window.v, name)]) for name in ("points", "frame", "pixel")]
    row, column = np.divmod(both[2], video.camera.width)
    truth = video.points(both[1], row, column)
    S = umeyama(both[0], truth, with_scale=True)
    assert np.linalg.norm(S.apply(both[0]) - truth, axis=1).max() < 1e-3


def test_exact_tracks_are_the_things_themselves(video: SimulatedVideo) -> None:
    library = FeedForwardModel(video, FeedForwardSettings.exact(), seed=1).chunk(SPAN).library
    for instance in library.instances:
        track = instance.track
        masks = np.stack([decode_mask(m, track.image_size) for m in track.masks])
        ids = np.unique(video.ids[track.frames][masks])
        assert len(ids) == 1
        assert np.array_equal(masks, video.ids[track.frames] == ids[0])
        assert instance.structure == (ids[0] in [t.id for t in video.world.objects if t.structure is not None])


def test_errors_are_those_of_the_models_it_stands_for(video: SimulatedVideo) -> None:
    """A few centimetres within a chunk; two chunks err differently on the frames they share."""
    model = FeedForwardModel(video, seed=2)
    u, v = model.chunk(SPAN), model.chunk(ChunkSpan(3, 210, 310))
    for chunk in (u, v):
        S, _ = fit(video, chunk.samples)
        true = video.T_world_cam[chunk.frame_indices, :3, 3]
        ate = np.sqrt(np.mean(np.sum((S.apply(chunk.T_chunk_cam[:, :3, 3]) - true) ** 2, axis=1)))
        assert 0.003 < ate < 0.12
    places = [
        fit(video, c.samples)[0].apply(c.T_chunk_cam[np.isin(c.frame_indices, np.arange(210, 240)), :3, 3])
        for c in (u, v)
    ]
    assert np.linalg.norm(places[0] - places[1], axis=1).mean() > 0.002


def test_confidence_goes_with_the_error_and_sometimes_lies(video: SimulatedVideo) -> None:
    s = FeedForwardModel(video, seed=2).chunk(SPAN).samples
    assert s.confidence.min() >= 0 and s.confidence.max() <= 1
    _, off = fit(video, s)
    use = still(video, s)
    depth = np.linalg.norm(true_points(video, s) - video.T_world_cam[s.frame, :3, 3], axis=1)
    assert spearmanr(off[use] / depth[use], -s.confidence[use]).statistic > 0.15
    sure = s.confidence > np.quantile(s.confidence, 0.7)
    worst = off / depth > np.quantile(off[use] / depth[use], 0.8)
    doubted = s.confidence < 0.1 * np.median(s.confidence)
    right = off / depth < np.quantile(off[use] / depth[use], 0.4)
    assert (sure & worst & use).mean() > 0.005
    assert (doubted & right & use).mean() > 0.005


def test_every_chunk_places_a_mover_in_its_own_way(video: SimulatedVideo) -> None:
    """Far beyond what the chunks disagree on about the rest."""
    model = FeedForwardModel(video, seed=2)
    ratios = []
    for start in (0, 200, 400, 600):
        s = model.chunk(ChunkSpan(0, start, start + 60)).samples
        _, off = fit(video, s)
        use = still(video, s)
        if (~use).any():
            ratios.append(np.median(off[~use]) / np.median(off[use]))
    assert len(ratios) >= 2 and np.median(ratios) > 2 and max(ratios) > 4


def test_more_covisibility_ties_better() -> None:
    """Two sides of one window: their relation is the worse the less they share, and within a side it stays good."""
    count = 16
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = np.linspace(0, 0.5, count)
    off = []
    for shared in (0.6, 0.1):
        covisibility = np.full((count, count), 0.95)
        covisibility[: count // 2, count // 2 :] = covisibility[count // 2 :, : count // 2] = shared
        draws = [bend(T, np.full(count, 2.0), covisibility, PoseErrorSettings(), [n]) for n in range(60)]
        turns = np.array([rotation_log(E.rotation[0].T @ E.rotation[-1]) for E in draws])
        inside = np.array([rotation_log(E.rotation[0].T @ E.rotation[3]) for E in draws])
        off.append((np.sqrt(np.mean(turns**2)), np.sqrt(np.mean(inside**2))))
    assert off[1][0] > 1.8 * off[0][0]
    assert off[1][0] > 3 * off[1][1]


def test_frame_rate_does_not_change_the_errors() -> None:
    """A chain of views that bends is bent as much when it is filmed with twice the frames."""
    spread = []
    for count in (30, 60):
        place = np.linspace(0, 6, count)
        T = np.tile(np.eye(4), (count, 1, 1))
        T[:, 0, 3] = place
        covisibility = np.clip(1 - np.abs(place[:, None] - place) / 1.5, 0, 1)
        draws = [bend(T, np.full(count, 2.0), covisibility, PoseErrorSettings(), [n]) for n in range(80)]
        spread.append(np.std([np.log(E.scale[-1] / E.scale[0]) for E in draws]))
    assert 0.7 < spread[1] / spread[0] < 1.4


@pytest.mark.slow
def test_a_window_of_one_place_is_right_and_of_two_made_up(twins: SimulatedVideo) -> None:
    model = FeedForwardModel(twins, seed=3)
    frames = np.arange(10, len(twins.time_s) - 10, 10)
    shared = model.covisibility(frames)
    apart = np.abs(frames[:, None] - frames) > 150
    a, b = np.unravel_index(np.argmax(np.where(apart, shared, -1)), shared.shape)
    window = model(0, range(frames[a] - 10, frames[a] + 10), 0, range(frames[b] - 10, frames[b] + 10))
    assert window is not None and side_error(twins, window.u, window.v) < 0.15
    alike = model.descriptors[frames] @ model.descriptors[frames].T
    a, b = np.unravel_index(np.argmax(np.where(apart & (shared < 0.01), alike, -1)), shared.shape)
    assert alike[a, b] > 0.8
    window = model(0, range(frames[a] - 10, frames[a] + 10), 0, range(frames[b] - 10, frames[b] + 10))
    assert window is not None and side_error(twins, window.u, window.v) > 1.0
    for side in (window.u, window.v):
        assert np.median(fit(twins, side)[1]) < 0.2
        assert np.all(side.instance == -1) and len(side.camera_frames) == 20
    middle = [side.T_chunk_cam[10, :3, 3] for side in (window.u, window.v)]
    size = np.linalg.norm(np.ptp(window.u.points, axis=0))
    assert np.linalg.norm(middle[0] - middle[1]) < size


@pytest.mark.slow
def test_over_a_cut_each_side_is_right_and_their_relation_is_not() -> None:
    video = make_video("kidnap", 131)
    assert video.cuts
    model = FeedForwardModel(video, seed=1)
    errors = []
    for cut in video.cuts:
        frames = np.arange(cut - 50, cut + 50)
        shared = model.covisibility(frames)[:50, 50:].max()
        s = model.chunk(ChunkSpan(0, cut - 50, cut + 50)).samples
        one, two = s.frame < cut, s.frame >= cut
        parts = [replace(s, **{n: getattr(s, n)[k] for n in _SAMPLE_FIELDS}) for k in (one, two)]
        errors.append((shared, side_error(video, *parts)))
        assert all(np.median(fit(video, part)[1]) < 0.25 for part in parts)
    assert all(error > 0.5 if shared < 0.05 else error < 1.0 for shared, error in errors)


_SAMPLE_FIELDS = ("frame", "pixel", "points", "confidence", "instance")


def test_descriptors_know_a_place_again_and_confuse_twins(twins: SimulatedVideo) -> None:
    model = FeedForwardModel(twins, seed=3)
    d = model.descriptors
    assert np.allclose(np.linalg.norm(d, axis=1), 1, atol=1e-5)
    assert np.quantile(np.sum(d[1:] * d[:-1], axis=1), 0.05) > 0.9
    frames = np.arange(0, len(d), 8)
    cosine, shared = d[frames] @ d[frames].T, model.covisibility(frames)
    apart = np.abs(frames[:, None] - frames) > 120
    assert np.median(cosine[apart & (shared > 0.6)]) > 0.75
    assert 0.4 < np.median(cosine[apart & (shared > 0.1) & (shared < 0.3)]) < 0.8
    assert np.median(cosine[apart & (shared < 0.01)]) < 0.5
    assert cosine[apart & (shared < 0.01)].max() > 0.85


def test_twins_have_like_features(twins: SimulatedVideo) -> None:
    looks = Appearance(twins, 32, 0.6, 0.25)
    unit = looks.full[1:] / np.linalg.norm(looks.full[1:], axis=1, keepdims=True)
    cosine, kind = unit @ unit.T, looks.classes[1:]
    twin = (kind[:, None] == kind) & ~np.eye(len(kind), dtype=bool)
    assert twin.any() and cosine[twin].min() > 0.8
    assert np.quantile(cosine[kind[:, None] != kind], 0.99) < 0.75


def test_tracks_break_and_leak_and_things_side_by_side_stay_apart(video: SimulatedVideo) -> None:
    model = FeedForwardModel(video, seed=2)
    broken, mixed, known, structure = 0, 0, 0, 0
    kinds = {t.id for t in video.world.objects if t.structure is not None}
    for k in range(3):
        library = model.chunk(ChunkSpan(k, 200 * k, 200 * k + 100)).library
        owners = []
        for instance in library.instances:
            track = instance.track
            masks = np.stack([decode_mask(m, track.image_size) for m in track.masks])
            count = np.bincount(video.ids[track.frames][masks])
            owners.append(int(count.argmax()))
            mixed += (count > 0.02 * count.sum()).sum() > 1
            known += instance.structure
            structure += owners[-1] in kinds
            assert np.all(np.diff(track.frames) > 0) and np.all(track.areas_px == masks.sum(axis=(1, 2)))
            assert np.isfinite(instance.support.points).all() and len(instance.support.points) > 0
            assert (instance.plane is not None) == instance.structure
        broken += len(owners) - len(set(owners))
        for a, b in library.cannot_link:
            assert not np.array_equal(owners[a], owners[b]) or mixed
    assert broken > 0 and mixed > 0 and 0.5 * structure < known < 1.2 * structure


def test_samples_hold_the_instances_of_the_library(video: SimulatedVideo) -> None:
    chunk = FeedForwardModel(video, seed=2).chunk(SPAN)
    used = np.unique(chunk.samples.instance)
    assert set(used[used >= 0]) <= {i.local_id for i in chunk.library.instances}
    assert (chunk.samples.instance >= 0).mean() > 0.3
    assert all(len(k.keypoints_xy) == 0 and k.depth_small.size == 0 for k in chunk.keyframes)
    assert np.array_equal(chunk.keyframes[1].descriptor, FeedForwardModel(video, seed=2).descriptors[150])


def test_one_frame_and_frames_that_do_not_exist(video: SimulatedVideo) -> None:
    model = FeedForwardModel(video, seed=2)
    assert len(model.chunk(ChunkSpan(0, 7, 8)).samples.camera_frames) == 1
    assert model(0, [], 0, [1, 2]) is None
    assert model(0, [5], 0, [5]) is not None
    with pytest.raises(OptionError, match="not within"):
        model.chunk(ChunkSpan(0, len(video.time_s) - 5, len(video.time_s) + 5))


def test_runs_of_frames() -> None:
    assert runs_of([3, 4, 5, 50, 51, 2]) == [slice(0, 3), slice(3, 5), slice(5, 6)]
    assert runs_of([]) == []

"""Poses that are given but imperfect: a start and a weight, corrected by what is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.overlap.prior_edge import PriorEdgeSettings, prior_edge
from list3r.frames.base import Frame, SourceInfo
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.core.records import ChunkResult, ChunkRow, FrameRow, FrameSamples, LocalLibrary
from list3r.pipeline.session import check_buildable, resolve_settings
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.motion import residuals
from list3r.reconstruction.pose_prior import PriorSettings, bridged, mean_alignment, source_from_chunk, steady_runs
from list3r.reconstruction.rgbd.frame_registration import FrameRegistration, PosePrior, Samples, register
from list3r.reconstruction.rgbd.odometry import CameraTracker, TrackedSegment
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from list3r.reconstruction.rgbd.settings import OdometrySettings
from list3r.reconstruction.rgbd.surfels import SurfelModel
from list3r.reconstruction.rgbd.view import make_view
from tests.rgbd_scenes import CAMERA, black, frames_along, pose_errors, walk

JUMP = 9


def imperfect(truth: np.ndarray) -> np.ndarray:
    """The poses with lengths 2 % too long and a jump of 10 cm and 4 degrees."""
    out = truth.copy()
    out[:, :3, 3] = truth[0, :3, 3] + 1.02 * (truth[:, :3, 3] - truth[0, :3, 3])
    jump = np.eye(4)
    jump[:3, :3] = rotation_exp(np.array([0.0, 0.0, np.radians(4.0)]))
    jump[:3, 3] = 0.1, 0.0, 0.0
    out[JUMP:] = jump @ out[JUMP:]
    return out


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return walk(45)[:15]


@pytest.fixture(scope="module")
def frames(truth: np.ndarray) -> list[Frame]:
    return [replace(f, T_source_cam=T) for f, T in zip(frames_along(truth), imperfect(truth), strict=True)]


@pytest.fixture(scope="module")
def made(frames: list[Frame]) -> Reconstruction:
    return RgbdReconstructor(poses="prior")(frames, CAMERA)


def test_what_is_seen_corrects_drift_and_jump(frames: list[Frame], made: Reconstruction, truth: np.ndarray) -> None:
    given = RgbdReconstructor(poses="given")(frames, CAMERA)
    assert made.posed.all()
    assert pose_errors(made.T_chunk_cam, truth)[0].max() < 0.01
    assert pose_errors(given.T_chunk_cam, truth)[0].max() > 0.05


def test_the_chunk_lies_in_the_world_that_the_source_ends_in(frames: list[Frame], made: Reconstruction) -> None:
    given = np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None])
    apart = np.linalg.norm(made.T_chunk_cam[:, :3, 3] - given[:, :3, 3], axis=1)
    assert apart[JUMP:].max() < 0.02
    assert apart[:JUMP].max() > 0.05


def test_frames_that_show_nothing_follow_the_prior(truth: np.ndarray) -> None:
    near = frames_along(truth[:9])
    dark = [replace(black(f), depth=f.depth) if 4 <= k < 7 else f for k, f in enumerate(near)]
    empty = [replace(f, depth=np.where(f.depth > 0, 1.5, 0).astype(np.float32)) if 4 <= k < 7 else f
             for k, f in enumerate(dark) if f.depth is not None]  # fmt: skip
    made = RgbdReconstructor(poses="prior")(empty, CAMERA)
    assert made.posed.all() and made.unsure >= {4, 5, 6}
    assert pose_errors(made.T_chunk_cam, truth[:9])[0].max() < 0.05


def lightless(frame: Frame) -> Frame:
    assert frame.depth is not None
    return replace(black(frame), depth=np.zeros_like(frame.depth))


def test_frames_without_light_and_depth_follow_the_prior(frames: list[Frame], truth: np.ndarray) -> None:
    seen = [*frames[:3], *map(lightless, frames[3:7]), *frames[7:]]
    made = RgbdReconstructor(poses="prior")(seen, CAMERA)
    assert made.posed.all() and made.unsure == {3, 4, 5, 6}
    assert pose_errors(made.T_chunk_cam, truth)[0].max() < 0.01
    assert not set(made.keyframes.tolist()) & {3, 4, 5, 6}
    assert RgbdReconstructor(poses="estimate")(seen, CAMERA).posed.tolist() == [not 3 <= k < 7 for k in range(15)]


def test_a_jump_without_light_is_told_afterwards(frames: list[Frame], truth: np.ndarray) -> None:
    dark = range(JUMP - 3, JUMP + 3)
    seen = [lightless(f) if k in dark else f for k, f in enumerate(frames)]
    made = RgbdReconstructor(poses="prior")(seen, CAMERA)
    assert made.posed.tolist() == [k not in dark for k in range(15)]
    assert pose_errors(made.T_chunk_cam[made.posed], truth[made.posed])[0].max() < 0.015


def test_frames_without_light_at_which_poses_jump_have_none(truth: np.ndarray) -> None:
    given, posed, settings = imperfect(truth), np.ones(len(truth), bool), PriorSettings()
    posed[JUMP - 2 : JUMP + 2] = False
    assert (bridged(truth, posed, given, settings)[1] == posed).all()
    posed[:] = True
    posed[[0, 3, 4, 14]] = False
    T, known = bridged(np.where(posed[:, None, None], truth, np.eye(4)), posed, given, settings)
    assert known.all()
    assert np.abs(T - truth).max() < 0.01
    nothing = np.full_like(given, np.nan)
    assert (bridged(truth, posed, nothing, settings)[1] == posed).all()


def test_a_surface_that_seems_to_move_does_not_free_the_camera_from_its_prior(truth: np.ndarray) -> None:
    """A wall that fills the picture, and a box before it: without the box nothing but the prior holds the camera."""
    told: list[object] = []
    frame = frames_along(truth[:1])[0]

    def spy(*arguments: object) -> object:
        told.append(arguments[5] if len(arguments) > 5 else None)
        return register(*arguments)  # type: ignore[arg-type]

    assert frame.depth is not None
    settings = OdometrySettings()
    view = make_view(frame.color, frame.depth, CAMERA.shrunk(160), settings.noise)
    model = Samples(view.points[view.valid], view.normals[view.valid], view.gray[view.valid])
    prior = PosePrior(np.eye(4), 0.002, 0.002, 30.0)
    found = register(model, view, np.eye(4), settings.registration, settings.noise, prior)
    assert found is not None
    half = np.zeros_like(view.valid)
    half[:, : half.shape[1] // 2] = True
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(residuals, "register", spy)
        patch.setattr(residuals, "suspects", lambda *_: [half])
        residuals.mover_in_residuals(model, view, np.eye(4), found, settings, prior)
    assert told
    assert all(one is prior for one in told)


def test_runs_end_where_poses_jump(truth: np.ndarray) -> None:
    runs = steady_runs(truth, imperfect(truth), PriorSettings())
    assert [run.tolist() for run in runs] == [list(range(JUMP)), list(range(JUMP, len(truth)))]
    missing = imperfect(truth)
    missing[3] = np.nan
    assert 3 not in np.concatenate(steady_runs(truth, missing, PriorSettings()))
    assert source_from_chunk(truth, np.zeros(len(truth), bool), missing, PriorSettings()) is None


def chunk(T_chunk_cam: np.ndarray, T_source_cam: np.ndarray | None) -> ChunkResult:
    count = len(T_chunk_cam)
    return ChunkResult(
        index=1,
        frame_indices=np.arange(count),
        times_s=np.arange(count) / 10.0,
        posed=np.ones(count, bool),
        T_chunk_cam=T_chunk_cam,
        T_source_cam=T_source_cam,
        intrinsics=(1.0, 1.0, 0.0, 0.0),
        image_size=(2, 2),
        scale_kind="metric",
        keyframes=(),
        samples=FrameSamples.empty(),
        library=LocalLibrary((), np.zeros((0, 2), np.int32), "geometric-color@1/64"),
    )


def test_the_edge_of_a_prior_says_where_the_chunk_lies_and_how_far_it_may_have_drifted(truth: np.ndarray) -> None:
    moved = np.eye(4)
    moved[:3, 3] = 1.0, 2.0, 3.0
    u = ChunkRow(1, 1, 0, 0, 9, 1, Sim3.identity(), (1.0, 1.0, 0.0, 0.0), (2, 2), "metric")
    before = [FrameRow(1, k, 0.1 * k, 1, "posed", T) for k, T in enumerate(truth)]
    edge = prior_edge(u, before, chunk(np.linalg.inv(moved) @ truth, truth), 2, PriorEdgeSettings())
    assert edge is not None and edge.kind == "prior" and edge.covariance is not None
    assert np.allclose(edge.S_v_u.translation, -moved[:3, 3]) and np.allclose(edge.S_v_u.rotation, np.eye(3))
    jumped = imperfect(truth)  # the chunk before ends after the jump, and lies in the world behind it
    behind = prior_edge(replace(u, last_frame=JUMP + 3), before, chunk(truth, jumped), 2, PriorEdgeSettings())
    assert behind is not None
    T_source_v = mean_alignment(truth[JUMP:], jumped[JUMP:])
    assert np.allclose(behind.S_v_u.translation, np.linalg.inv(T_source_v)[:3, 3], atol=1e-9)
    far = truth.copy()
    far[:, :3, 3] *= 10.0
    loose = prior_edge(u, before, chunk(far, far), 2, PriorEdgeSettings())
    assert loose is not None and loose.covariance is not None
    assert np.trace(loose.covariance[:3, :3]) > np.trace(edge.covariance[:3, :3])
    assert prior_edge(u, before, chunk(truth, None), 2, PriorEdgeSettings()) is None


def info(**changes: object) -> SourceInfo:
    known = {"kind": "record3d", "path": "walk.r3d", "frame_count": 9, "fps": 30.0, "camera": CAMERA, "z_up": True}
    known |= {"has_depth": True, "has_poses": True, "fingerprint": ""}
    return SourceInfo(**(known | changes))  # type: ignore[arg-type]


def test_the_source_says_which_way_is_up_where_its_poses_are_used() -> None:
    used = {poses: resolve_settings(BuildSettings(poses=poses), info()).up for poses in ("given", "prior", "estimate")}
    assert used == {"given": "source", "prior": "source", "estimate": "planes"}
    assert resolve_settings(BuildSettings(poses="prior"), info(z_up=False)).up == "planes"


def test_poses_that_drift_are_a_prior_unless_asked_otherwise() -> None:
    chosen = {
        (drift, depth): resolve_settings(BuildSettings(poses="auto"), info(poses_drift=drift, has_depth=depth)).poses
        for drift in (True, False)
        for depth in (True, False)
    }
    assert chosen == {(True, True): "prior", (True, False): "given", (False, True): "given", (False, False): "given"}


@pytest.mark.parametrize(
    ("changes", "why"),
    [({"has_poses": False}, "no poses"), ({"poses_metric": False}, "another unit")],
)
def test_a_prior_that_cannot_serve_is_refused(changes: dict[str, object], why: str) -> None:
    with pytest.raises(OptionError, match=why):
        check_buildable(info(**changes), BuildSettings(reconstruction="rgbd", poses="prior"))
    with pytest.raises(OptionError, match="needs --reconstruction rgbd, not sfm"):
        check_buildable(info(), BuildSettings(reconstruction="sfm", poses="prior"))


def test_poses_of_colour_alone_are_no_prior() -> None:
    with pytest.raises(OptionError, match=r"sensor depth.*has none; use --poses given"):
        check_buildable(info(has_depth=False), BuildSettings(reconstruction="sfm", poses="prior"))


def placed(shift_m: float, inliers: float, correlation: float) -> FrameRegistration:
    """A frame found so far from its stated step, and how well it fits there."""
    T = np.eye(4)
    T[0, 3] = shift_m
    return FrameRegistration(T, 0.9, inliers, 1.0, correlation, 5000, 1e8 * np.eye(6), 1e8 * np.eye(6))


@pytest.mark.parametrize(
    ("found", "believed"),
    [
        (placed(0.01, 0.7, 0.5), True),
        (placed(0.12, 0.93, 0.98), True),  # a true jump, at the end of a quick turn
        (placed(0.34, 0.95, 0.63), False),  # a blurred picture of a bare floor
        (placed(0.10, 0.83, 0.94), False),  # another
        (placed(0.12, 0.95, float("nan")), False),
    ],
)
def test_a_jump_is_believed_where_the_frame_fits_as_those_before(
    found: FrameRegistration, believed: bool, frames: list[Frame]
) -> None:
    tracker = CameraTracker(frames, CAMERA, OdometrySettings(), prior=True)
    segment = TrackedSegment(SurfelModel(OdometrySettings().fusion, OdometrySettings().noise), usual_inliers=0.96)
    assert tracker._believed(segment, PosePrior(np.eye(4), 0.002, 0.002, 30.0), found) is believed


def test_a_frame_that_contradicts_its_step_in_vain_stays_out_of_the_model(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CameraTracker, "_believed", lambda *_: False)
    tracker = CameraTracker(frames[:4], CAMERA, OdometrySettings(), prior=True)
    (segment,) = tracker.run()
    assert sorted(segment.T_segment_cam) == [0, 1, 2, 3] and segment.keyframes == [0]
    steps = [np.linalg.inv(frames[0].T_source_cam) @ f.T_source_cam for f in frames[:4]]  # type: ignore[arg-type]
    assert all(np.allclose(segment.T_segment_cam[k], steps[k], atol=1e-9) for k in range(4))

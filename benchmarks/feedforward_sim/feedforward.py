"""A simulated feed-forward reconstruction model, in place of pi^3 and a video segmenter where no weights are. It
distorts a simulated video as such models do: every chunk in a gauge of its own (any similarity), bent, drifting in
scale, noisy, with a mostly correct confidence; moving objects placed differently by every chunk; tracks and features as
in `simulated_instances`. Its errors are a function of the frames it is given together, so two overlapping chunks err
differently on the frames they share. It never rejects unrelated frames: over a jump cut, and in a joint window of two
places, it invents a relation.

Source of the defaults: pi^3 in chunks of 100 frames, chained, has errors of 0.04 to 0.15 m on the rooms of 7-Scenes and
by 0.05 to 0.16 m on TUM fr1 (ATE after Sim(3)); its points are 0.05 m from the truth (Chamfer, NRGBD), 2 % of the depth
of a room. Measured here on seeds 101 to 103 by `benchmarks/feedforward.py`: 0.03 to 0.04 m within a chunk of `calm`,
depth off by 3 %, scale drift of 0.5 to 1 % from end to end of a chunk, neighbours aligned to 0.03 to 0.05 m and 0.6 %,
the chain of a calm walk 0.09 m off, one round through several rooms 0.12 to 0.23 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.feedforward_sim.depth_errors import DepthErrorSettings, focal_factor, wrong_depth
from benchmarks.feedforward_sim.descriptors import FrameDescriptorSettings, frame_descriptors
from benchmarks.feedforward_sim.instances import (
    ChunkGeometry,
    InstanceErrorSettings,
    simulate_library,
    unseen_home_errors,
)
from benchmarks.feedforward_sim.mover_errors import MoverErrorSettings, mover_errors
from benchmarks.feedforward_sim.pose_errors import PoseErrorSettings, bend, jitter, placements, sides
from benchmarks.simulation.covisibility import seen_share
from benchmarks.simulation.video import SimulatedVideo
from list3r.frames.base import Camera
from list3r.frames.chunking.chunks import ChunkSpan
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, FrameSamples, JointWindow, Keyframe, LocalLibrary
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.keyframe_record import frame_samples

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FeedForwardSettings:
    """All that the simulated model gets wrong."""

    gauge_scale: float = 0.3
    """Deviation of the logarithm of a chunk's scale."""
    gauge_shift_m: float = 2.0
    """Deviation of where its origin is."""
    keyframe_step: int = 10
    """Frames from one keyframe to the next."""
    poses: PoseErrorSettings = field(default_factory=PoseErrorSettings)
    depth: DepthErrorSettings = field(default_factory=DepthErrorSettings)
    movers: MoverErrorSettings = field(default_factory=MoverErrorSettings)
    instances: InstanceErrorSettings = field(default_factory=InstanceErrorSettings)
    descriptors: FrameDescriptorSettings = field(default_factory=FrameDescriptorSettings)

    @staticmethod
    def unseen_home(bare: bool = False) -> FeedForwardSettings:
        """Masks as of discovery in unseen homes, appearance that changes with side and light; `bare` halls are mostly
        the part shared by all pictures."""
        descriptors = FrameDescriptorSettings(light_part=0.85, common=0.8 if bare else 0.4)
        return FeedForwardSettings(instances=unseen_home_errors(), descriptors=descriptors)

    @staticmethod
    def exact() -> FeedForwardSettings:
        """True geometry in a random gauge, whole tracks, full confidence."""
        return FeedForwardSettings(
            poses=PoseErrorSettings(bending=0, jitter_deg=0, jitter_shift=0, glitch_rate=0),
            depth=DepthErrorSettings(
                noise=0, noise_per_m=0, bland=0, flying_share=0, focal=0, knowing=1, doubted_share=0
            ),
            movers=MoverErrorSettings(lag_s=0, frozen_share=0, depth=0, least_confidence=1, pull=0),
            instances=InstanceErrorSettings(
                small_px=1e-3, break_rate=0, gap_frames=10**6, merge_share=0, leak_rate=0, late_frames=0,
                structure_seen=1, structure_known=1, structure_false=0,
            ),
        )  # fmt: skip


@dataclass(frozen=True)
class _Reconstructed:
    """Frames reconstructed together."""

    reconstruction: Reconstruction
    shift: Floats | None
    """Offsets to points by depth, chunk units: moving objects, and frames of another camera. Shape (F, H, W, 3)."""


class FeedForwardModel:
    """The simulated model on one video; a `JointReconstructor` too (one video is one session)."""

    def __init__(self, video: SimulatedVideo, settings: FeedForwardSettings | None = None, seed: int = 0) -> None:
        self._video = video
        self._settings = settings or FeedForwardSettings()
        self._seed = seed
        self.descriptors: Floats = frame_descriptors(video, self._settings.descriptors, seed)
        """Unit-length descriptors of all frames. Shape (F, D)."""

    def chunk(self, span: ChunkSpan) -> ChunkResult:
        """Output of the model and the tracker for one chunk."""
        frames = self._checked(range(span.start, span.stop))
        seed = [self._seed, self._video.seed, 1, span.start, span.stop]
        made = self._reconstruct(frames, seed)
        geometry = _geometry(made)
        library = simulate_library(self._video, geometry, self._settings.instances, seed)
        camera = made.reconstruction.camera
        return ChunkResult(
            index=span.index,
            frame_indices=frames,
            times_s=self._video.time_s[frames].astype(np.float64),
            posed=np.ones(len(frames), bool),
            T_chunk_cam=made.reconstruction.T_chunk_cam,
            T_source_cam=None,
            intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
            image_size=(camera.height, camera.width),
            scale_kind="relative",
            keyframes=self._keyframes(made.reconstruction),
            samples=_samples(made, library),
            library=library,
        )

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        """The window of frames of two places; never None: the model invents unknown relations."""
        u, v = (self._checked(sorted(set(int(f) for f in side))) for side in (u_frames, v_frames))
        if not len(u) or not len(v):
            return None
        frames = np.concatenate([u, v])
        seed = [self._seed, self._video.seed, 2, len(u), *frames.tolist()]
        made = self._reconstruct(frames, seed)
        one, two = _part(made, slice(0, len(u))), _part(made, slice(len(u), None))
        return JointWindow(_samples(one, None), _samples(two, None), "relative")

    def covisibility(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """True covisibility of the static world between frames, the lesser of both ways. Shape (F, F)."""
        share = seen_share(self._video, frames, frames).astype(np.float64)
        return np.minimum(share, share.T)

    def _checked(self, frames: Sequence[int] | range) -> NDArray[np.int64]:
        numbers = np.asarray(list(frames), np.int64)
        count = len(self._video.T_world_cam)
        if len(numbers) and (numbers.min() < 0 or numbers.max() >= count):
            raise OptionError(f"frames {numbers.min()} to {numbers.max()} are not within the video's 0 to {count - 1}")
        return numbers

    def _reconstruct(self, frames: NDArray[np.int64], seed: list[int]) -> _Reconstructed:
        """Frames together in one gauge."""
        video, chosen = self._video, self._settings
        factor, confidence = wrong_depth(video, frames, chosen.depth, seed)
        moving = mover_errors(video, frames, chosen.movers, seed)
        S_chunk_world = self._gauge(frames, seed) @ self._errors(frames, seed)
        T_world_cam = video.T_world_cam[frames].copy()
        T_world_cam[:, :3, 3] += moving.pull_m
        own = jitter(self._middle_depth(frames), frames, chosen.poses, seed)
        S_chunk_cam = S_chunk_world @ Sim3.from_matrix(T_world_cam) @ own
        scale = S_chunk_cam.scale.astype(np.float32)[:, None, None]
        depth = scale * video.depth[frames] * factor * moving.depth_factor
        (_, camera), *others = video.cameras(frames)
        focal = focal_factor(chosen.depth, seed)
        reconstruction = Reconstruction(
            frame_indices=frames,
            posed=np.ones(len(frames), bool),
            T_chunk_cam=_rigid(S_chunk_cam),
            camera=replace(camera, fx=camera.fx * focal, fy=camera.fy * focal),
            depth=depth.astype(np.float32),
            confidence=(confidence * moving.confidence_factor).astype(np.float16),
            scale_kind="relative",
            keyframes=np.arange(0, len(frames), chosen.keyframe_step, dtype=np.int64),
        )
        shift = None
        if moving.shift_m is not None:
            turn = (np.asarray(S_chunk_world.scale)[:, None, None] * S_chunk_world.rotation).astype(np.float32)
            shift = np.einsum("fij,fhwj->fhwi", turn, moving.shift_m)
        for where, other in others:
            shift = np.zeros((*depth.shape, 3), np.float32) if shift is None else shift
            shift[where] += _by_other_camera(
                reconstruction, where, replace(other, fx=other.fx * focal, fy=other.fy * focal)
            )
        return _Reconstructed(reconstruction, shift)

    def _errors(self, frames: NDArray[np.int64], seed: list[int]) -> Sim3:
        """The placement of the part of the world that each frame sees. Batched (F,)."""
        poses = self._settings.poses
        shared = self.covisibility(frames)
        side = sides(shared, poses)
        placed = placements(self._video, frames, side, self.descriptors[frames], poses, seed)
        return placed @ bend(self._video.T_world_cam[frames], self._middle_depth(frames), shared, poses, seed)

    def _gauge(self, frames: NDArray[np.int64], seed: list[int]) -> Sim3:
        """S_chunk_world of the run: any turn, shift and scale."""
        rng = np.random.default_rng([*seed, 61])
        scale = np.exp(self._settings.gauge_scale * rng.standard_normal())
        turn = Rotation.random(random_state=rng).as_matrix()
        shift = self._settings.gauge_shift_m * rng.standard_normal(3)
        middle = self._video.T_world_cam[frames][:, :3, 3].mean(axis=0)
        return Sim3(np.asarray(scale), turn, shift - scale * turn @ middle)

    def _middle_depth(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Median depth of each frame, metres, 1 where nothing is seen. Shape (F,)."""
        depth = self._video.depth[frames].reshape(len(frames), -1)
        known = np.where(depth > 0, depth, np.nan)
        known[:, 0] = np.where((depth > 0).any(axis=1), known[:, 0], 1.0)
        return np.nanmedian(known, axis=1).astype(np.float64)

    def _keyframes(self, made: Reconstruction) -> tuple[Keyframe, ...]:
        """Keyframes without local features: revisits of them need a joint window."""
        camera = made.camera
        return tuple(
            Keyframe(
                frame_index=int(made.frame_indices[k]),
                T_chunk_cam=made.T_chunk_cam[k],
                descriptor=self.descriptors[made.frame_indices[k]],
                keypoints_xy=np.zeros((0, 2), np.float32),
                keypoint_descriptors=np.zeros((0, 32), np.uint8),
                points_cam=np.zeros((0, 3), np.float32),
                depth_small=np.zeros((0, 0), np.float32),
                camera_small=(camera.fx, camera.fy, camera.cx, camera.cy),
            )
            for k in made.keyframes
        )


def _rigid(transform: Sim3) -> NDArray[np.float64]:
    """Poses of cameras from similarities; the scale goes into depth. Shape (F, 4, 4)."""
    return Sim3(np.ones_like(transform.scale), transform.rotation, transform.translation).as_matrix()


def _by_other_camera(made: Reconstruction, where: NDArray[np.int64], camera: Camera) -> Floats:
    """Offsets to the points of frames from another camera than the first. Shape (N, H, W, 3)."""
    height, width = made.depth.shape[1:]
    row, column = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    one, two = (
        np.stack([(column - c.cx) / c.fx, (row - c.cy) / c.fy, np.ones(row.shape)], -1) for c in (made.camera, camera)
    )
    local = made.depth[where][..., None] * (two - one).astype(np.float32)
    return np.asarray(np.einsum("fij,fhwj->fhwi", made.T_chunk_cam[where, :3, :3].astype(np.float32), local))


def _part(made: _Reconstructed, which: slice) -> _Reconstructed:
    """Some of the frames."""
    whole = made.reconstruction
    part = replace(
        whole,
        frame_indices=whole.frame_indices[which],
        posed=whole.posed[which],
        T_chunk_cam=whole.T_chunk_cam[which],
        depth=whole.depth[which],
        confidence=whole.confidence[which],
    )
    return _Reconstructed(part, None if made.shift is None else made.shift[which])


def _samples(made: _Reconstructed, library: LocalLibrary | None) -> FrameSamples:
    samples = frame_samples(made.reconstruction, library)
    if made.shift is None:
        return samples
    position = np.searchsorted(made.reconstruction.frame_indices, samples.frame)
    shift = made.shift.reshape(len(made.shift), -1, 3)[position, samples.pixel]
    return replace(samples, points=samples.points + shift)


def _geometry(made: _Reconstructed) -> ChunkGeometry:
    """All points of a run."""
    r = made.reconstruction
    height, width = r.depth.shape[1:]
    row, column = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    rays = np.stack([(column - r.camera.cx) / r.camera.fx, (row - r.camera.cy) / r.camera.fy, np.ones(row.shape)], -1)
    turn, place = r.T_chunk_cam[:, :3, :3].astype(np.float32), r.T_chunk_cam[:, :3, 3].astype(np.float32)
    points = np.einsum("fij,fhwj->fhwi", turn, r.depth[..., None] * rays.astype(np.float32)) + place[:, None, None]
    points = points if made.shift is None else points + made.shift
    return ChunkGeometry(r.frame_indices, r.T_chunk_cam, points.astype(np.float32), r.confidence.astype(np.float32))

"""Track the camera through a chunk: every frame is registered to the model of the frames before it.

A frame is accepted only when enough of the model is seen, agrees in depth and brightness, the pairs constrain all six
degrees of freedom, and the motion is possible. A frame that fails, that has no known motion before it, or that agrees
much less than its forerunners is searched by local features and by starts around the last pose; where that fails too a
new segment begins. Segments are joined afterwards by verified geometry only (research/depth-odometry 0062). Movers are
left out (research/depth-odometry 0063).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame, LazyFrame
from list3r.reconstruction.features.local import Features, detect
from list3r.reconstruction.motion.residuals import Mask, MoverMemory, fit, mover_in_residuals, without
from list3r.reconstruction.pose_prior import given_step
from list3r.reconstruction.poses import angle_deg, shows_more
from list3r.reconstruction.rgbd.frame_registration import (
    FrameRegistration,
    PosePrior,
    Samples,
    image_motion_px,
    register,
)
from list3r.reconstruction.rgbd.settings import OdometrySettings
from list3r.reconstruction.rgbd.surfels import SurfelModel
from list3r.reconstruction.rgbd.verified_features import VerifiedFeatures
from list3r.reconstruction.rgbd.view import Floats, WorkingFrame, cosines, make_view

Pose = NDArray[np.float64]


@dataclass(eq=False)
class TrackedSegment:
    """Consecutive frames that were tracked without a break, in the coordinates of the first."""

    model: SurfelModel
    T_segment_cam: dict[int, Pose] = field(default_factory=dict)
    """By position in the chunk."""
    keyframes: list[int] = field(default_factory=list)
    """Positions."""
    usual_inliers: float = 0.0
    """Share of inliers of the last frames."""
    usual_agreement: float = 0.0
    """That share times the brightness agreement, see `_alike`."""


def _alike(found: FrameRegistration) -> float:
    """Return the agreement of brightness, 0 to 1; 1 without texture."""
    return 1.0 if np.isnan(found.correlation) else max(found.correlation, 0.0)


def _explained(found: FrameRegistration) -> float:
    """Return the share of the model that a registration explains, in depth and brightness."""
    return found.overlap * found.inliers * _alike(found)


class _SkippedFramesNeededError(Exception):
    """A frame is not found from the last tracked one: the skipped frames between are needed."""


class CameraTracker:
    """Tracks one chunk. `segments` holds the outcome, in order of time."""

    def __init__(
        self,
        frames: Sequence[Frame],
        camera: Camera,
        settings: OdometrySettings,
        known: Mapping[int, Mask] | None = None,
        *,
        prior: bool = False,
        between: Collection[int] = (),
    ) -> None:
        """`known` are masks of any size, by position, of known movers, which are left out.

        With `prior` the frames' own poses predict the camera's motion. Frames at the positions `between` are skipped
        where the next other frame is found without them.
        """
        self.frames, self.camera, self.settings = frames, camera, settings
        self.small = camera.shrunk(settings.working_width)
        self.segments: list[TrackedSegment] = []
        self.passed: list[list[int]] = []
        """Positions of frames that were skipped, in runs between two that were not."""
        self.cosines: dict[int, Floats] = {}
        """Cosine of the viewing angle of each frame with depth, by position. Shape (h, w) each."""
        self.unproven: set[int] = set()
        """Positions of frames whose pose rests on a given step alone, or on depth or brightness alone."""
        self._prior, self._between = prior, frozenset(between)
        self._waiting: list[int] = []
        self._features: dict[int, Features] = {}
        self._views: dict[int, WorkingFrame] = {}
        self._mover_masks: dict[int, Mask] = {}
        self._unsure: set[int] = set()
        self._mover_memory = MoverMemory(settings.movers, settings.noise)
        size = (self.small.width, self.small.height)
        self._known = {
            k: cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            for k, mask in (known or {}).items()
        }

    def run(self) -> list[TrackedSegment]:
        """Track all frames, then join the segments that can be joined; the largest comes first."""
        for position in range(len(self.frames)):
            if position in self._between and self.segments:
                self._waiting.append(position)
                continue
            try:
                self._step(position)
            except _SkippedFramesNeededError:
                self._step_all([*self._take_waiting(), position])
            if self._waiting:
                self.passed.append(self._take_waiting())
        self._step_all(self._take_waiting())
        return self._join()

    def _take_waiting(self) -> list[int]:
        waiting, self._waiting = self._waiting, []
        return waiting

    def _step_all(self, positions: Sequence[int]) -> None:
        for position in positions:
            self._step(position)
            frame = self.frames[position]
            if isinstance(frame, LazyFrame):
                frame.let_go()

    def view(self, position: int) -> WorkingFrame:
        """Return the frame at working resolution, without its movers."""
        view = self._whole_view(position)
        return without(view, self._mover_masks[position]) if position in self._mover_masks else view

    def _whole_view(self, position: int) -> WorkingFrame:
        if position not in self._views:
            self._views.clear()
            frame = self.frames[position]
            assert frame.depth is not None
            view = make_view(frame.color, frame.depth, self.small, self.settings.noise)
            self._views[position] = view
            self.cosines[position] = cosines(view.points, view.normals, view.valid)
        return self._views[position]

    @property
    def mover_masks(self) -> dict[int, Mask]:
        """Movers that were left out of each frame, by position, at working resolution."""
        return {position: mask for position, mask in sorted(self._mover_masks.items()) if mask.any()}

    def features(self, position: int) -> Features:
        """Return the frame's local features, found once."""
        if position not in self._features:
            frame = self.frames[position]
            assert frame.depth is not None
            settings = replace(self.settings.features, width=self.settings.feature_width)
            self._features[position] = detect(frame.color, frame.depth, self.camera, settings)
        return self._features[position]

    def _step(self, position: int) -> None:
        if self.frames[position].depth is None or self.view(position).known_share < self.settings.least_known:
            return
        mask = self._mover_memory.expect(self._whole_view(position))
        if position in self._known:
            mask = self._known[position] if mask is None else mask | self._known[position]
        for segment in self._open_segments():
            self._set_mover_mask(position, mask)
            found = self._follow(segment, position)
            if found is not None:
                self._accept(segment, position, found)
                return
        self._set_mover_mask(position, mask)
        self.segments.append(TrackedSegment(SurfelModel(self.settings.fusion, self.settings.noise)))
        self._accept(self.segments[-1], position, np.eye(4))

    def _open_segments(self) -> list[TrackedSegment]:
        """Return the last segment, and the longest one while the last may be only a few bad frames."""
        last = self.segments[-1:]
        longest = max(self.segments, key=lambda s: len(s.T_segment_cam), default=None)
        short = bool(last) and len(last[0].T_segment_cam) < self.settings.short_segment
        return [*last, longest] if short and longest is not None and longest is not last[0] else last

    def _accept(self, segment: TrackedSegment, position: int, T_segment_cam: Pose) -> None:
        if position in self._mover_masks:
            self._keep_movers(segment, position, T_segment_cam)
        else:
            self._mover_memory.mask = None
        segment.T_segment_cam[position] = T_segment_cam
        if position in self._unsure:
            return
        segment.model.fuse(self.view(position), T_segment_cam)
        if not segment.keyframes or self._moved(segment, position):
            segment.keyframes.append(position)

    def _set_mover_mask(self, position: int, mask: Mask | None) -> None:
        self._mover_masks.pop(position, None)
        if mask is not None:
            self._mover_masks[position] = mask

    def _keep_movers(self, segment: TrackedSegment, position: int, T_segment_cam: Pose) -> None:
        """Remove movers from the model, and propagate them to the next frame until they are static."""
        view, mask = self._whole_view(position), self._mover_masks[position]
        samples = segment.model.samples(T_segment_cam, self.small, self.settings.sweep_samples)
        usual = fit(samples, view, mask, T_segment_cam, self.settings.movers, self.settings.noise).outside
        mask = self._mover_memory.keep(view, mask, T_segment_cam, usual, self.segments.index(segment))
        if position in self._known:
            mask = mask | self._known[position]
        self._mover_masks[position] = mask
        segment.model.forget(view, mask, T_segment_cam)

    def _moved(self, segment: TrackedSegment, position: int) -> bool:
        step = np.linalg.inv(segment.T_segment_cam[segment.keyframes[-1]]) @ segment.T_segment_cam[position]
        return shows_more(step, self.view(position).middle_depth, self.settings.keyframes)

    def _follow(self, segment: TrackedSegment, position: int) -> Pose | None:
        """Return the frame's pose in the segment, or None without a reliable one."""
        last = max(segment.T_segment_cam)
        gap_s = max(self.frames[position].time_s - self.frames[last].time_s, 1e-3)
        self.unproven.discard(position)
        found: list[FrameRegistration | None] = []
        given = self._given(segment, last, position, gap_s)
        if given is not None:
            found.append(self._place(segment, position, given.T_model_cam, prior=given))
            if self._doubtful(segment, found[0]):  # the given poses may have jumped
                T = self._predict(segment, last, gap_s)
                nearby = gap_s <= self.settings.most_gap_s
                found.append(
                    self._search(segment, position, nearby) if T is None else self._place(segment, position, T)
                )
            possible = [f for f in found if f is not None and self._possible(segment, last, f, gap_s)]
            believed = [f for f in possible if self._believed(segment, given, f)]
            if possible and not believed:  # the given step alone, of a frame that shows something else
                self._unsure.add(position)  # not for the model
            possible = believed
        else:
            best = self._without_given(segment, last, position, gap_s)
            possible = [] if best is None else [best]
        if not possible:
            self.unproven |= {position} if given is not None else set()
            return None if given is None else given.T_model_cam
        best, forget = max(possible, key=_explained), self.settings.forget
        segment.usual_inliers = max(best.inliers, forget * segment.usual_inliers)
        segment.usual_agreement = max(best.inliers * _alike(best), forget * segment.usual_agreement)
        self._leave_out(position, best)
        return best.T_model_cam

    def _leave_out(self, position: int, found: FrameRegistration) -> None:
        """Keep the movers of the registration that was chosen; those of a false one are none."""
        if found.movers is not None:
            self._mover_masks[position] = self._mover_masks.get(position, np.zeros_like(found.movers)) | found.movers

    def _without_given(
        self, segment: TrackedSegment, last: int, position: int, gap_s: float
    ) -> FrameRegistration | None:
        """Find the frame by a start that foretells it, or else by features and starts all round.

        What the pictures do decides which, never the time between them.
        """
        predicted = self._predict(segment, last, gap_s)
        found: list[FrameRegistration] = []
        for T in () if predicted is None else (predicted, segment.T_segment_cam[last]):
            placed = self._place(segment, position, T)
            if placed is None:
                continue
            sure = self._foretold(segment, T, placed) and not self._doubtful(segment, placed)
            if sure and self._possible(segment, last, placed, gap_s):
                return placed
            found.append(placed)
        nearby = gap_s <= self.settings.most_gap_s
        return self._search(segment, position, nearby, frugal=True, found=found)

    def _foretold(self, segment: TrackedSegment, T_guess: Pose, found: FrameRegistration) -> bool:
        """Return whether a registration ended so near its start that no other minimum lies between."""
        seen = segment.model.samples(found.T_model_cam, self.small, self.settings.sweep_samples)
        return image_motion_px(seen, self.small, T_guess, found.T_model_cam) <= self.settings.foretold_px

    def _believed(self, segment: TrackedSegment, given: PosePrior, found: FrameRegistration) -> bool:
        """Return whether a pose is near the given step, or fits so well that the given poses must have jumped.

        A blurred picture of a bare floor also fits elsewhere, if badly (0153).
        """
        prior = self.settings.prior
        off = np.linalg.inv(given.T_model_cam) @ found.T_model_cam
        if np.linalg.norm(off[:3, 3]) <= prior.jump_m and angle_deg(off) <= prior.jump_deg:
            return True
        return bool(
            found.inliers >= prior.jump_inliers * segment.usual_inliers and found.correlation >= prior.jump_correlation
        )

    def _doubtful(self, segment: TrackedSegment, found: FrameRegistration | None) -> bool:
        """Return whether depth and brightness agree much less than in the frames before, as in a false minimum.

        At the beginning of a segment nothing is usual yet: they must agree nearly wholly.
        """
        usual = segment.usual_agreement or 1.0
        return found is None or found.inliers * _alike(found) < self.settings.doubt * usual

    def _given(self, segment: TrackedSegment, last: int, position: int, gap_s: float) -> PosePrior | None:
        """The frame's pose by the source's own poses; None where these are missing or the motion is impossible."""
        s = self.settings
        step = given_step(self.frames[last].T_source_cam, self.frames[position].T_source_cam) if self._prior else None
        if step is None or angle_deg(step) > s.most_turn_deg_per_s * gap_s:
            return None
        length = float(np.linalg.norm(step[:3, 3]))
        if length > s.most_speed_m_per_s * gap_s:
            return None
        shift_m = float(np.hypot(s.prior.shift_m, s.prior.shift_share * length))
        turn_rad = float(np.radians(s.prior.turn_deg))
        return PosePrior(segment.T_segment_cam[last] @ step, shift_m, turn_rad, s.prior.correlated)

    def _predict(self, segment: TrackedSegment, last: int, gap_s: float) -> Pose | None:
        """Constant velocity from the last two frames; None at the beginning, where it is not known."""
        before = [p for p in segment.T_segment_cam if p < last][-1:]
        T_last = segment.T_segment_cam[last]
        if not before:
            return None
        span_s = self.frames[last].time_s - self.frames[before[0]].time_s
        if not span_s > 0:
            return None
        step = np.linalg.inv(segment.T_segment_cam[before[0]]) @ T_last
        ratio = gap_s / span_s
        moved = np.eye(4)
        moved[:3, :3] = cv2.Rodrigues(cv2.Rodrigues(step[:3, :3])[0] * ratio)[0]
        moved[:3, 3] = step[:3, 3] * ratio
        return T_last @ moved

    def _place(
        self,
        segment: TrackedSegment,
        position: int,
        T_guess: Pose,
        blind: bool = False,
        prior: PosePrior | None = None,
        features: VerifiedFeatures | None = None,
    ) -> FrameRegistration | None:
        """Register the frame to the segment's model from a guess, kept only when it is reliable.

        `features` that prove it stand in for the agreement of brightness, which reflections and exposure spoil.
        """
        samples = segment.model.samples(T_guess, self.small, self.settings.samples)
        s, view = self.settings, self.view(position)
        found = register(samples, view, T_guess, s.registration, s.noise, prior)
        if found is not None and not blind:
            mover = mover_in_residuals(samples, view, T_guess, found, s, prior)
            if mover is not None and self._trusted(mover[1], samples, position, blind, features):
                found = replace(mover[1], movers=mover[0])
        return found if found is not None and self._trusted(found, samples, position, blind, features) else None

    def _trusted(
        self,
        found: FrameRegistration,
        samples: Samples,
        position: int,
        blind: bool,
        features: VerifiedFeatures | None = None,
    ) -> bool:
        """Return whether a registration is reliable; one from a blind guess must agree in brightness as well."""
        s, view = self.settings, self.view(position)
        share = view.known_share
        agrees = found.correlation >= s.least_correlation if blind else not found.correlation < s.least_correlation
        proven = features is not None and features.prove and features.agree_with(found.T_model_cam)
        return bool(
            (agrees or proven)
            and found.overlap >= s.least_overlap * share
            and len(samples.points) * found.overlap >= 0.25 * s.least_overlap * view.valid.sum()
            and found.inliers >= s.least_inliers
            and found.residual <= s.most_residual
            and found.looseness_m(view.middle_depth) <= s.most_looseness_m
        )

    def _possible(self, segment: TrackedSegment, last: int, found: FrameRegistration | None, gap_s: float) -> bool:
        if found is None:
            return False
        step = np.linalg.inv(segment.T_segment_cam[last]) @ found.T_model_cam
        gap_s = max(gap_s, 1.0 / 60.0)
        return bool(
            np.linalg.norm(step[:3, 3]) <= self.settings.most_speed_m_per_s * gap_s
            and angle_deg(step) <= self.settings.most_turn_deg_per_s * gap_s
        )

    def _search(
        self,
        segment: TrackedSegment,
        position: int,
        nearby: bool,
        frugal: bool = False,
        found: Sequence[FrameRegistration] = (),
        known: Sequence[int] | None = None,
    ) -> FrameRegistration | None:
        """Find the frame by features, and by starts around the last pose where it is `nearby`.

        Features are compared with those of frames `known`, else of the last ones. `found` are registrations that
        nothing confirms yet. A `frugal` search takes the first unambiguous place by features. Raises
        `_SkippedFramesNeededError` where frames before it were skipped.
        """
        if self._waiting:
            raise _SkippedFramesNeededError
        last = max(segment.T_segment_cam)
        if known is None:
            known = [last, *[k for k in reversed(segment.keyframes) if k != last]][: self.settings.search_keyframes]
        guesses = (self._feature_guess(segment, k, position) for k in known)
        verified = (features for features in guesses if features is not None)
        tried: list[VerifiedFeatures] = []
        placed: list[FrameRegistration | None] = [*found]
        for features in verified if frugal else ():
            tried.append(features)
            placed.append(self._place(segment, position, features.T_model_cam, features=features))
            if self._certain(segment, placed[-1], features):
                return placed[-1]
        left = list(verified)
        blind = self._sweep(segment, last, position) if nearby else []
        placed += [self._place(segment, position, features.T_model_cam, features=features) for features in left]
        placed += [self._place(segment, position, T, blind=True) for T in blind]
        proofs = [features for features in (*tried, *left) if features.prove]
        reliable = (p for p in placed if p is not None and (not frugal or self._settled(segment, position, p, proofs)))
        best = max(reliable, key=_explained, default=None)
        if frugal and best is not None and not proofs:
            if self._doubtful(segment, best) or not self._tight(best, position):
                self.unproven.add(position)
        return best

    def _certain(self, segment: TrackedSegment, found: FrameRegistration | None, features: VerifiedFeatures) -> bool:
        if found is None or not features.agree_with(found.T_model_cam):
            return False
        return features.prove or not self._doubtful(segment, found)

    def _settled(
        self, segment: TrackedSegment, position: int, found: FrameRegistration, proofs: Sequence[VerifiedFeatures]
    ) -> bool:
        """Return whether features prove a registration, or else the motion is possible and depth or colour tells it.

        Where depth leaves a direction free and brightness agrees less than usual, it may have slid along.
        """
        if proofs:
            return any(features.agree_with(found.T_model_cam) for features in proofs)
        last = max(segment.T_segment_cam)
        gap_s = self.frames[position].time_s - self.frames[last].time_s
        sure = self._tight(found, position) or not self._doubtful(segment, found)
        return sure and self._possible(segment, last, found, gap_s)

    def _tight(self, found: FrameRegistration, position: int) -> bool:
        """Return whether depth alone determines all directions."""
        loose_m = found.looseness_m(self.view(position).middle_depth, surfaces_only=True)
        return loose_m <= self.settings.most_looseness_m

    def _sweep(self, segment: TrackedSegment, last: int, position: int) -> list[Pose]:
        """The best of several coarse registrations, started from the usual motions between frames of a slow video."""
        view, T_last = self.view(position), segment.T_segment_cam[last]
        far = view.middle_depth
        samples = segment.model.samples(T_last, self.small, self.settings.sweep_samples)
        found = [
            register(samples, view, T_last @ T, self.settings.sweep, self.settings.noise)
            for T in _starts(far, self.settings)
        ]
        ranked = sorted((f for f in found if f is not None), key=lambda f: -f.overlap * f.inliers)
        return [f.T_model_cam for f in ranked[:3]]

    def _feature_guess(self, segment: TrackedSegment, known: int, new: int) -> VerifiedFeatures | None:
        s, T_segment_known = self.settings, segment.T_segment_cam[known]
        return VerifiedFeatures.between(self.features(known), T_segment_known, self.features(new), s.features, s.noise)

    def _join(self) -> list[TrackedSegment]:
        """Attach segments to the largest one, over and over until no more can be."""
        left = sorted(self.segments, key=lambda s: -len(s.T_segment_cam))
        base, attached = left[:1], bool(left)
        left = left[1:]
        while attached:
            apart = [other for other in left if not self._attach(base[0], other)]
            attached, left = len(apart) < len(left), apart
        return base + left

    def _connect(self, base: TrackedSegment, other: TrackedSegment) -> Pose | None:
        """Return where another segment lies by a keyframe of it; a long one is searched for in all of the base.

        Past a bare wall the camera looks at what it saw before it turned there, which its last views do not show. Far
        from these the planks of a floor look alike, so that depth alone must determine the place of a long one.
        """
        s, seen = self.settings, other.keyframes[:4]
        wide = len(other.T_segment_cam) >= s.short_segment
        if wide:
            seen = other.keyframes[:: max(1, len(other.keyframes) // s.join_keyframes)][: s.join_keyframes]
        for position in seen:
            near = [k for _, k in sorted((abs(k - position), k) for k in base.keyframes)][: 3 * s.join_keyframes]
            found = self._search(base, position, nearby=False, known=near if wide else None)
            if found is not None and (not wide or self._tight(found, position)):
                self._leave_out(position, found)
                return found.T_model_cam @ np.linalg.inv(other.T_segment_cam[position])
        return None

    def _attach(self, base: TrackedSegment, other: TrackedSegment) -> bool:
        """Add a segment to another where the two can be related; returns whether it was."""
        T_base_other = self._connect(base, other)
        if T_base_other is None:
            return False
        for position, T in other.T_segment_cam.items():
            base.T_segment_cam[position] = T_base_other @ T
        for position in other.keyframes:
            base.model.fuse(self.view(position), base.T_segment_cam[position])
        base.keyframes = sorted([*base.keyframes, *other.keyframes])
        return True


def _starts(far_m: float, settings: OdometrySettings) -> list[Pose]:
    """Return no motion, shifts, and orbits about a point at the median depth."""
    out = [np.eye(4)]
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            shift, orbit, turn = np.eye(4), np.eye(4), np.zeros(3)
            shift[axis, 3] = settings.start_shift * sign * far_m
            turn[1 - axis] = np.radians(settings.start_turn_deg) * sign
            orbit[:3, :3] = cv2.Rodrigues(turn)[0]
            orbit[:3, 3] = far_m * (np.eye(3) - orbit[:3, :3])[:, 2]
            out += [shift, orbit]
    return out

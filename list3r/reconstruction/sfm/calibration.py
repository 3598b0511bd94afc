"""Estimate the lens of an RGB source once before its chunks: focal length and radial distortion.

Windows spread over the video are mapped each by itself with a free camera, and then adjusted together with one camera
for all. A window is weighted by its parallax. All chunks use the estimated camera (research/colour-video 0069).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Camera, FrameSource, guessed_camera, index_at
from list3r.reconstruction.sfm.colmap import pycolmap
from list3r.reconstruction.sfm.links import keyframe_problem
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap, build_maps
from list3r.reconstruction.sfm.settings import CameraCalibrationSettings, SfmSettings
from list3r.reconstruction.sfm.tracks import CornerTracks, follow_corners


@dataclass(frozen=True)
class CameraCalibration:
    """The estimated camera of a source."""

    camera: Camera
    """With the distortion of the pictures as they are delivered."""
    windows: int
    """Windows that support it; 0 where none could be mapped and the camera is unchanged."""
    focal_px: float | None
    """Focal length by the pictures alone, None where it could not be estimated."""
    notes: tuple[str, ...] = ()
    """Warnings for the user, one sentence each."""


def calibrate(
    source: FrameSource,
    settings: SfmSettings | None = None,
    progress: Progress | None = None,
    stored_px: float = 1.0,
    mapped: WindowMaps | None = None,
) -> CameraCalibration:
    """Estimate the camera of a source: all of it where it is unknown, the distortion where the rest is given.

    `stored_px` is how many px of the pictures as stored one px of the source's frames is; notes use the former.
    `mapped` maps the windows elsewhere, as in other processes, with the result of `map_window`.
    """
    sfm = settings or SfmSettings()
    chosen = sfm.calibration
    info = source.info
    known = info.camera is not None
    start = info.camera or guessed_camera(info)
    mapped = mapped or (lambda spans, camera: (map_window(source, *span, camera, sfm) for span in spans))
    found = _estimated(source, start, chosen, mapped, progress)
    if found is None and known:
        found = _estimated(source, guessed_camera(info), chosen, mapped, progress)
    if found is None:
        return _nothing(start, known, stored_px)
    windows, free, k1 = found.windows, found.camera, found.k1
    if known:
        return _of_known(windows, (start, free), chosen, stored_px, _parted(found, stored_px, chosen))
    sigma = _focal_sigma(windows, chosen)
    said = f"the camera was estimated from the pictures: focal length {_px_text(free, sigma, stored_px)}"
    notes = (f"{said}; distortion k1 {k1:.3f}", *_parted(found, stored_px, chosen))
    return CameraCalibration(_lens(free, k1, chosen), len(windows), free.fx, notes)


def calibrate_by_map(
    start: Camera, keyframes: tuple[MapProblem, SparseMap], settings: SfmSettings, stored_px: float = 1.0
) -> CameraCalibration:
    """Estimate the unknown parts of a camera of given focal length, from some keyframes of a map of the video."""
    free, _ = _adjust_together([keyframes], start, True, settings.calibration)
    return _of_known([keyframes], (start, free), settings.calibration, stored_px)


def _of_known(
    windows: _Windows,
    cameras: tuple[Camera, Camera],
    settings: CameraCalibrationSettings,
    stored_px: float,
    notes: tuple[str, ...] = (),
) -> CameraCalibration:
    """Return the lens of a camera as given, or a warning where the pictures alone suggest another camera."""
    start, free = cameras
    sigma = _focal_sigma(windows, settings)
    if abs(np.log(free.fx / start.fx)) > settings.doubted_sigmas * sigma:
        said = (
            f"the given focal length {start.fx * stored_px:.0f} px does not fit the pictures, which suggest about "
            f"{_px_text(free, sigma, stored_px)}; check --intrinsics, or leave it out"
        )
        return CameraCalibration(start, len(windows), free.fx, (said,))
    _, k1 = _adjust_together(windows, start, False, settings)
    lens = _lens(start, k1, settings) if _believable(start, k1, settings) else start
    return CameraCalibration(lens, len(windows), free.fx, notes)


def _px_text(camera: Camera, sigma: float, stored_px: float) -> str:
    return f"{camera.fx * stored_px:.0f} px, give or take {100 * sigma:.0f} %"


_Windows = list[tuple[MapProblem, SparseMap]]
WindowMaps = Callable[[Sequence[tuple[int, int]], Camera], Iterable[tuple[MapProblem, SparseMap] | None]]
"""Maps windows, by their positions [start, stop), each from an initial camera."""
Progress = Callable[[int, int], None]
"""Called with (windows done, in all)."""


@dataclass(frozen=True)
class _Estimate:
    """The estimates of a video's windows."""

    windows: _Windows
    """The windows that agree, from which the camera is."""
    camera: Camera
    k1: float
    others: tuple[tuple[int, float, float], ...]
    """Frame.index at which plausible windows begin that disagree; their focal length, px; k1."""
    frames: int
    """Length of a window."""


def _estimated(
    source: FrameSource,
    start: Camera,
    settings: CameraCalibrationSettings,
    mapped: WindowMaps,
    progress: Progress | None,
) -> _Estimate | None:
    """Return the estimate of the plausible windows among those mapped; None where they make no sense."""
    windows, begins, spans = [], [], _spans(source.info.frame_count, settings)
    for done, window in enumerate(mapped(spans, start), start=1):
        if window is not None and _believable(window[1].camera, window[1].k1, settings):
            windows.append(window)
            begins.append(index_at(source, spans[done - 1][0]))
        if progress is not None:
            progress(done, len(spans))
    if not windows:
        return None
    focals = np.array([found.camera.fx for _, found in windows])
    agree = _agreeing(focals, settings)
    kept = [w for w, chosen in zip(windows, agree.tolist(), strict=True) if chosen]
    middle = float(np.exp(np.median(np.log(focals[agree]))))
    free, k1 = _adjust_together(kept, replace(start, fx=middle, fy=middle), True, settings)
    others = tuple((begins[k], float(focals[k]), windows[k][1].k1) for k in np.flatnonzero(~agree).tolist())
    return _Estimate(kept, free, k1, others, spans[0][1] - spans[0][0]) if _believable(free, k1, settings) else None


def _believable(camera: Camera, k1: float, settings: CameraCalibrationSettings) -> bool:
    """Return whether a lens of such a camera exists."""
    share = camera.fx / max(camera.width, camera.height)
    (short, long), (least, most) = settings.focal_range, settings.distortion_range
    return short < share < long and least <= k1 <= most


def _agreeing(focals: NDArray[np.float64], settings: CameraCalibrationSettings) -> NDArray[np.bool_]:
    """Windows near the median of all; where fewer than half are, those near the one with most around it."""
    logs = np.log(focals)
    near = np.abs(logs[:, None] - np.r_[np.median(logs), logs][None]) < np.log(settings.most_window_ratio)
    votes = near.sum(axis=0)
    return np.asarray(near[:, 0 if 2 * votes[0] >= len(logs) else 1 + int(np.argmax(votes[1:]))])


def _parted(found: _Estimate, stored_px: float, settings: CameraCalibrationSettings) -> tuple[str, ...]:
    """Return the warning for plausible windows of clearly different focal lengths."""
    if found.frames < settings.frames:
        return ()
    far = [
        (n, f)
        for n, f, k1 in found.others
        if abs(np.log(f / found.camera.fx)) > np.log(settings.zoom_ratio)
        and abs(k1 - found.k1) < settings.zoom_distortion
    ]
    if not far:
        return ()
    where = ", ".join(f"{f * stored_px:.0f} px from frame {n} on" for n, f in far)
    return (
        f"parts of the video suggest another focal length ({where}): the camera zoomed or changed its lens, or they "
        "show too little; one camera is used for all. Build the part of each lens separately (--frames, or --start and "
        "--end)",
    )


def _nothing(start: Camera, known: bool, stored_px: float) -> CameraCalibration:
    if known:
        return CameraCalibration(start, 0, None)
    guess = f"a focal length of {start.fx * stored_px:.0f} px is a guess: give --intrinsics"
    said = f"the camera could not be estimated; {guess}"
    return CameraCalibration(start, 0, None, notes=(said,))


def _focal_sigma(windows: _Windows, settings: CameraCalibrationSettings) -> float:
    """Standard deviation of the logarithm of the focal length of all windows, from how far they differ."""
    logs = np.log([found.camera.fx for _, found in windows])
    square = settings.window_weight * settings.window_sigma**2 + float(((logs - logs.mean()) ** 2).sum())
    return float(np.sqrt(square / (settings.window_weight + len(logs) - 1) / len(logs)))


def _spans(count: int, settings: CameraCalibrationSettings) -> list[tuple[int, int]]:
    """Windows spread evenly over a source; those of a short one overlap."""
    frames = int(np.clip(count // 2, settings.least_frames, settings.frames))
    last = max(0, count - frames)
    most = int(np.clip(count // settings.frames, settings.least_windows, settings.windows))
    windows = min(most, 1 + last // (frames // 2))
    starts = np.linspace(0, last, windows).astype(int).tolist() if windows > 1 else [last // 2]
    return [(a, min(a + frames, count)) for a in starts]


def map_window(
    source: FrameSource, start: int, stop: int, camera: Camera, settings: SfmSettings
) -> tuple[MapProblem, SparseMap] | None:
    """Return the largest map of the frames at positions [start, stop), with its own camera; None without one."""
    frames = [f for f in source.read(start, stop) if not isinstance(f, BadFrame)]
    if len(frames) < 2:
        return None
    grays = [f.gray() for f in frames]
    tracks = _longest_run(follow_corners(grays, settings.tracks))
    if len(tracks.keyframes) < 3:
        return None
    problem = keyframe_problem(tracks, grays, settings.links)
    maps = build_maps(problem, camera, free_camera="focal", settings=settings.calibration.mapping)
    return (problem, maps[0]) if maps and len(maps[0].T_map_cam) >= 3 else None


def _longest_run(tracks: CornerTracks) -> CornerTracks:
    """The tracks with the keyframes of their longest run alone, where it has half of the frames: other runs would be
    joined by features over a jump or a wall and add nothing on the lens."""
    followed = tracks.run[tracks.run >= 0]
    longest = int(np.bincount(followed).argmax()) if len(followed) else -1
    if 2 * int((tracks.run == longest).sum()) < len(tracks.run):
        return tracks
    return replace(tracks, keyframes=tuple(k for k in tracks.keyframes if tracks.run[k] == longest))


def _adjust_together(
    windows: Sequence[tuple[MapProblem, SparseMap]],
    camera: Camera,
    free_focal: bool,
    settings: CameraCalibrationSettings,
) -> tuple[Camera, float]:
    """One camera and its k1 for all windows, by bundle adjustment of all of them."""
    made = pycolmap.Reconstruction()
    start = [0.5 * (camera.fx + camera.fy), camera.cx + 0.5, camera.cy + 0.5, 0.0]
    if free_focal:
        start[3] = float(np.median([found.k1 for _, found in windows]))
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=camera.width, height=camera.height, params=start, camera_id=1)
    made.add_camera_with_trivial_rig(lens)
    for number, (problem, found) in enumerate(windows):
        _add_window(made, number, problem, found)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.print_summary = free_focal, False
    solver = options.ceres
    solver.loss_function_type, solver.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, 0.5
    solver.solver_options.num_threads, solver.solver_options.max_num_iterations = 1, 60
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in made.reg_image_ids():
        config.add_image(image_id)
    for left in reversed(range(settings.rounds)):
        solver.solver_options.function_tolerance = settings.early_tolerance if left else settings.tolerance
        pycolmap.create_default_bundle_adjuster(options, config, made).solve()
        pycolmap.ObservationManager(made).filter_points3D_with_large_reprojection_error(
            settings.most_error_px, set(made.points3D), pycolmap.ReprojectionErrorType.PIXEL
        )
    focal, cx, cy, k1 = made.cameras[1].params
    return replace(camera, fx=float(focal), fy=float(focal), cx=float(cx) - 0.5, cy=float(cy) - 0.5), float(k1)


def _add_window(made: pycolmap.Reconstruction, number: int, problem: MapProblem, found: SparseMap) -> None:
    """Views and points of one window, apart from those of the others."""
    base = 1 + 10_000 * number
    seen: dict[int, list[tuple[int, int]]] = {}
    for key, T in sorted(found.T_map_cam.items()):
        view: KeyframeView = problem.views[key]
        image = pycolmap.Image(f"{base + key}", view.xy.astype(np.float64) + 0.5, 1, base + key)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(T)[:3]))
        for row, track in enumerate(view.ids.tolist()):
            if track in found.points:
                seen.setdefault(track, []).append((base + key, row))
    for track, rows in sorted(seen.items()):
        if len(rows) >= 2:
            made.add_point3D(found.points[track], pycolmap.Track([pycolmap.TrackElement(*r) for r in rows]))


def _lens(camera: Camera, k1: float, settings: CameraCalibrationSettings) -> Camera:
    """Return the camera with its distortion, unless that shifts nothing."""
    x, y = max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy)
    square = (x / camera.fx) ** 2 + (y / camera.fy) ** 2
    if abs(k1) * square * float(np.hypot(x, y)) < settings.least_shift_px:
        return camera
    return replace(camera, distortion=(k1, 0.0, 0.0, 0.0, 0.0))

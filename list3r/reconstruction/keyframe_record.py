"""The parts of a chunk's frames that are stored to relate other chunks to it: keyframes and overlap samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.frames.base import Camera, Frame
from list3r.memory.core.masks import shown_surface
from list3r.memory.core.records import Feature, FrameSamples, Keyframe, LocalLibrary
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.features.learned import LearnedDetector, as_bytes
from list3r.reconstruction.features.local import Features, detect, points_at
from list3r.reconstruction.features.vlad import describe_frame
from list3r.reconstruction.rgbd.view import shrink_depth
from list3r.reconstruction.settings import KeyframeSettings, SampleSettings

FrameDescriptor = Callable[[NDArray[np.uint8]], NDArray[np.float32]]
"""A unit descriptor (D,) of a whole picture (H, W, 3)."""


@dataclass(frozen=True)
class KeyframeNetworks:
    """Networks that describe keyframes."""

    detector: LearnedDetector | None = None
    """Of local features, replacing SIFT."""
    frame_descriptor: FrameDescriptor | None = None
    """Of the whole frame, replacing the VLAD of its SIFT features."""


def make_keyframes(
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    keep_jpeg: bool,
    settings: KeyframeSettings | None = None,
    networks: KeyframeNetworks | None = None,
    library: LocalLibrary | None = None,
) -> tuple[Keyframe, ...]:
    """Return the keyframes of a chunk in order of time.

    With pictures and a `library` also frames that are kept for their picture alone, so that of every instance one of
    the best views is kept.
    """
    chosen = settings or KeyframeSettings()
    kept = [int(p) for p in reconstruction.keyframes if reconstruction.posed[p]]
    by = networks or KeyframeNetworks()
    made = {p: _make_keyframe(frames[p], reconstruction, p, chosen, by) for p in kept}
    if keep_jpeg:
        if library is not None and made:
            like = made[kept[0]].descriptor
            for p in frames_to_show(library, reconstruction, kept, chosen):
                made[p] = _picture_alone(reconstruction, p, like)
        made = {p: replace(k, jpeg=_jpeg(frames[p].color, chosen.jpeg_quality)) for p, k in made.items()}
    return tuple(made[p] for p in sorted(made))


def frames_to_show(
    library: LocalLibrary, reconstruction: Reconstruction, kept: Sequence[int], settings: KeyframeSettings
) -> list[int]:
    """Return the positions of further frames that show instances which the `kept` ones show too little.

    The frame that serves most instances is taken first, among equals the one with most of their surface.
    """
    shown = _shown_surfaces(library, reconstruction, settings)
    wanted = settings.shown_share * shown.max(axis=0, initial=0.0)
    lacking = shown[kept].max(axis=0, initial=0.0) < wanted
    out: list[int] = []
    while lacking.any():
        serves = (shown >= wanted) & lacking
        surface = np.where(serves, shown, 0.0).sum(axis=1)
        best = int(np.lexsort((-surface, -serves.sum(axis=1)))[0])
        out.append(best)
        lacking &= ~serves[best]
    return out


def _shown_surfaces(
    library: LocalLibrary, reconstruction: Reconstruction, settings: KeyframeSettings
) -> NDArray[np.float64]:
    """Surface of each instance that each posed frame shows. Shape (F, instances)."""
    place = {int(n): k for k, n in enumerate(reconstruction.frame_indices) if reconstruction.posed[k]}
    out = np.zeros((len(reconstruction.frame_indices), len(library.instances)))
    for column, instance in enumerate(library.instances):
        track = instance.track
        shown = shown_surface(track.visible_fraction, track.areas_px, settings.full_side_px)
        for n, share in zip(track.frames.tolist(), shown.tolist(), strict=True):
            if n in place:
                out[place[n], column] = share
    return out


def _picture_alone(reconstruction: Reconstruction, position: int, like: Feature) -> Keyframe:
    """A frame that is kept for its picture alone: nothing is registered to it."""
    camera = reconstruction.camera
    return Keyframe(
        frame_index=int(reconstruction.frame_indices[position]),
        T_chunk_cam=reconstruction.T_chunk_cam[position].copy(),
        descriptor=np.zeros_like(like),
        keypoints_xy=np.zeros((0, 2), np.float32),
        keypoint_descriptors=np.zeros((0, 0), np.uint8),
        points_cam=np.zeros((0, 3), np.float32),
        depth_small=np.zeros((0, 0), np.float32),
        camera_small=(camera.fx, camera.fy, camera.cx, camera.cy),
    )


def frame_samples(
    reconstruction: Reconstruction, library: LocalLibrary | None = None, settings: SampleSettings | None = None
) -> FrameSamples:
    """Points of all posed frames on fixed pixel grids, with the instances whose masks contain them."""
    chosen = settings or SampleSettings()
    positions = np.flatnonzero(reconstruction.posed)
    camera = reconstruction.camera
    row, column, level = _pixel_grid(camera, chosen)
    places = positions[:, None], row, column
    depth, confidence = reconstruction.depth[places], reconstruction.confidence[places].astype(np.float32)
    instance, small = _instances(library, reconstruction, positions, row, column, chosen)
    last = len(reconstruction.frame_indices) - 1
    near_end = np.minimum(positions, last - positions) < chosen.end_frames
    wanted = level[None] <= near_end[:, None].astype(np.int64) + small
    known = wanted & (depth > 0) & (confidence > 0)
    place, cell = np.nonzero(known)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=1)
    T = reconstruction.T_chunk_cam[positions]
    seen = depth[known][:, None] * rays[cell]
    points = np.einsum("nij,nj->ni", T[place, :3, :3], seen) + T[place, :3, 3]
    return FrameSamples(
        frame=reconstruction.frame_indices[positions][place].astype(np.int64),
        pixel=(row * camera.width + column)[cell].astype(np.int32),
        points=_rounded(points, chosen.resolution_bits),
        confidence=(np.ceil(confidence[known] * 256) / 256).astype(np.float32),
        instance=instance[known],
        camera_frames=reconstruction.frame_indices[positions].astype(np.int64),
        T_chunk_cam=T.astype(np.float64),
    )


def _rounded(points: NDArray[np.float64], bits: int) -> NDArray[np.float32]:
    """Points on multiples of a power of two, at most 2^-bits of their extent."""
    finite = points[np.isfinite(points).all(axis=1)]
    extent = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
    if not extent > 0:
        return points.astype(np.float32)
    step = 2.0 ** (np.floor(np.log2(extent)) - bits)
    return np.asarray(np.round(points / step) * step, np.float32)


def _instances(
    library: LocalLibrary | None,
    reconstruction: Reconstruction,
    positions: NDArray[np.int64],
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    settings: SampleSettings,
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Local id of the smallest mask at each pixel of each frame, -1 for none, and whether it is small. (G, N)."""
    out = np.full((len(positions), len(row)), -1, np.int32)
    place = {int(reconstruction.frame_indices[p]): k for k, p in enumerate(positions)}
    area = np.full(out.shape, np.iinfo(np.int32).max, np.int32)
    pixel = row * reconstruction.camera.width + column
    for instance in library.instances if library is not None else ():
        track = instance.track
        for index, mask, size in zip(track.frames, track.masks, track.areas_px, strict=True):
            k = place.get(int(index))
            if k is None:
                continue
            _hold(mask, pixel, (instance.local_id, int(size)), out[k], area[k])
    most = settings.small_share * reconstruction.camera.width * reconstruction.camera.height
    return out, np.asarray(area <= most)


@compiled
def _hold(
    mask: NDArray[np.uint32],
    pixel: NDArray[np.int64],
    held: tuple[int, int],
    owner: NDArray[np.int32],
    area: NDArray[np.int32],
) -> None:
    """Assign pixels (N,), ascending, of a mask's run-length code to an instance of an area, where that is less."""
    at, stop = 0, np.int64(0)
    for k in range(len(mask)):
        stop += np.int64(mask[k])
        if k % 2 == 0:
            at += int(np.searchsorted(pixel[at:], stop))
            continue
        while at < len(pixel) and pixel[at] < stop:
            if held[1] < area[at]:
                owner[at], area[at] = held
            at += 1


def _pixel_grid(
    camera: Camera, settings: SampleSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the finest grid, and the level from which each pixel is used: 0 coarse to 2 fine."""
    rows, columns = np.arange(settings.rows), np.arange(settings.columns)
    level_y, level_x = (np.where(n % 4 == 2, 0, np.where(n % 2 == 0, 1, 2)) for n in (rows, columns))
    y = ((rows + 0.5) * camera.height / settings.rows).astype(np.int64)
    x = ((columns + 0.5) * camera.width / settings.columns).astype(np.int64)
    grid = np.meshgrid(y, x, indexing="ij")
    level = np.maximum(level_y[:, None], level_x[None, :])
    _, first = np.unique(grid[0].ravel() * camera.width + grid[1].ravel(), return_index=True)
    return grid[0].ravel()[first], grid[1].ravel()[first], level.ravel()[first]


def _make_keyframe(
    frame: Frame,
    reconstruction: Reconstruction,
    position: int,
    settings: KeyframeSettings,
    networks: KeyframeNetworks,
) -> Keyframe:
    camera, depth = reconstruction.camera, reconstruction.depth[position]
    features = detect(frame.color, depth, camera, settings.features)
    small = camera.shrunk(settings.depth_width)
    kept = features
    if networks.detector is not None:
        found = networks.detector(frame.color, settings.learned_count)
        kept = Features(found.xy, as_bytes(found.descriptors), points_at(found.xy, depth, camera))
    describe = networks.frame_descriptor
    return Keyframe(
        frame_index=frame.index,
        T_chunk_cam=reconstruction.T_chunk_cam[position].copy(),
        descriptor=describe(frame.color) if describe else describe_frame(features.descriptors),
        keypoints_xy=kept.xy,
        keypoint_descriptors=kept.descriptors,
        points_cam=kept.points_cam,
        depth_small=shrink_depth(depth, small, settings.noise),
        camera_small=(small.fx, small.fy, small.cx, small.cy),
        jpeg=b"",
    )


def _jpeg(color: NDArray[np.uint8], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return bytes(data.tobytes())

"""Pictures for `--debug`: masks with ids on frames, tracks over time, and the support of edges between chunks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.overlap_edge import MeasuredEdge
from list3r.frames.base import Camera, Frame
from list3r.frames.decoding.decode import decode_rgb
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import Keyframe, LocalLibrary
from list3r.reconstruction.base import Reconstruction


def draw_debug(
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    library: LocalLibrary,
    out_dir: Path,
    every: int = 20,
) -> list[Path]:
    """Write overlays of every `every`-th frame and the table of tracks to `out_dir`; returns the files written."""
    out_dir.mkdir(parents=True, exist_ok=True)
    written = []
    for position in range(0, len(frames), every):
        path = out_dir / f"masks_{frames[position].index:06d}.jpg"
        _write(path, draw_masks(frames[position], library))
        written.append(path)
    path = out_dir / f"tracks_{int(reconstruction.frame_indices[0]):06d}.png"
    _write(path, draw_tracks(library, reconstruction.frame_indices))
    return [*written, path]


def instance_color(number: int) -> tuple[int, int, int]:
    """A colour (RGB) that differs from those of neighbouring numbers."""
    hue = (number * 0.61803398875 + 0.17 * (number % 3)) % 1.0
    hsv = np.array([[[hue * 179.0, 150 + 105 * (number % 2), 255 - 60 * (number // 2 % 2)]]], np.uint8)
    r, g, b = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return r, g, b


def draw_masks(frame: Frame, library: LocalLibrary) -> NDArray[np.uint8]:
    """The frame with the masks of its instances, their outlines and ids. RGB, shape (H, W, 3)."""
    image = frame.color.astype(np.float32)
    marks = []
    for instance in library.instances:
        rows = np.flatnonzero(instance.track.frames == frame.index)
        if not len(rows):
            continue
        mask = decode_mask(instance.track.masks[int(rows[0])], instance.track.image_size)
        color = np.array(instance_color(instance.local_id), np.float32)
        image[mask] = 0.45 * image[mask] + 0.55 * color
        outline = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        image[outline] = color
        marks.append((instance, _inner_point(mask)))
    out = np.clip(image, 0, 255).astype(np.uint8)
    for instance, (x, y) in marks:
        text = f"{instance.local_id}{'s' if instance.structure else ''}"
        cv2.putText(out, text, (x - 8, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(out, text, (x - 8, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return out


def draw_tracks(library: LocalLibrary, frame_indices: NDArray[np.int64]) -> NDArray[np.uint8]:
    """One row for each instance, one column for each frame, brighter where more of it is seen. RGB."""
    row, column = 14, 6
    out = np.full((row * (len(library.instances) + 1), column * len(frame_indices) + 60, 3), 255, np.uint8)
    where = {int(index): k for k, index in enumerate(frame_indices)}
    for number, instance in enumerate(library.instances):
        color = np.array(instance_color(instance.local_id), np.float32)
        top = number * row
        cv2.putText(out, str(instance.local_id), (4, top + 11), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1)
        for index, share in zip(instance.track.frames, instance.track.visible_fraction, strict=True):
            x = 40 + column * where[int(index)]
            out[top + 1 : top + row - 1, x : x + column] = 255 - (255 - color) * (0.3 + 0.7 * share)
    return out


def write_support(
    measured: MeasuredEdge, keyframes: Iterable[Keyframe], camera: Camera, out_dir: Path, name: str | None = None
) -> Path:
    """Write the support of an edge to `out_dir`/edges/`name`.png (U-V for chunks U and V); returns the file.

    `keyframes` are those of both chunks; the shared one with most removed points, then most kept, is drawn; a grey one
    where none is shared or has a picture.
    """
    support = measured.support
    pictures = {k.frame_index: k.jpeg for k in keyframes if k.jpeg}
    frames = np.unique(support.frame)
    shown = [f for f in frames.tolist() if f in pictures] or frames.tolist()
    masks = [support.frame == frame for frame in shown]
    said = [(int((support.removed & m).sum()), int((support.kept & m).sum())) for m in masks]
    frame = shown[max(range(len(shown)), key=said.__getitem__)] if shown else -1
    color = decode_rgb(pictures[frame]) if frame in pictures else None
    if color is None or color.shape[:2] != (camera.height, camera.width):
        color = np.full((camera.height, camera.width, 3), 96, np.uint8)
    out = out_dir / "edges" / f"{name or f'{measured.edge.u}-{measured.edge.v}'}.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    _write(out, draw_support(color, measured, frame))
    return out


def draw_support(frame_color: NDArray[np.uint8], measured: MeasuredEdge, frame: int) -> NDArray[np.uint8]:
    """An overlap frame three times, as in the paper's figure of its supports. RGB, shape (h, w, 3).

    Left the frame; in the middle yellow the choice by confidence alone; right cyan the support of the edge and red
    points removed as moving. `frame` is the Frame.index of `frame_color` (H, W, 3).
    """
    support = measured.support
    here = support.frame == frame
    height, width = frame_color.shape[:2]
    zoom = max(1, round(320 / width))
    plain = np.ascontiguousarray(np.repeat(np.repeat(frame_color, zoom, axis=0), zoom, axis=1))
    alone, ours = plain.copy(), plain.copy()
    radius = max(1, round(zoom * width / 320))
    _dots(alone, support.pixel[here & support.confident], width, zoom, radius, (255, 220, 0))
    _dots(ours, support.pixel[here & support.kept], width, zoom, radius, (0, 230, 255))
    _dots(ours, support.pixel[here & support.removed], width, zoom, radius, (255, 30, 30))
    gap = np.full((height * zoom, 4, 3), 255, np.uint8)
    row = np.concatenate([plain, gap, alone, gap, ours], axis=1)
    strip = np.full((44, row.shape[1], 3), 255, np.uint8)
    edge = measured.edge
    verdict = "accepted" if edge.accepted else "rejected"
    for line, text in enumerate((f"{edge.kind} {edge.u}-{edge.v}, frame {frame}: {verdict}", edge.reason)):
        cv2.putText(strip, text, (6, 17 + 19 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([row, strip])


def _dots(
    image: NDArray[np.uint8],
    pixel: NDArray[np.int64],
    width: int,
    zoom: int,
    radius: int,
    color: tuple[int, int, int],
) -> None:
    for n in pixel.tolist():
        middle = (int((n % width + 0.5) * zoom), int((n // width + 0.5) * zoom))
        cv2.circle(image, middle, radius, color, -1, cv2.LINE_AA)


def _inner_point(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """The pixel of the mask farthest from its border."""
    padded = np.pad(mask.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
    y, x = np.unravel_index(int(np.argmax(distance)), distance.shape)
    return int(x) - 1, int(y) - 1


def _write(path: Path, rgb: NDArray[np.uint8]) -> None:
    cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))

"""Pictures of a local library: masks with ids on frames, and tracks over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.memory.masks import decode_mask
from list3r.memory.records import LocalLibrary
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


def _inner_point(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """The pixel of the mask farthest from its border."""
    padded = np.pad(mask.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
    y, x = np.unravel_index(int(np.argmax(distance)), distance.shape)
    return int(x) - 1, int(y) - 1


def _write(path: Path, rgb: NDArray[np.uint8]) -> None:
    cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))

"""Pictures for `--debug`: the two views of a revisit, side by side, with the points that support it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.decoding.decode import decode_rgb
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples, Keyframe

Image = NDArray[np.uint8]

_NEAR_FRAMES = 10
"""Frames around the other end whose points are shown."""
_AGREES = 0.08
"""Share of the depth within which a point agrees with the surface of the other chunk."""
_KEPT, _REMOVED = (0, 230, 255), (255, 30, 30)


def write_loop(
    edge: Edge,
    u: tuple[FrameSamples, Keyframe, Camera],
    v: tuple[FrameSamples, Keyframe, Camera],
    out_dir: Path,
) -> Path:
    """Write `out_dir`/edges/loop-U-V-FRAME-FRAME.png, the keyframe of either end; returns the file.

    Cyan points are on the surface of the other chunk, moved by the edge; red ones contradict it. `edge.frames` are
    the frames of the keyframes. Keyframes without a picture are grey.
    """
    assert edge.frames is not None
    name = f"loop-{edge.u}-{edge.v}-{edge.frames[0]}-{edge.frames[1]}.png"
    out = out_dir / "edges" / name
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), np.ascontiguousarray(draw_loop(edge, u, v)[..., ::-1]))
    return out


def draw_loop(edge: Edge, u: tuple[FrameSamples, Keyframe, Camera], v: tuple[FrameSamples, Keyframe, Camera]) -> Image:
    """Return both ends of a loop edge with the points of each that the other one sees. RGB, shape (h, w, 3)."""
    halves, descriptions = [], []
    for (mine, keyframe, camera), (other, far, _), S_other_mine in (
        (u, v, edge.S_v_u),
        (v, u, edge.S_v_u.inverse()),
    ):
        picture, zoom = _picture(keyframe, camera)
        pixel, agrees = compare(mine, keyframe.frame_index, other, far.frame_index, S_other_mine.inverse(), camera)
        radius = max(1, round(zoom * camera.width / 320))
        for n, good in zip(pixel.tolist(), agrees.tolist(), strict=True):
            at = int((n % camera.width + 0.5) * zoom), int((n // camera.width + 0.5) * zoom)
            cv2.circle(picture, at, radius, _KEPT if good else _REMOVED, -1, cv2.LINE_AA)
        halves.append(picture)
        descriptions.append(f"{int(agrees.sum())} of {len(agrees)}")
    height = max(h.shape[0] for h in halves)
    halves = [np.pad(h, ((0, height - h.shape[0]), (0, 0), (0, 0)), constant_values=255) for h in halves]
    row = np.concatenate([halves[0], np.full((height, 4, 3), 255, np.uint8), halves[1]], axis=1)
    strip = np.full((63, row.shape[1], 3), 255, np.uint8)
    verdict = "accepted" if edge.accepted else "rejected"
    frames = f"frames {u[1].frame_index} and {v[1].frame_index}"
    texts = (
        f"loop {edge.u}-{edge.v}, {frames}: {verdict}",
        edge.reason,
        f"points that agree: {descriptions[0]}, {descriptions[1]}",
    )
    for line, text in enumerate(texts):
        cv2.putText(strip, text, (6, 17 + 19 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([row, strip])


def compare(
    mine: FrameSamples, frame: int, other: FrameSamples, far: int, S_mine_other: Sim3, camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return samples of a frame that points of other chunk land near: their pixels, and whether depth agrees. (N,)."""
    none = np.zeros(0, np.int64), np.zeros(0, bool)
    at = int(np.searchsorted(mine.camera_frames, frame))
    if at == len(mine.camera_frames) or mine.camera_frames[at] != frame:
        return none
    T_cam_chunk = np.linalg.inv(mine.T_chunk_cam[at])
    here = mine.frame == frame
    there = np.abs(other.frame - far) <= _NEAR_FRAMES
    own = mine.points[here].astype(np.float64) @ T_cam_chunk[:3, :3].T + T_cam_chunk[:3, 3]
    came = S_mine_other.apply(other.points[there].astype(np.float64)) @ T_cam_chunk[:3, :3].T + T_cam_chunk[:3, 3]
    came = came[np.isfinite(came).all(axis=1) & (came[:, 2] > 1e-6)]
    pixel = mine.pixel[here].astype(np.int64)
    if not len(pixel) or not len(came):
        return none
    places = np.stack([pixel % camera.width, pixel // camera.width], axis=1).astype(np.float64)
    landed = came[:, :2] / came[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    reach = 0.7 * np.sqrt(camera.width * camera.height / len(pixel))
    apart = np.linalg.norm(places[:, None] - landed[None], axis=2)
    nearest = apart.argmin(axis=1)
    seen = (apart[np.arange(len(places)), nearest] <= reach) & (own[:, 2] > 0)
    off = np.abs(came[nearest, 2] - own[:, 2]) <= _AGREES * np.maximum(own[:, 2], 1e-9)
    return pixel[seen], off[seen]


def _picture(keyframe: Keyframe, camera: Camera) -> tuple[Image, int]:
    """Return the keyframe's picture, at least 320 px wide, and its magnification."""
    color = decode_rgb(keyframe.jpeg)
    if color is None or color.shape[:2] != (camera.height, camera.width):
        color = np.full((camera.height, camera.width, 3), 96, np.uint8)
    zoom = max(1, round(320 / camera.width))
    return np.ascontiguousarray(np.repeat(np.repeat(color, zoom, axis=0), zoom, axis=1)), zoom

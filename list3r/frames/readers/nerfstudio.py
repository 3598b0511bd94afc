"""nerfstudio's `transforms.json`: pictures, cameras and poses, with depth and masks where it names them.

Conventions as in nerfstudio's page "data conventions": poses are camera-to-world with OpenGL's axes, the world has z
up, pixel centres lie at whole numbers, depth is in millimetres unless `depth_unit_scale_factor` says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.base import Camera
from list3r.frames.layout import (
    IMAGE_ENDINGS,
    VARIES,
    FolderLayout,
    Optics,
    inside,
    natural_key,
    pose_matrix,
    read_json,
    varies_note,
)
from list3r.frames.listing import POSE, FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions, check_distortion, check_intrinsics
from list3r.frames.recordings.axes import OPENGL_TO_OPENCV
from list3r.memory.core.errors import OptionError, SourceError

_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "")
_FISHEYE = "OPENCV_FISHEYE"
_MOST_LOOKED_AT = 20_000
_LENS = {False: ("k1", "k2", "p1", "p2", "k3"), True: ("k1", "k2", "k3", "k4")}
"""Names of the lens's numbers, of a pinhole camera and of a fisheye."""


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without `transforms.json`. Raises `SourceError` for one that cannot be used."""
    path = root / "transforms.json"
    if not path.is_file():
        return None
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(content, dict) or not isinstance(frames, list) or not frames:
        raise SourceError(f"{path} names no frames; is it nerfstudio's?")
    rows = sorted((_row(path, number, frame) for number, frame in enumerate(frames)), key=_order)
    model = str(rows[0].get("camera_model", content.get("camera_model", ""))).upper()
    if model not in (*_PINHOLE, _FISHEYE):
        raise SourceError(f"{path} states a {model} camera; undistort the pictures first, for instance with COLMAP")
    turned = _written_by_columns(rows)
    files = FrameFiles(_file(root, path, row, turned) for row in rows)
    if rows and not len(files.that_hold(POSE)) and any("transform_matrix" in row for row in rows):
        raise SourceError(
            f"{path}: the transform_matrix of no frame is a rigid motion (4x4, row by row); fix it, or use --kind "
            "images to take colour alone"
        )
    fisheye = model == _FISHEYE and options.distortion is None
    intrinsics, distortion, size, spread = _camera(path, content, rows, options, _LENS[fisheye])
    notes = ["poses and cameras of transforms.json" + (", matrices column by column" if turned else "")]
    if spread > VARIES:
        straight = not any(f.depth for f in files) or not (distortion or fisheye)
        carried = options.intrinsics is None and straight
        notes.append(varies_note(spread, carried))
        if carried:
            files, distortion, fisheye = FrameFiles(_with_lenses(files, content, rows, fisheye)), (), False
    if left := _not_named(files):
        notes.append(f"{left} pictures beside those of transforms.json are not named in it and not read")
    units = _units_per_metre(path, content)
    optics = Optics(intrinsics, distortion, depth_scale=units, intrinsics_size=size, fisheye=fisheye)
    if intrinsics is not None and not distortion and not fisheye:  # depth of another size has the same camera
        optics = Optics(intrinsics, depth_scale=units, intrinsics_size=size, shares_view=True)
    return FolderLayout(
        "nerfstudio",
        files,
        optics,
        "color",
        intrinsics,
        tuple(notes),
        upright_tags=False,
        poses_metric=_metric(content, files),
    )


def _row(path: Path, number: int, frame: object) -> Mapping[str, Any]:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise SourceError(f"{path}: frame {number} names no file_path; fix or remove it")
    return frame


def _order(row: Mapping[str, Any]) -> list[tuple[int, int, str]]:
    return natural_key(row["file_path"])


def _metric(content: Mapping[str, Any], files: Sequence[FrameFile]) -> bool:
    """Whether poses are in metres: recorders with depth write them so, COLMAP's have a unit of their own."""
    return any(f.depth for f in files) or bool(content.get("is_metric"))


def _units_per_metre(path: Path, content: Mapping[str, Any]) -> float:
    unit_m = content.get("depth_unit_scale_factor", 0.001)
    if not isinstance(unit_m, int | float) or not unit_m > 0:
        raise SourceError(f"{path}: depth_unit_scale_factor {unit_m!r} is not a positive number of metres; fix it")
    return 1.0 / unit_m


def _written_by_columns(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the matrices have their translations in the last row."""
    found = [_numbers(row.get("transform_matrix")) for row in rows]
    whole = [v for v in found if len(v) == 16 and np.isfinite(v).all()]
    return all(v[3] == v[7] == v[11] == 0 and v[15] == 1 for v in whole) and any(any(v[12:15]) for v in whole)


def _file(root: Path, path: Path, row: Mapping[str, Any], turned: bool) -> FrameFile:
    """The files of a frame. Raises `SourceError` for names that lead out of the folder."""
    color = inside(root, row["file_path"], path)
    if not color.suffix:
        color = next((c for c in (color.with_suffix(s) for s in (".png", ".jpg", ".jpeg")) if c.is_file()), color)
    depth, mask = (row.get(name) for name in ("depth_file_path", "mask_path"))
    matrix = _numbers(row.get("transform_matrix"))
    T_world_opengl = pose_matrix(np.reshape(matrix, (4, 4)).T.ravel() if turned and len(matrix) == 16 else matrix)
    return FrameFile(
        color,
        inside(root, depth, path) if isinstance(depth, str) and depth else None,
        T_source_camera=None if T_world_opengl is None else T_world_opengl @ OPENGL_TO_OPENCV,
        mask=inside(root, mask, path) if isinstance(mask, str) and mask else None,
    )


def _not_named(files: Sequence[FrameFile]) -> int:
    """Return how many pictures lie beside those of the frames; 0 of so many frames that a look takes long."""
    if len(files) > _MOST_LOOKED_AT:
        return 0
    named = {file.color for file in files if isinstance(file.color, Path)}
    there = {p for folder in {p.parent for p in named} if folder.is_dir() for p in folder.iterdir()}
    other = {file.mask for file in files} | {file.depth for file in files}
    return sum(p.suffix.lower() in IMAGE_ENDINGS for p in there - named - other)


def _numbers(matrix: object) -> list[float]:
    """The numbers of nested lists, none where they are not numbers."""
    try:
        return [float(v) for v in np.asarray(matrix, dtype=np.float64).ravel()]
    except (TypeError, ValueError):
        return []


def _camera(
    path: Path,
    content: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    options: SourceOptions,
    names: Sequence[str],
) -> tuple[Intrinsics | None, tuple[float, ...], tuple[int, int] | None, float]:
    """The camera, for which (height, width) it is stated, and by what share focal lengths of frames differ."""
    known = [v for v in (_stated({**content, **row}, names) for row in rows) if v is not None]
    if options.intrinsics is not None or not known:
        return options.intrinsics, options.distortion or (), None, 0.0
    fx, fy, cx, cy, width, height, *lens = np.median(np.array(known), axis=0).tolist()
    try:
        intrinsics, distortion = check_intrinsics([fx, fy, cx, cy]), check_distortion(lens)
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None
    size = (round(height), round(width)) if width >= 1 and height >= 1 else None
    return intrinsics, distortion, size, float(np.ptp([v[0] for v in known]) / fx)


def _with_lenses(
    files: Iterable[FrameFile], content: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], fisheye: bool
) -> tuple[FrameFile, ...]:
    """The files, each with the camera that its frame states for pictures of a size."""
    out = []
    for file, row in zip(files, rows, strict=True):
        stated = _stated({**content, **row}, _LENS[fisheye])
        if stated is not None and min(stated[4:6]) >= 1:
            width, height = round(stated[4]), round(stated[5])
            fx, fy, cx, cy = stated[:4]
            file = replace(file, lens=Camera(width, height, fx, fy, cx, cy, tuple(stated[6:]), fisheye))
        out.append(file)
    return tuple(out)


def _stated(values: Mapping[str, Any], names: Sequence[str]) -> tuple[float, ...] | None:
    """fx, fy, cx, cy, width, height and the lens of a frame, None where its focal length is not stated."""
    try:
        width, height = float(values.get("w", 0)), float(values.get("h", 0))
        fx = float(values["fl_x"]) if "fl_x" in values else 0.5 * width / np.tan(0.5 * float(values["camera_angle_x"]))
        fy = float(values.get("fl_y", fx))
        cx, cy = float(values.get("cx", (width - 1) / 2)), float(values.get("cy", (height - 1) / 2))
        lens = [float(values.get(name, 0.0)) for name in names]
    except (KeyError, TypeError, ValueError):
        return None
    return (fx, fy, cx, cy, width, height, *lens)

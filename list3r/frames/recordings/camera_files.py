"""The camera that a file beside pictures states: JSON of Open3D and others, OpenCV's YAML, or a matrix as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.layout import read_calibration, read_json, read_numbers, read_text
from list3r.frames.options import Intrinsics, check_distortion, check_intrinsics, intrinsics_of_matrix
from list3r.memory.core.errors import OptionError, SourceError

_JSON = (
    *("camera_intrinsic.json", "camera_intrinsics.json", "intrinsic.json", "intrinsics.json", "camera.json"),
    *("cam_params.json", "calibration.json", "metadata.json"),
)
_TEXT = ("camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsics.txt", "intrinsic.txt", "K.txt")
_YAML = ("camera.yaml", "camera.yml", "calibration.yaml", "calibration.yml", "rtabmap_calib.yaml")
_YAML_FOLDERS = ("calib", "rtabmap_calib")
_MATRICES = ("intrinsic_matrix", "camera_matrix", "K", "intrinsics", "intrinsic")
_FOUR = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("fl_x", "fl_y", "cx", "cy"))
_SCALES = ("depth_scale", "scale", "png_depth_scale", "depth_factor")


@dataclass(frozen=True)
class StatedCamera:
    """What a file says of the camera of the pictures beside it."""

    name: str
    """The file or folder, as a person sees it in the recording."""
    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None
    """(height, width) of the pictures that it is stated for."""
    depth_scale: float | None = None
    """Stored depth units per metre."""


def read_camera(root: Path) -> StatedCamera | None:
    """Return the camera that a file in a folder states, None where there is no such file.

    Raises `SourceError` for one that states none, but for `metadata.json`, which any program may write.
    """
    written = read_calibration(root)
    if written is not None:
        return StatedCamera("calibration.txt", *written)
    for name in (*_JSON, *_TEXT, *_YAML, *_YAML_FOLDERS):
        path = root / name
        if name in _YAML_FOLDERS and path.is_dir():
            path = next(iter(sorted(path.glob("*.y*ml"))), root / "none")
        if not path.is_file():
            continue
        try:
            found = _of_file(path, name)
        except (KeyError, TypeError, ValueError, IndexError, OptionError):
            found = None
        if found is None and name != "metadata.json":
            raise SourceError(f"{path} states no camera with fx, fy, cx, cy; fix or remove it, or give --intrinsics")
        if found is not None:
            return found
    return None


def _of_file(path: Path, name: str) -> StatedCamera | None:
    if path.suffix == ".json":
        content = read_json(path)
        return _of_table(name, content) if isinstance(content, dict) else None
    if path.suffix == ".txt":
        numbers = [v for row in read_numbers(path) for v in row]
        return StatedCamera(name, check_intrinsics(numbers) if len(numbers) == 4 else intrinsics_of_matrix(numbers))
    text = read_text(path)
    lens = [v for v in _list(text, "distortion_coefficients") if v]
    size = re.findall(r"^image_(?:width|height):\s*(\d+)", text, re.MULTILINE)
    width, height = map(int, size) if len(size) == 2 else (0, 0)
    return StatedCamera(
        name,
        intrinsics_of_matrix(_list(text, "camera_matrix")),
        check_distortion(_list(text, "distortion_coefficients")) if lens else (),
        (height, width) if width and height else None,
    )


def _of_table(name: str, content: Mapping[str, Any]) -> StatedCamera | None:
    """A camera of JSON, at its top or in the first table in it that has one."""
    values = next(([content[k] for k in names] for names in _FOUR if all(k in content for k in names)), None)
    matrix: Any = next((content[k] for k in _MATRICES if isinstance(content.get(k), list)), None)
    if values is None and matrix is None:
        inner = (_of_table(name, v) for v in content.values() if isinstance(v, dict))
        return next((c for c in inner if c is not None), None)
    if values is None and np.size(matrix) == 4:
        values = matrix
    numbers = [float(v) for v in values or np.ravel(matrix)]
    intrinsics = check_intrinsics(numbers) if values else intrinsics_of_matrix(numbers)
    width, height = (int(content.get(a, content.get(b, 0))) for a, b in (("width", "w"), ("height", "h")))
    lens = content.get("distortion", content.get("distortion_coefficients", content.get("coeffs")))
    scale = next((float(content[k]) for k in _SCALES if isinstance(content.get(k), int | float)), None)
    return StatedCamera(
        name,
        intrinsics,
        check_distortion([float(v) for v in lens]) if isinstance(lens, list) else (),
        (height, width) if width and height else None,
        scale if scale and scale > 0 else None,
    )


def _list(text: str, name: str) -> list[float]:
    """The numbers of a matrix of OpenCV's YAML."""
    found = re.search(rf"{name}:.*?data:\s*\[([^\]]*)\]", text, re.DOTALL)
    return [float(word) for word in found[1].split(",") if word.strip()] if found else []

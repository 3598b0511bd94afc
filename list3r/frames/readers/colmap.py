"""A model of COLMAP, text or binary, beside its pictures: `sparse/0`, `sparse` or the folder itself, and `images`.

Read by pycolmap. Poses are world-to-camera there, and pixel centres lie at halves; both are changed to ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.base import Camera
from list3r.frames.layout import IMAGE_ENDINGS, FolderLayout, FrameFile, Optics, inside, natural_key, usual_camera
from list3r.frames.options import SourceOptions, check_distortion, check_intrinsics
from list3r.memory.errors import OptionError, SourceError

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_FOLDERS = ("images", "rgb", "color", ".")


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without a model. Raises `SourceError` for a model that cannot be read."""
    model = next((root / p for p in _PLACES if _is_model(root / p)), None)
    if model is None:
        return None
    from pycolmap import Reconstruction

    try:
        found = Reconstruction(str(model))
    except (RuntimeError, ValueError, OSError) as error:
        raise SourceError(f"{model} is no model of COLMAP that can be read ({str(error).splitlines()[0]})") from None
    posed = {image.name: image for image in found.images.values() if image.has_pose}
    folder = next((root / f for f in _FOLDERS if any((root / f / name).is_file() for name in posed)), None)
    if folder is None:
        raise SourceError(f"{model} poses {len(posed)} pictures, none of which lies in {root / 'images'}")
    names = sorted({*posed, *_pictures(folder)}, key=natural_key)
    cameras = {posed[name].camera_id for name in sorted(posed, key=natural_key)}
    lenses = {k: _lens(found.cameras[k], model) for k in sorted(cameras)}
    shared = usual_camera(list(lenses.values()))
    own = {n: lenses[posed[n].camera_id] for n in posed} if len(lenses) > 1 and options.intrinsics is None else {}
    files = tuple(
        FrameFile(inside(folder, n, model), T_source_camera=_pose(posed.get(n)), lens=own.get(n)) for n in names
    )
    intrinsics = (shared.fx, shared.fy, shared.cx, shared.cy)
    notes = [
        f"camera and poses of {model.relative_to(root) if model != root else model.name}, lengths as the model has"
    ]
    if len(cameras) > 1:
        notes.append(f"the model has {len(cameras)} cameras; every picture is carried to their median")
    size = (shared.height, shared.width)
    optics = Optics(intrinsics, shared.distortion, intrinsics_size=size, fisheye=shared.fisheye)
    if options.intrinsics is not None:
        optics = Optics(options.intrinsics, options.distortion or ())
    return FolderLayout(
        "colmap", files, optics, "color", intrinsics, tuple(notes), upright_tags=False, poses_metric=False
    )


def _is_model(folder: Path) -> bool:
    return any(all((folder / f"{n}{end}").is_file() for n in ("cameras", "images")) for end in (".bin", ".txt"))


def _pictures(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_ENDINGS and not p.name.startswith(".")]


def _pose(image: Any) -> Any:
    """Camera-to-world, None for a picture that is not posed. Shape (4, 4)."""
    if image is None:
        return None
    T = np.eye(4)
    T[:3] = image.cam_from_world().inverse().matrix()
    return T


def _lens(camera: Any, model: Path) -> Camera:
    """The camera with OpenCV's lens, for pixel centres at whole numbers. Raises `SourceError`."""
    lens = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4}
    name = camera.model.name
    if name not in lens:
        raise SourceError(f"{model} has a {name} camera; undistort its pictures first (colmap image_undistorter)")
    try:
        centre = (camera.principal_point_x - 0.5, camera.principal_point_y - 0.5)
        intrinsics = check_intrinsics([camera.focal_length_x, camera.focal_length_y, *centre])
        values = [float(v) for v in camera.params[len(camera.params) - lens[name] :]] if lens[name] else []
        distortion = check_distortion(values) if values else ()
    except OptionError as error:
        raise SourceError(f"{model}: {error}") from None
    return Camera(int(camera.width), int(camera.height), *intrinsics, distortion, name == "OPENCV_FISHEYE")

"""A model of COLMAP, text or binary, beside its pictures: `sparse/0`, `sparse` or the folder itself, and `images`.

Read by pycolmap. Poses are world-to-camera there, and pixel centres lie at halves; both are changed to ours. The
cameras of a rig (`rigs`, `frames`) come one after the other, each where the rig holds it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.layout import (
    IMAGE_ENDINGS,
    FolderLayout,
    Optics,
    inside,
    natural_key,
    pose_matrix,
    usual_camera,
)
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, check_distortion, check_intrinsics
from list3r.frames.recordings.colmap_files import frames_are_whole, written_sizes
from list3r.memory.core.errors import OptionError, SourceError, first_line

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_FOLDERS = ("images", "rgb", "color", ".")


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without a model. Raises `SourceError` for a model that cannot be read."""
    model = next((root / p for p in _PLACES if _is_model(root / p)), None)
    if model is None:
        return None
    found, poses = _read(model)
    posed = {image.name: image for image in found.images.values() if image.name in poses}
    folder = next((root / f for f in _FOLDERS if any((root / f / name).is_file() for name in posed)), None)
    if folder is None:
        raise SourceError(f"{model} poses {len(posed)} pictures, none of which lies in {root / 'images'}")
    names = sorted({*posed, *_pictures(folder)}, key=natural_key)
    rigged = _rigged(found)
    if rigged:
        names.sort(key=lambda name: rigged.index(posed[name].camera_id) if name in posed else len(rigged))
    cameras = {posed[name].camera_id for name in sorted(posed, key=natural_key)}
    lenses = {k: _lens(found.cameras[k], model) for k in sorted(cameras)}
    shared = usual_camera(list(lenses.values()))
    own = {n: lenses[posed[n].camera_id] for n in posed} if len(lenses) > 1 and options.intrinsics is None else {}
    files = FrameFiles(
        FrameFile(inside(folder, n, model), T_source_camera=poses.get(n), lens=own.get(n)) for n in names
    )
    intrinsics = (shared.fx, shared.fy, shared.cx, shared.cy)
    notes = [
        f"camera and poses of {model.relative_to(root) if model != root else model.name}, lengths as the model has"
    ]
    if rigged:
        notes.append(f"{len(rigged)} cameras of rigs, one after the other, each where its rig holds it")
    others = sorted(p.name for p in model.parent.iterdir() if p != model and _is_model(p)) if model.name == "0" else []
    if others:
        notes.append(f"the model poses {len(posed)} pictures; not read: the models {', '.join(others)} beside it")
    if len(cameras) > 1:
        notes.append(f"the model has {len(cameras)} cameras; all pictures are resampled to their median")
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


def _read(model: Path) -> tuple[Any, dict[str, NDArray[np.float64]]]:
    """The model, and camera-to-world (4, 4) of its posed pictures by name. Raises `SourceError`."""
    from pycolmap import Reconstruction

    apart = f"{model}: its cameras, rigs, frames and images do not fit together; copy all its files again"
    try:
        if not frames_are_whole(model / "frames.bin"):
            raise SourceError(apart)
        found = Reconstruction(str(model))
        images = [image for image in found.images.values() if image.has_pose]
        stated = {image.name: image.cam_from_world().inverse().matrix() for image in images}
    except IndexError:
        raise SourceError(apart) from None
    except (RuntimeError, ValueError, OSError) as error:
        reason = first_line(error)
        if "optional" in reason:
            reason = "a rig does not say where it holds one of its cameras; colmap rig_configurator calibrates it"
        raise SourceError(f"{model} is not a model of COLMAP that can be read ({reason})") from None
    poses = {name: pose_matrix(rows.ravel().tolist()) for name, rows in stated.items()}
    wrong = [name for name, T in poses.items() if T is None]
    if wrong:
        raise SourceError(f"{model}: the pose of {wrong[0]} is not a rigid motion; copy the model again")
    for name, size in written_sizes(found).items():
        if (model / name).is_file() and (model / name).stat().st_size != size:
            raise SourceError(apart)
    return found, {name: T for name, T in poses.items() if T is not None}


def _rigged(found: Any) -> list[int]:
    """The cameras of rigs that hold several, in the rigs' order; empty where none does."""
    rigs = [rig for _, rig in sorted(found.rigs.items())]
    if all(rig.num_sensors() < 2 for rig in rigs):
        return []
    held = [[rig.ref_sensor_id, *sorted(rig.sensor_ids(), key=lambda s: s.id)] for rig in rigs]
    return list(dict.fromkeys(sensor.id for sensors in held for sensor in sensors))


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

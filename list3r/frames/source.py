"""Opens whatever is at a path: an explicit table of readers, tried in order."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from list3r.frames.base import Camera, FrameSource, Listing, SourceInfo
from list3r.frames.beside import depth_beside, listed, role_of
from list3r.frames.folder import FolderSource
from list3r.frames.layout import IMAGE_ENDINGS, FolderLayout
from list3r.frames.live.addresses import is_stream, without_secrets
from list3r.frames.options import SourceOptions
from list3r.frames.readers import (
    aria,
    colmap,
    euroc,
    images,
    lerobot,
    nerfstudio,
    replica,
    rosbag,
    scannet,
    seven_scenes,
    spool,
    tum,
)
from list3r.frames.readers.phones import arkitscenes, polycam, record3d, scannerapp, scannetpp, stray
from list3r.memory.core.errors import OptionError, SourceError

__all__ = ["FOLDERS", "SourceOptions", "check_bad_share", "open_source", "require_camera"]

FOLDERS: dict[str, Callable[[Path, SourceOptions], FolderLayout | None]] = {
    "record3d": record3d.find,
    "polycam": polycam.find,
    "scannerapp": scannerapp.find,
    "arkitscenes": arkitscenes.find,
    "scannet": scannet.find,
    "euroc": euroc.find,
    "nerfstudio": nerfstudio.find,
    "live": spool.find,
    "7scenes": seven_scenes.find,
    "tum": tum.find,
    "replica": replica.find,
    "colmap": colmap.find,
    "images": images.find,
}
"""Readers of folders, the most particular first: the layout of a folder, or None for one of another kind."""
FILES: dict[str, tuple[str, Callable[[Path, SourceOptions], FolderLayout]]] = {
    ".r3d": ("record3d", record3d.find_file),
    ".sens": ("scannet", scannet.find_file),
}
"""Readers of files that hold many pictures, by their ending: the kind, and what lists the frames."""

_VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp")
_OTHER_PICTURES = (".heic", ".heif", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf")
_SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
_WANTED = (
    "give a video file, a recording of Record3D (.r3d), Stray Scanner, 3D Scanner App, Polycam or ScanNet (.sens), a "
    "ROS bag or mcap, a recording of Aria (.vrs), a data set of LeRobot, "
    "a folder in ARKitScenes, nerfstudio (transforms.json), COLMAP, 7-Scenes, TUM RGB-D or Replica layout, or of images"
)


def open_source(path: str | Path, options: SourceOptions | None = None, listing: Listing | None = None) -> FrameSource:
    """Return the frames at `path`, which can be opened again in another process with the same arguments.

    A recording that has to be read through to know its frames tells `listing` how far it is.
    Raises `SourceError` for what is not a source, `OptionError` for options that do not fit it.
    """
    options = options or SourceOptions()
    if is_stream(str(path)):
        shown = without_secrets(str(path))
        raise SourceError(f"{shown} is live and has no frames of its own yet: `list3r build` follows it into a memory")
    if str(path) == "":
        raise SourceError("the name of the source is empty; give a video file or a folder")
    root = Path(path).expanduser()
    if options.more:
        return _open_joined([root, *(Path(p).expanduser() for p in options.more)], options)
    try:
        if not root.exists():
            raise SourceError(f"{root} does not exist; check the path")
        if options.kind in ("auto", "rosbag") and os.access(root, os.R_OK) and rosbag.is_recording(root):
            return rosbag.BagSource(root, options, listing)
        if options.kind in ("auto", "lerobot") and lerobot.is_dataset(root):
            return lerobot.LeRobotSource(root, options)
        if options.kind in ("auto", "aria") and aria.is_recording(root):
            if not os.access(root, os.R_OK) or (root.is_file() and root.stat().st_size == 0):
                raise SourceError(f"{root} is empty or cannot be read; check the copy and its permissions")
            return aria.AriaSource(root, options)
        if options.topics or options.episode is not None:
            name = "--topics is for ROS recordings and" if options.topics else "--episode is for"
            raise OptionError(f"{name} LeRobot data sets, and {root} is none; leave it out")
        return _open_folder(root, options) if root.is_dir() else _open_file(root, options)
    except PermissionError as error:
        found = root if not os.access(root, os.R_OK) else error.filename or root
        raise SourceError(f"{found} cannot be read; check its permissions") from None


def _open_joined(paths: list[Path], options: SourceOptions) -> FrameSource:
    """Open several video files as one. Raises `SourceError` for anything else."""
    for path in paths:
        if not path.is_file() or path.suffix.lower() in (*IMAGE_ENDINGS, *FILES):
            raise SourceError(f"{path} is not a video file; only video files of one recording can be given together")
        if not os.access(path, os.R_OK) or path.stat().st_size == 0:
            raise SourceError(f"{path} is empty or cannot be read; check the copy and its permissions")
    from list3r.frames.readers.joined import JoinedVideos

    return JoinedVideos(paths, options)


def require_camera(info: SourceInfo) -> Camera:
    """Return the source's camera. Raises `SourceError` when its intrinsics are unknown."""
    if info.camera is None:
        raise SourceError(f"{info.path}: the camera's intrinsics are unknown; give --intrinsics fx,fy,cx,cy in px")
    return info.camera


def check_bad_share(bad: int, total: int, reason: str = "") -> None:
    """Raises `SourceError` when more than half of the frames could not be used, with the `reason` of one of them."""
    if bad * 2 > total:
        why = f" ({reason})" if reason else ""
        raise SourceError(f"{bad} of {total} frames cannot be used{why}; is the copy of the source complete?")


def _open_folder(root: Path, options: SourceOptions) -> FrameSource:
    if not os.access(root, os.R_OK | os.X_OK):
        raise SourceError(f"{root} cannot be read; check its permissions")
    if not any(root.iterdir()):
        raise SourceError(f"{root} is an empty folder; give one with frames, or a video file")
    if options.kind == "video":
        raise SourceError(f"{root} is a folder, not a video; name the video file in it or leave out the kind")
    if options.kind in ("auto", "stray") and stray.is_recording(root):
        return stray.open_recording(root, options)
    if options.kind in ("auto", "scannetpp") and scannetpp.is_recording(root):
        return scannetpp.open_scan(root, options)
    splits = [name for name in _SPLITS if (root / name).is_file()]
    if options.kind in ("auto", "nerfstudio") and splits and not (root / "transforms.json").is_file():
        raise SourceError(
            f"{root} states its poses in {', '.join(splits)}; put their frames into one transforms.json, or use --kind "
            "images to take colour alone"
        )
    for kind, find in FOLDERS.items():
        if options.kind in ("auto", kind):
            layout = find(root, options)
            if layout is not None and layout.files:
                _check_nothing_ignored(root, kind, options)
                return FolderSource(root, layout, options)
    videos = sorted(p.name for p in root.iterdir() if p.suffix.lower() in _VIDEO_ENDINGS)
    if videos:
        raise SourceError(f"{root} is a folder with the video {videos[0]} in it; give the video: {root / videos[0]}")
    if pictures := next((p.name for p in sorted(root.iterdir()) if p.suffix.lower() in _OTHER_PICTURES), None):
        raise SourceError(
            f"{root} holds pictures like {pictures}, which cannot be read here; convert them to JPEG or PNG"
        )
    folders = [p for p in sorted(root.iterdir()) if p.is_dir() and role_of(p.name) in ("color", None)]
    inside = [p for p in folders if listed(p, IMAGE_ENDINGS)]
    if inside and options.kind in ("auto", "images"):
        names = ", ".join(p.name for p in inside[:4]) + (" and more" if len(inside) > 4 else "")
        what = f"its folder {names} does" if len(inside) == 1 else f"its folders {names} do"
        raise SourceError(f"{root} holds no images itself, but {what}; give {inside[0]}")
    problem = "in no known layout" if options.kind == "auto" else f"not in the {options.kind} layout"
    raise SourceError(f"{root} is {problem}; {_WANTED}")


def _check_nothing_ignored(root: Path, kind: str, options: SourceOptions) -> None:
    """Raise `SourceError` where a kind that was asked for would ignore depth or poses that another kind reads."""
    if options.kind == "auto":
        return
    if kind in ("images", "colmap") and stray.is_recording(root):
        raise SourceError(
            f"{root} is a recording of Stray Scanner with depth and poses; leave out --kind, or use stray"
        )
    for other, find in FOLDERS.items():
        if other in (kind, "images", "colmap") or kind not in ("images", "colmap"):
            continue
        found = find(root, options)
        if found is not None and found.files:
            raise SourceError(f"{root} is of the kind {other}, and {kind} would ignore its depth or poses; use {other}")


def _open_file(path: Path, options: SourceOptions) -> FrameSource:
    if not os.access(path, os.R_OK):
        raise SourceError(f"{path} cannot be read; check its permissions")
    kind, find = FILES.get(path.suffix.lower(), ("video", None))
    if options.kind not in ("auto", kind):
        raise SourceError(f"{path} is a file, but the {options.kind} layout is a folder; name the folder")
    if path.suffix.lower() in IMAGE_ENDINGS:
        raise SourceError(f"{path} is one image; name the folder of images or a video")
    if path.is_file() and path.stat().st_size == 0:
        raise SourceError(f"{path} is empty (0 bytes); is the copy complete?")
    if not path.is_file():
        raise SourceError(f"{path} is not a regular file; {_WANTED}")
    if find is not None:
        return FolderSource(path, find(path, options), options)
    if options.kind == "auto" and stray.is_recording(path.parent) and path.name == "rgb.mp4":
        raise SourceError(
            f"{path} is the video of a Stray Scanner recording, whose depth and poses would be lost; give the folder "
            f"{path.parent}, or use --kind video to take its colour alone"
        )
    if options.kind == "auto" and (depth := depth_beside(path)):
        raise SourceError(
            f"{path} has depth beside it, {depth}, which would be lost; write its pictures beside the depth (ffmpeg -i "
            f"{path.name} rgb/%06d.png) and give the folder of both, or use --kind video to take colour alone"
        )
    from list3r.frames.readers.video import VideoSource

    return VideoSource(path, options)

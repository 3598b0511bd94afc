"""Write the frames of any source in a layout that other programs read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from list3r.frames.base import BadFrame, FrameSource
from list3r.frames.options import SourceOptions
from list3r.frames.pose_agreement import disagreements
from list3r.frames.source import check_bad_share, open_source, require_camera
from list3r.frames.writers.base import SequenceWriter
from list3r.frames.writers.folders import ColmapWriter, ReplicaWriter, TransformsWriter, TumWriter
from list3r.frames.writers.record3d import Record3dWriter
from list3r.memory.core.errors import ExportError, SourceError, check_choice
from list3r.memory.core.records import JsonFields

LAYOUTS: dict[str, type[SequenceWriter]] = {
    "tum": TumWriter,
    "transforms": TransformsWriter,
    "colmap": ColmapWriter,
    "replica": ReplicaWriter,
    "r3d": Record3dWriter,
}
"""All that `--to` knows."""


@dataclass(frozen=True)
class Converted(JsonFields):
    """What was written."""

    layout: str
    path: str
    frames: int
    """Frames that were written."""
    with_depth: int
    posed: int
    bad: int
    """Frames that could not be decoded."""
    notes: tuple[str, ...]
    """What the layout does not hold, one sentence each."""


def convert(
    source: str | Path,
    layout: str,
    folder: str | Path,
    options: SourceOptions | None = None,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> Converted:
    """Write a source into a new folder, whole or not at all.

    Pictures are written without distortion, depth on their pixels, poses as the source gives them. Raises
    `OptionError`, `SourceError`, and `ExportError` for a folder that exists or cannot be written.
    """
    check_choice("--to", layout, LAYOUTS)
    target, how = Path(folder), LAYOUTS[layout]
    opened = open_source(source, options)
    (options or SourceOptions()).check_fits(opened.info)
    _check(opened, how, layout, target)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        writer = how(temporary, require_camera(opened.info), opened.info.fps)
        report = _write(opened, writer, layout, target, progress)
        temporary.rename(target)
    except OSError as error:
        raise ExportError(f"{target} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return replace(report, notes=(*report.notes, *disagreements(opened)))


def _check(opened: FrameSource, how: type[SequenceWriter], layout: str, target: Path) -> None:
    if target.exists():
        raise ExportError(f"{target} already exists; name another folder or remove it first")
    if not target.parent.is_dir():
        raise ExportError(f"the folder {target.parent} does not exist; create it first")
    require_camera(opened.info)
    if not how.unposed and not opened.info.has_poses:
        raise SourceError(f"{opened.info.path} has no poses, which {layout} needs; use tum, colmap or r3d")


def _write(
    opened: FrameSource, writer: SequenceWriter, layout: str, target: Path, progress: Callable[[int, int], None]
) -> Converted:
    count = opened.info.frame_count
    written = with_depth = posed = bad = left_out = far = 0
    reason = ""
    for done, frame in enumerate(opened.read(0, count), start=1):
        progress(done, count)
        if isinstance(frame, BadFrame):
            bad, reason = bad + 1, reason or frame.reason
            continue
        if frame.T_source_cam is None and not writer.unposed:
            left_out += 1
            continue
        writer.add(frame)
        written, with_depth = written + 1, with_depth + (frame.depth is not None)
        posed += frame.T_source_cam is not None
        far += frame.depth is not None and bool(frame.depth.max(initial=0.0) > writer.most_depth_m)
    check_bad_share(bad, count, reason)
    if not written:
        raise SourceError(f"{opened.info.path} has no frame with a pose, which {layout} needs; use tum, colmap or r3d")
    writer.close()
    notes = []
    if with_depth and not writer.depth:
        notes.append(f"{layout} holds no depth: it was left out")
    if left_out:
        notes.append(f"{left_out} frames without a pose were left out")
    if far:
        notes.append(f"depth beyond {writer.most_depth_m:g} m does not fit into {layout}: unknown in {far} frames")
    return Converted(layout, str(target), written, with_depth * writer.depth, posed, bad, tuple(notes))

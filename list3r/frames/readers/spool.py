"""Pictures of a live camera as they were kept: `frames.txt` has a line for each, seconds and the name of its file.

Those of Record3D over USB have depth and confidence beside them and qx qy qz qw tx ty tz in their line; `metadata` is
that of a recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from list3r.frames.layout import FolderLayout, Optics, inside, read_json, read_lines
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions
from list3r.frames.readers.phones.record3d import METADATA, PhoneCamera, pose_of_row
from list3r.memory.core.errors import SourceError

LIST = "frames.txt"
FOLDER = "rgb"


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None for another folder. A last line that is half written does not count."""
    path = root / LIST
    if not path.is_file():
        return None
    if not (root / METADATA).is_file():
        return FolderLayout("live", FrameFiles(_files(root, path)), Optics(options.intrinsics))
    content = read_json(root / METADATA)
    if not isinstance(content, dict):
        raise SourceError(f"{root / METADATA} is not a table; what was kept of the stream is damaged")
    camera, sure = PhoneCamera.of(root, content), content.get("confidence") is True
    first = next((file.T_source_camera for file in _files(root, path, camera, sure)), None)
    files = _files(root, path, camera, sure)
    return camera.layout("live", files, first, True, options, ["camera and poses of Record3D (ARKit)"])


def _files(root: Path, path: Path, camera: PhoneCamera | None = None, sure: bool = False) -> Iterator[FrameFile]:
    """Frames of a list; those of a `camera` have depth, and where the sensor tells how `sure` it is, confidence."""
    for number, line in enumerate(read_lines(path, whole=True), start=1):
        words = line.split()
        try:
            color, time_s, pose = inside(root, words[1], path), float(words[0]), [float(v) for v in words[2:]]
        except (IndexError, ValueError):
            raise SourceError(f"{path}: line {number} is not seconds, a name and a pose; fix or remove it") from None
        if camera is None:
            yield FrameFile(color, time_s=time_s)
            continue
        (_, depth), (_, confidence) = camera.coded(str(color.with_suffix("")), Path)
        yield FrameFile(color, depth, None, pose_of_row(pose), time_s, confidence if sure else None)

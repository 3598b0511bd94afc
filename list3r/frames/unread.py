"""What lies in a recording and is not read: nothing is left out without a word."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from zipfile import is_zipfile

from list3r.frames.recordings.stored import CodedArray, Stored
from list3r.memory.core.unpacking import open_archive

READ: dict[str, tuple[str, ...]] = {
    "record3d": ("metadata", "rgbd", "icon"),
    "stray": ("odometry.csv", "camera_matrix.csv"),
    "polycam": ("cameras", "corrected_cameras"),
    "scannerapp": (),
    "arkitscenes": ("lowres_wide.traj", "lowres_wide_intrinsics"),
    "scannet": ("intrinsic",),
    "scannetpp": ("pose_intrinsic_imu.json", "depth.bin"),
    "euroc": ("sensor.yaml", "data.csv", "state_groundtruth_estimate0"),
    "nerfstudio": ("transforms.json",),
    "live": ("frames.txt", "metadata"),
    "7scenes": ("camera-intrinsics.txt",),
    "tum": ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt"),
    "replica": ("traj.txt", "cam_params.json"),
    "colmap": ("sparse", "colmap"),
    "images": (),
}
"""Names that the readers look for, beside the files of frames."""
_MOST_ENTRIES = 1000
"""Of a folder; one that has more is that of the frames themselves."""
_NAMED = 8


def not_read(
    root: Path, kind: str, files: Iterable[Stored | CodedArray | None], read: tuple[str, ...] = ()
) -> list[str]:
    """Return what lies in a recording beside what a reader of the kind reads, of which some `files` are known, and
    `read`, what else it read of this one.
    """
    known = {name.rstrip("/") for name in (*READ.get(kind, ()), *read)}
    if root.is_file():
        return [name for name in _members(root) if name not in known] if is_zipfile(root) else []
    stored = (f.data if isinstance(f, CodedArray) else f for f in files)
    return sorted(_left(root, known, {p for p in stored if isinstance(p, Path) and p.is_relative_to(root)}))


def not_read_note(left: list[str]) -> tuple[str, ...]:
    """Return a note that names what is not read; nothing where nothing is left."""
    if not left:
        return ()
    more = f" and {len(left) - _NAMED} more" if len(left) > _NAMED else ""
    return (f"not read: {', '.join(left[:_NAMED])}{more}",)


def _members(archive: Path) -> list[str]:
    """The first parts of the names in an archive."""
    with open_archive(archive) as file:
        return sorted({name.split("/")[0] for name in file.namelist()})


def _left(folder: Path, known: set[str], files: set[Path], above: str = "") -> list[str]:
    """Names of what is not read in a folder, and in those of its folders that lead to the files."""
    entries = list(islice(folder.iterdir(), _MOST_ENTRIES + 1))
    if len(entries) > _MOST_ENTRIES:
        return []
    endings = {p.suffix for p in files if p.parent == folder}
    out = []
    for entry in entries:
        inside = {p for p in files if p.is_relative_to(entry)} - {entry}
        if inside:
            out += _left(entry, known, inside, f"{above}{entry.name}/")
        elif entry.name not in known and not entry.name.startswith(".") and entry.suffix not in endings:
            out.append(above + entry.name + ("/" if entry.is_dir() else ""))
    return out

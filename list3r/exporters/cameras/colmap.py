"""Write cameras, keyframes and points as a text model of COLMAP, with the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.cameras.pictures import PosedPicture, colored_points, write_pictures
from list3r.exporters.components import read_components
from list3r.exporters.output import replacing_folder, units
from list3r.memory.core.geometry import quat_wxyz_from_rotation
from list3r.memory.store.store import Store


def write_colmap(store: Store, folder: str | Path) -> tuple[Path, ...]:
    """Write `sparse/0/cameras.txt`, `images.txt` and `points3D.txt` and `images/` to a folder; return the files.

    Each component is a model of its own, the main one in `sparse/0`. Lengths are those of the memory.
    """
    folder = Path(folder)
    with replacing_folder(folder, "colmap") as temporary:
        (temporary / "images").mkdir()
        for number, component in enumerate(read_components(store)):
            model = temporary / "sparse" / str(number)
            model.mkdir(parents=True)
            pictures = write_pictures(store, component, temporary / "images")
            _write_model(model, pictures, *colored_points(store, component), f"lengths in {units(store)}")
    return tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def _write_model(
    folder: Path, pictures: Sequence[PosedPicture], points: NDArray[np.float64], rgb: NDArray[np.uint8], note: str
) -> None:
    cameras = {p: n for n, p in enumerate(dict.fromkeys((p.image_size, p.intrinsics) for p in pictures), 1)}
    lines = [f"# {note}", "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (pixel centres at halves)"]
    for ((height, width), (fx, fy, cx, cy)), number in cameras.items():
        lines.append(f"{number} PINHOLE {width} {height} {fx:.9g} {fy:.9g} {cx + 0.5:.9g} {cy + 0.5:.9g}")
    _write(folder / "cameras.txt", lines)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[], of which there are none"]
    for number, p in enumerate(pictures, 1):
        R_cam_world = p.T_world_cam[:3, :3].T
        pose = [*quat_wxyz_from_rotation(R_cam_world), *(-R_cam_world @ p.T_world_cam[:3, 3])]
        numbers = " ".join(f"{v + 0.0:.9f}" for v in pose)
        lines += [f"{number} {numbers} {cameras[p.image_size, p.intrinsics]} {p.name}", ""]
    _write(folder / "images.txt", lines)
    with (folder / "points3D.txt").open("w", encoding="ascii") as file:
        file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] (empty)\n")
        table = np.column_stack([np.arange(1, len(points) + 1), points, rgb, np.zeros(len(points))])
        np.savetxt(file, table, fmt=["%d", "%.6f", "%.6f", "%.6f", "%d", "%d", "%d", "%d"])


def _write(path: Path, lines: Sequence[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

"""Write `transforms.json` of nerfstudio with the pictures and a coloured cloud to begin with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from list3r.exporters.cameras.pictures import PosedPicture, write_pictures
from list3r.exporters.components import read_components
from list3r.exporters.output import part_path, replacing_folder, units
from list3r.exporters.ply import PlySettings, write_ply
from list3r.memory.store.store import Store

_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(store: Store, folder: str | Path) -> tuple[Path, ...]:
    """Write `transforms.json`, `points.ply` and `images/` to a folder; return the files.

    Poses are camera-to-world with OpenGL's axes, z is up, lengths are those of the memory. Other components have files
    of their own.
    """
    folder = Path(folder)
    with replacing_folder(folder, "nerfstudio") as temporary:
        (temporary / "images").mkdir()
        clouds = write_ply(store, temporary / "points.ply", PlySettings(color="rgb", points_per_instance=2000))
        for component, cloud in zip(read_components(store), clouds, strict=True):
            pictures = write_pictures(store, component, temporary / "images")
            content = {
                "camera_model": "OPENCV",
                "is_metric": units(store) == "m",
                "orientation_override": "none",
                "ply_file_path": cloud.name,
                "frames": [_frame(p) for p in pictures],
            }
            path = part_path(temporary / "transforms.json", component.name)
            path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def _frame(p: PosedPicture) -> dict[str, Any]:
    names = ("fl_x", "fl_y", "cx", "cy")
    camera = {name: round(float(v), 6) for name, v in zip(names, p.intrinsics, strict=True)}
    T_world_opengl = np.round(p.T_world_cam @ _OPENCV_TO_OPENGL, 9) + 0.0
    return {
        "file_path": f"images/{p.name}",
        **camera,
        "h": p.image_size[0],
        "w": p.image_size[1],
        "transform_matrix": T_world_opengl.tolist(),
    }

"""The local instance library on the real sequences, where they are beside the checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.source import SourceOptions, open_source
from list3r.instances.library import build_library
from list3r.memory.core.geometry import upright_box
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import LocalInstance, LocalLibrary
from list3r.reconstruction.base import Reconstruction

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def build(name: str, start: int, stop: int) -> tuple[list[Frame], LocalLibrary, Reconstruction]:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    source = open_source(str(folder), SourceOptions())
    frames = [f for f in source.read(start, min(stop, source.info.frame_count)) if isinstance(f, Frame)]
    depth = np.stack([f.depth for f in frames])
    reconstruction = Reconstruction(
        np.array([f.index for f in frames]),
        np.ones(len(frames), bool),
        np.stack([f.T_source_cam for f in frames]),
        source.info.camera,
        depth,
        (depth > 0).astype(np.float16),
        "metric",
        np.arange(0, len(frames), 10),
    )
    return frames, build_library(frames, reconstruction), reconstruction


def at(library: LocalLibrary, frame: int, x: int, y: int) -> LocalInstance:
    """The instance at a pixel of a frame."""
    for instance in library.instances:
        for row in np.flatnonzero(instance.track.frames == frame):
            if decode_mask(instance.track.masks[row], instance.track.image_size)[y, x]:
                return instance
    raise AssertionError(f"nothing at ({x}, {y}) of frame {frame}")


def turned_up(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Points in a frame whose z is `normal`."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return points @ np.stack([first, np.cross(normal, first), normal], axis=1)


@pytest.mark.data
def test_the_cabinet_is_one_box_on_a_floor() -> None:
    _, library, _ = build("cabinet", 0, 58)
    area = {i.local_id: int(i.track.areas_px.sum()) for i in library.instances}
    structure = [i for i in library.instances if i.structure]
    floor = max(structure, key=lambda i: area[i.local_id])
    (cabinet,) = (i for i in library.instances if not i.structure)
    assert area[floor.local_id] > 0.999 * sum(area[i.local_id] for i in structure) and floor.plane is not None
    size = upright_box(turned_up(cabinet.support.points, floor.plane[:3]), 0.01).size
    assert np.allclose(size, [0.8, 0.4, 0.6], atol=0.1)
    assert len(cabinet.track.frames) >= 55


@pytest.mark.data
def test_things_on_the_kitchen_table_are_their_own() -> None:
    _, library, _ = build("redkitchen", 320, 390)
    pixels = {
        "mug": (328, 258, 0.18),
        "plastic box": (455, 270, 0.50),
        "gamepad": (575, 352, 0.25),
        "magazine": (110, 290, 0.45),
        "table": (220, 330, 3.0),
        "chair": (415, 190, 1.3),
        "wall": (450, 150, 6.0),
        "cupboards": (270, 150, 3.0),
    }
    found = {name: at(library, 350, x, y) for name, (x, y, _) in pixels.items()}
    assert len({instance.local_id for instance in found.values()}) == len(pixels)
    for name, (_, _, longest) in pixels.items():
        points = found[name].support.points
        assert np.linalg.norm(np.ptp(np.quantile(points, [0.02, 0.98], axis=0), axis=0)) < longest, name
    assert found["wall"].structure and not found["table"].structure

"""Write a memory as a MuJoCo model: things as bodies of convex parts, with their mass, on structure that is fixed."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from list3r.exporters.components import has_box, point_spacing, read_components, thinned_support
from list3r.exporters.meshes.closed import ClosedSurface, hull
from list3r.exporters.output import check_density, check_metre, replacing_folder
from list3r.exporters.palette import instance_color
from list3r.exporters.solids.solid import Solid, Solids
from list3r.memory.core.geometry import Array, quat_wxyz_from_rotation
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store

_THICK_M = 0.1
"""Of structure, away from the rooms where that is known: what falls fast must not pass through it."""
_CELL_M = 0.05
_LEAST_M3 = 1e-6
"""Smaller parts have no mass that a simulator could move."""


@dataclass(frozen=True)
class MjcfSettings:
    """Content of the model."""

    density: float | None = None
    """kg per cubic metre of the convex hull, for an estimate of the mass; None for things that are fixed."""
    ids: tuple[int, ...] | None = None
    """Of the instances that become bodies; None for all."""
    guessed_metre: bool = False
    """Take a guessed metre for one; masses then are off by three times its deviation."""
    progress: Callable[[int, int], None] | None = None
    """Called with how many of the instances are done, and how many there are."""

    def __post_init__(self) -> None:
        check_density(self.density)


def write_mjcf(store: Store, folder: str | Path, settings: MjcfSettings | None = None) -> tuple[Path, ...]:
    """Write `scene.xml` and `meshes/` with what is seen of each thing of the main component; return the files, the
    model first.

    With a density each thing is a free body whose mass is an estimate; what hangs on a wall, and everything without a
    density, is fixed. Moving and removed instances, and those with too few points for a mesh, are left out. Raises
    `OptionError` for a memory without scale.
    """
    folder, s = Path(folder), settings or MjcfSettings()
    check_metre(store, guessed=s.guessed_metre)
    there = [i for i in read_components(store)[0].instances if i.state != "removed" and has_box(i)]
    with replacing_folder(folder, "mjcf") as temporary:
        (temporary / "meshes").mkdir()
        root = Xml.Element("mujoco", model=store.path.stem)
        Xml.SubElement(root, "compiler", meshdir="meshes", balanceinertia="true")
        Xml.SubElement(root, "option", timestep="0.002", integrator="implicitfast")
        default = Xml.SubElement(root, "default")
        for name, geom in (
            ("seen", {"type": "mesh", "contype": "0", "conaffinity": "0", "group": "2", "mass": "0"}),
            ("solid", {"type": "mesh", "group": "3"}),
        ):
            Xml.SubElement(Xml.SubElement(default, "default", {"class": name}), "geom", geom)
        asset, world = Xml.SubElement(root, "asset"), Xml.SubElement(root, "worldbody")
        Xml.SubElement(world, "light", pos="0 0 6", dir="0 0 -1", directional="true")
        _add_structure(world, [i for i in there if i.structure is not None], store)
        solids, held = Solids(store), _hanging(store)
        wanted = None if s.ids is None else {store.instances.get(n).id for n in s.ids}
        things = [i for i in there if i.structure is None and not i.dynamic and (wanted is None or i.id in wanted)]
        for n, i in enumerate(things, 1):
            if (solid := solids.of(i)) is not None:
                density = None if i.id in held else s.density
                _add_thing(asset, world, i, solid, density, temporary / "meshes")
            if s.progress is not None:
                s.progress(n, len(things))
        Xml.indent(root)
        Xml.ElementTree(root).write(temporary / "scene.xml", encoding="utf-8", xml_declaration=True)
    return tuple(sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: (p.suffix != ".xml", p)))


def _hanging(store: Store) -> set[int]:
    """Return what is attached to something and stands on or in nothing."""
    relations = store.relations.all()
    held = {r.subject for r in relations if r.predicate in ("on", "in")}
    return {r.subject for r in relations if r.predicate == "attached_to"} - held


def _add_thing(
    asset: Xml.Element, world: Xml.Element, instance: Instance, solid: Solid, density: float | None, folder: Path
) -> None:
    """Add the body of an instance: its mesh to look at, its convex parts to collide."""
    words = re.sub(r"[^a-z0-9]+", "_", instance.name.lower().split(",")[0]).strip("_")[:40]
    name = f"{words or 'thing'}_{instance.id}"
    center = instance.box.center
    body = Xml.SubElement(world, "body", name=name, pos=_text(center))
    mass = None if density is None else density * hull(solid.mesh.surface.vertices).volume()
    if mass is not None:
        Xml.SubElement(body, "freejoint")
    _write_obj(folder / f"{name}.obj", solid.mesh.surface, center)
    Xml.SubElement(asset, "mesh", name=name, file=f"{name}.obj", inertia="shell")
    rgba = [*np.divide(instance.color_rgb, 255), 1]
    Xml.SubElement(body, "geom", {"class": "seen", "mesh": name, "rgba": _text(rgba)})
    parts = [p for p in solid.parts if p.volume() > _LEAST_M3] or [hull(solid.mesh.surface.vertices)]
    whole = sum(p.volume() for p in parts)
    for n, part in enumerate(parts):
        Xml.SubElement(asset, "mesh", name=f"{name}.{n}", vertex=_text((part.vertices - center).ravel()))
        geom = {"class": "solid", "mesh": f"{name}.{n}", "rgba": _text([*np.divide(instance_color(n), 255), 1])}
        Xml.SubElement(body, "geom", geom | ({} if mass is None else {"mass": f"{mass * part.volume() / whole:.6g}"}))


def _add_structure(world: Xml.Element, structure: list[Instance], store: Store) -> None:
    """Add the ground, an endless plane at the lowest floor, and boxes that cover what was seen of structure."""
    floors = [i for i in structure if i.structure == "floor"] or structure
    ground = min((float(np.median(thinned_support(store, i, 2000).points[:, 2])) for i in floors), default=0.0)
    Xml.SubElement(world, "geom", name="ground", type="plane", size="0 0 1", pos=f"0 0 {ground:.5g}")
    for i in structure:
        body = Xml.SubElement(world, "body", name=f"{i.structure}_{i.id}")
        for center, half, axes in _boxes(i, thinned_support(store, i, 20_000).points.astype(np.float64)):
            quat = quat_wxyz_from_rotation(axes)
            geom = {"type": "box", "pos": _text(center), "size": _text(half), "quat": _text(quat)}
            Xml.SubElement(body, "geom", geom | {"rgba": _text([*np.divide(i.color_rgb, 255), 1])})


def _boxes(instance: Instance, points: Array) -> list[tuple[Array, Array, Array]]:
    """Return middle, half size and axes of boxes that cover the points of a plane: few, and doorways stay open."""
    if not len(points):
        return []
    thin = int(np.argmin(instance.box.size))
    axes = instance.box.rotation[:, [(thin + 1) % 3, (thin + 2) % 3, thin]]
    local = points @ axes
    cell = max(_CELL_M, 2 * point_spacing(points.astype(np.float32)))
    low = local[:, :2].min(axis=0)
    index = np.floor((local[:, :2] - low) / cell).astype(int)
    cells = np.zeros(tuple(index.max(axis=0) + 1), bool)
    cells[tuple(index.T)] = True
    cells |= ndimage.binary_closing(np.pad(cells, 3), iterations=3)[3:-3, 3:-3]
    if instance.structure == "floor":
        cells[:] = True  # what stands on it hides it
    level = float(np.median(local[:, 2]))
    away = -_THICK_M / 2 * np.sign(axes[2, 2]) if instance.structure == "floor" else 0.0
    out = []
    for x0, y0, x1, y1 in _rectangles(cells):
        middle = np.array([*(low + cell * np.array([x0 + x1, y0 + y1]) / 2), level + away])
        thick = _THICK_M if instance.structure == "floor" else _THICK_M / 5
        half = np.array([cell * (x1 - x0), cell * (y1 - y0), thick]) / 2
        out.append((axes @ middle, half, axes if np.linalg.det(axes) > 0 else axes * [1, 1, -1]))
    return out


def _rectangles(cells: NDArray[np.bool_], most: int = 24, least: float = 0.01) -> list[tuple[int, int, int, int]]:
    """Return rectangles x0, y0, x1, y1 that cover cells, the largest first; small rests are left out."""
    left, whole = cells.copy(), int(cells.sum())
    out: list[tuple[int, int, int, int]] = []
    while len(out) < most and left.any():
        best = (0, 0, 0, 0, 0)
        tall = np.zeros(left.shape[1], int)
        for x in range(left.shape[0]):
            tall = np.where(left[x], tall + 1, 0)
            for y in np.flatnonzero(tall):
                height = np.minimum.accumulate(tall[y:])
                area = height * np.arange(1, len(height) + 1)
                k = int(area.argmax())
                if area[k] > best[0]:
                    best = (int(area[k]), x + 1 - int(height[k]), int(y), x + 1, int(y) + k + 1)
        if best[0] < least * whole:
            break
        out.append(best[1:])
        left[best[1] : best[3], best[2] : best[4]] = False
    return out


def _write_obj(path: Path, surface: ClosedSurface, center: Array) -> None:
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in (surface.vertices - center).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _text(values: Array | list[float]) -> str:
    return " ".join(f"{v:.5g}" for v in np.asarray(values).ravel().tolist())

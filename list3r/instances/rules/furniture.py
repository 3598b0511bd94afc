"""Faces of one body made one: a front and the top over it, an arm and the seat beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import neighbour_pairs, pack, unpack
from list3r.instances.geometric.features import lab_of
from list3r.instances.rules.surfaces import Labels, Scene, Surface
from list3r.instances.rules.things import members_of

CELL_M = 0.03
"""Grain on which faces are said to touch; the edge between two faces is often blind by about this much."""
EDGE_SHARE = 0.5
"""Of the shorter face's length along the edge, along which the two must touch."""
COLOR_JOIN = 12.0
"""Colour difference (Lab, lightness halved) up to which a piece inside a body is one of its parts."""
BACK_SHARE = 0.7
"""Of a seat's side, over which its back reaches."""
GROUND_M = 0.15
"""A level face no higher than this over the lowest points is no seat."""
INSIDE_SHARE = 0.9
"""Of a piece that must lie inside a body to be one of its parts."""
FRAMED_SHARE = 0.35
"""Of a panel's rim along which something must stand out from the wall, for the panel to be its back."""


@dataclass(frozen=True)
class _Face:
    """One label, seen as a face of a body."""

    label: int
    surface: bool
    panel: bool
    """A sheet on a wall or floor."""
    points: NDArray[np.float32]
    """At most a few thousand of its voxels. Shape (M, 3)."""
    plane: NDArray[np.float64] | None
    """(n, d), n outwards; None for a piece that is no surface. Shape (4,)."""
    level: bool
    """Level itself, or lying on a level surface."""
    slack: float
    """How far a point may lie before the plane and still count as on it."""
    color: NDArray[np.float64]
    """Median Lab, lightness halved. Shape (3,)."""

    def height(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distance before the face's plane. Shape (N, 3) -> (N,)."""
        assert self.plane is not None
        return np.asarray(points @ self.plane[:3] + self.plane[3], np.float32)


def join_bodies(scene: Scene, surfaces: list[Surface], labels: Labels, sheets: Mapping[int, int]) -> Labels:
    """Labels with the faces of one body made one.

    Two faces belong together when they meet along an edge and neither reaches before the other (a convex edge), or
    when an upright one rises along one whole side of a level one (a back). Then pieces that lie inside the body and
    wear its colour are given to it. What bounds the room, and sheets, join nothing.
    """
    faces = _faces(scene, surfaces, labels, sheets)
    touching = _touching(scene, labels, faces)
    parent = {label: label for label in faces}
    for (a, b), places in sorted(touching.items()):
        if faces[a].surface and faces[b].surface and _one_body(scene, faces[a], faces[b], places):
            _unite(parent, a, b)
    _join_backs(scene, faces, touching, parent)
    out = _rename(labels, parent)
    return _adopt_pieces(scene, surfaces, faces, touching, parent, out)


def _join_backs(
    scene: Scene,
    faces: dict[int, _Face],
    touching: dict[tuple[int, int], NDArray[np.float64]],
    parent: dict[int, int],
) -> None:
    """Give an upright panel that something before the wall frames to it: the back of a shelf, no picture."""
    for label in sorted(faces):
        if not faces[label].panel or faces[label].level:
            continue
        axes = np.linalg.eigh(np.cov(faces[label].points.T))[1]
        rim = 2.0 * sum(_extent(faces[label].points @ axes[:, k]) for k in (1, 2))
        framed: dict[int, float] = {}
        for pair, places in sorted(touching.items()):
            if label in pair and not (faces[pair[0]].panel and faces[pair[1]].panel):
                root = _root(parent, pair[0] if pair[1] == label else pair[1])
                cells = len(np.unique(np.floor(places / (CELL_M * scene.unit)), axis=0))
                framed[root] = framed.get(root, 0.0) + 0.5 * cells * CELL_M * scene.unit
        if sum(framed.values()) > FRAMED_SHARE * rim:
            bodies = {_root(parent, face.label) for face in faces.values() if face.surface}
            _unite(parent, label, max(framed, key=lambda k: (k in bodies, framed[k], -k)))


def _faces(scene: Scene, surfaces: list[Surface], labels: Labels, sheets: Mapping[int, int]) -> dict[int, _Face]:
    out = {}
    for label, mine in members_of(labels, 0).items():
        surface = surfaces[label - 1] if label <= len(surfaces) else None
        base = surfaces[sheets[label]] if label in sheets else surface
        panel = label in sheets and surfaces[sheets[label]].structure
        flat = (label in sheets and not panel) or (surface is not None and (surface.structure or surface.sheet))
        if flat:
            continue
        some = mine[:: max(1, len(mine) // 3000)]
        out[label] = _Face(
            label,
            surface is not None,
            panel,
            scene.cloud.points[some],
            None if surface is None else surface.plane.equation,
            base is not None and base.level,
            float(np.median(scene.tolerance[some])) + 0.01 * scene.unit,
            np.median(lab_of(scene.cloud.rgb[some]), axis=0).astype(np.float64),
        )
    return out


def _touching(scene: Scene, labels: Labels, faces: dict[int, _Face]) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Places (K, 3) at which two labels come near to each other, by (smaller, larger) label."""
    known = np.flatnonzero(np.isin(labels, list(faces)))
    if not len(known):
        return {}
    cell = CELL_M * scene.unit
    keys = pack(np.floor(scene.cloud.points[known] / cell).astype(np.int64))
    pair = np.unique(np.stack([keys, labels[known].astype(np.int64)], axis=1), axis=0)
    left, right = neighbour_pairs(np.unique(pair[:, 0]), 1)
    cells, first, count = np.unique(pair[:, 0], return_index=True, return_counts=True)
    left = np.concatenate([np.arange(len(cells)), left])
    right = np.concatenate([np.arange(len(cells)), right])
    rows_a, rows_b = _combine(first, count, left, right)
    a, b = pair[rows_a, 1], pair[rows_b, 1]
    keep = a != b
    if not keep.any():
        return {}
    low, high = np.minimum(a, b)[keep], np.maximum(a, b)[keep]
    place = (unpack(pair[rows_a, 0]) + unpack(pair[rows_b, 0]) + 1)[keep] * (0.5 * cell)
    order = np.lexsort((high, low))
    low, high, place = low[order], high[order], place[order]
    codes, start = np.unique(low << 32 | high, return_index=True)
    return {
        (int(c >> 32), int(c & 0xFFFFFFFF)): places for c, places in zip(codes, np.split(place, start[1:]), strict=True)
    }


def _combine(
    first: NDArray[np.int64], count: NDArray[np.int64], left: NDArray[np.int64], right: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of rows of the cells `left` and `right`, where cell c has rows first[c] to first[c] + count[c]."""
    times = count[left] * count[right]
    which = np.repeat(np.arange(len(left)), times)
    offset = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    width = count[right][which]
    return first[left][which] + offset // width, first[right][which] + offset % width


def _one_body(scene: Scene, a: _Face, b: _Face, places: NDArray[np.float64]) -> bool:
    """True for two faces that are sides of one body."""
    assert a.plane is not None and b.plane is not None
    edge = np.cross(a.plane[:3], b.plane[:3])
    length = float(np.linalg.norm(edge))
    if length < 0.5:
        return False
    edge /= length
    met = _extent(places @ edge)
    shorter = min(_extent(a.points @ edge), _extent(b.points @ edge))
    if met < EDGE_SHARE * shorter or met < 0.1 * scene.unit:
        return False
    if np.quantile(a.height(b.points), 0.9) < a.slack and np.quantile(b.height(a.points), 0.9) < b.slack:
        return True
    seat, back = (a, b) if a.level else (b, a)
    if not seat.level or back.level or _on_the_ground(scene, seat):
        return False
    behind = np.quantile(back.height(seat.points), 0.1) > -back.slack
    low = float(np.quantile(seat.height(back.points), 0.05))
    return bool(behind and low < 0.05 * scene.unit and met > BACK_SHARE * _extent(seat.points @ edge))


def _on_the_ground(scene: Scene, face: _Face) -> bool:
    """True for a level face at the foot of all that is seen: a patch of floor or a rug is no seat."""
    ground = float(np.quantile(scene.cloud.points @ scene.up, 0.01))
    return bool(np.median(face.points @ scene.up) < ground + GROUND_M * scene.unit)


def _extent(along: NDArray[np.floating]) -> float:
    return float(np.ptp(np.quantile(along, [0.03, 0.97])))


def _unite(parent: dict[int, int], a: int, b: int) -> None:
    a, b = sorted((_root(parent, a), _root(parent, b)))
    parent[b] = a


def _root(parent: dict[int, int], label: int) -> int:
    while parent[label] != label:
        label = parent[label]
    return label


def _rename(labels: Labels, parent: dict[int, int]) -> Labels:
    # The highest label may have been joined to another before, and be no longer among `labels`.
    table = np.arange(max(int(labels.max(initial=0)), *parent, 0) + 1, dtype=np.int32)
    for label in parent:
        table[label] = _root(parent, label)
    return np.asarray(table[labels], np.int32)


def _rests_on(scene: Scene, top: Surface, piece: _Face) -> bool:
    """True for a piece that is mostly over a level face and rises from it: a thing put there."""
    over = top.plane.raster.look_up(top.plane.footprint, piece.points) > 0
    height = top.plane.height(piece.points)
    return bool(over.mean() > 0.5 and np.quantile(height, 0.9) > 0.03 * scene.unit and np.median(height) > 0.0)


def _adopt_pieces(
    scene: Scene,
    surfaces: list[Surface],
    faces: dict[int, _Face],
    touching: dict[tuple[int, int], NDArray[np.float64]],
    parent: dict[int, int],
    labels: Labels,
) -> Labels:
    """Give pieces to the body that they lie inside of and whose colour they wear."""
    sides: dict[int, list[_Face]] = {}
    for label in sorted(faces):
        if faces[label].surface:
            sides.setdefault(_root(parent, label), []).append(faces[label])
    boxes = {root: _frame_box(scene, members) for root, members in sides.items() if len(members) > 1}
    for a, b in sorted(touching):
        for piece, face in ((a, b), (b, a)):
            root = _root(parent, face)
            if faces[piece].panel or _root(parent, piece) != piece or piece in boxes or root not in boxes:
                continue
            axes, low, high = boxes[root]
            local = faces[piece].points @ axes.T
            inside = float(np.mean(((local > low) & (local < high)).all(axis=1)))
            if any(_rests_on(scene, surfaces[side.label - 1], faces[piece]) for side in sides[root] if side.level):
                continue
            alike = min(float(np.linalg.norm(faces[piece].color - side.color)) for side in sides[root])
            if inside > INSIDE_SHARE and alike < COLOR_JOIN:
                parent[piece] = root
    return _rename(labels, parent)


def _frame_box(
    scene: Scene, members: list[_Face]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Axes of a body, from its largest upright face, and its extents along them with a margin."""
    points = np.concatenate([m.points for m in members])
    upright = [m for m in members if not m.level and m.plane is not None]
    normal = max(upright, key=lambda m: len(m.points)).plane if upright else None
    first = normal[:3] if normal is not None else np.cross(scene.up, np.eye(3)[int(np.argmin(np.abs(scene.up)))])
    first = first - (first @ scene.up) * scene.up
    first /= max(float(np.linalg.norm(first)), 1e-9)
    axes = np.stack([first, np.cross(scene.up, first), scene.up])
    local = points @ axes.T
    low, high = np.quantile(local, [0.01, 0.99], axis=0)
    margin = 0.03 * scene.unit
    return axes, low - margin, high + margin

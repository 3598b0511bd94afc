"""Furnished rooms as the chunks of a walk would see them: noisy one-sided surfaces that drift from chunk to chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from list3r.memory.core.constraints import Constraints
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import MergeDecision, Support
from list3r.memory.library.merging.edges import form_groups, links_of
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.merging.settings import MergeSettings
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairTable, pair_scores
from list3r.memory.library.overlap.voxels import ChunkShapes, GrownCells, chunk_shapes
from list3r.memory.store.tables.local_instances import LocalNode

IMAGE = (480, 640)


@dataclass(frozen=True)
class Piece:
    """A thing of the true room: an axis-aligned box or an upright cylinder."""

    name: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    rgb: tuple[int, int, int] = (200, 200, 200)
    round: bool = False
    plane: tuple[float, float, float, float] | None = None
    structure: bool = False
    points: int = 800


def surface(piece: Piece, seed: int, view: float | None = None, noise: float = 0.003) -> np.ndarray:
    """Noisy surface points; with `view` (an azimuth in radians) only what is seen from there and from above."""
    rng = np.random.default_rng(seed)
    c, s = np.asarray(piece.center), np.asarray(piece.size)
    p, n = _cylinder(rng, s, 4 * piece.points) if piece.round else _box(rng, s, 4 * piece.points)
    if view is not None:
        toward = np.array([np.cos(view), np.sin(view), 0.8])
        p = p[n @ toward > 0.15]
    p = p[: piece.points]
    return (c + p + rng.normal(0, noise, p.shape)).astype(np.float32)


def _box(rng: np.random.Generator, size: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], count)
    p = rng.uniform(-0.5, 0.5, (count, 3))
    p[np.arange(count), axis] = 0.5 * sign
    n = np.zeros((count, 3))
    n[np.arange(count), axis] = sign
    return p * size, n


def _cylinder(rng: np.random.Generator, size: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    angle = rng.uniform(0, 2 * np.pi, count)
    side = rng.uniform(size=count) < 0.75
    radius = np.where(side, 0.5, 0.5 * np.sqrt(rng.uniform(size=count)))
    height = np.where(side, rng.uniform(-0.5, 0.5, count), 0.5)
    p = np.stack([radius * np.cos(angle) * size[0], radius * np.sin(angle) * size[1], height * size[2]], axis=1)
    flat = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    return p, np.where(side[:, None], flat, [0.0, 0.0, 1.0])


def node(
    chunk_id: int,
    local_id: int,
    points: np.ndarray,
    *,
    rgb: tuple[int, int, int] = (200, 200, 200),
    frames: np.ndarray | None = None,
    box: tuple[float, float, float, float] = (100, 100, 200, 200),
    plane: tuple[float, float, float, float] | None = None,
    structure: bool = False,
    feature: np.ndarray | None = None,
) -> LocalNode:
    """A local instance with one box in all of its frames."""
    seen = np.arange(chunk_id * 1000, chunk_id * 1000 + 20) if frames is None else frames
    unit = np.ones(4) if feature is None else feature
    return LocalNode(
        chunk_id=chunk_id,
        local_id=local_id,
        session_id=1,
        stability=0.9,
        structure=structure,
        dynamic=False,
        plane=None if plane is None else np.asarray(plane, float),
        feature=(unit / np.linalg.norm(unit)).astype(np.float32),
        support=Support(points, np.full(len(points), 0.8, np.float32), np.tile(np.uint8(rgb), (len(points), 1))),
        frames=seen.astype(np.int64),
        boxes_xyxy=np.tile(np.float32(box), (len(seen), 1)),
        areas_px=np.full(len(seen), 900, np.int32),
        visible_fraction=np.full(len(seen), 0.9, np.float32),
    )


@dataclass(frozen=True)
class Walk:
    """K chunks of one room."""

    chunks: list[ChunkShapes]
    S_world_chunk: dict[int, Sim3]
    cannot_link: list[tuple[tuple[int, int], tuple[int, int]]]
    truth: dict[tuple[int, int], str] = field(default_factory=dict)
    """Name of the true thing of each local instance."""


def walk(pieces: list[Piece], chunks: int, *, drift_m: float = 0.02, seed: int = 0, linked: bool = True) -> Walk:
    """See all pieces in each of `chunks` chunks, from another side each time.

    Every chunk has its own frame of reference and an error of `drift_m` in where it is placed. With `linked` all
    pairs of a chunk were seen side by side.
    """
    rng = np.random.default_rng(seed)
    shapes, placed, links, truth = [], {}, [], {}
    for k in range(1, chunks + 1):
        own = Sim3.exp(np.append(rng.normal(0, 1.0, 6), 0.0))
        step = rng.normal(size=3)
        error = Sim3.exp(np.concatenate([drift_m * step / np.linalg.norm(step), rng.normal(0, 0.003, 3), [0.0]]))
        placed[k] = error @ own.inverse()
        order = rng.permutation(len(pieces))
        nodes = []
        for local, at in enumerate(order):
            piece = pieces[at]
            points = own.apply(surface(piece, seed * 999 + k * 50 + at, view=1.3 * k)).astype(np.float32)
            plane = None
            if piece.plane is not None:
                normal = own.rotation @ np.asarray(piece.plane[:3])
                plane = (*normal, piece.plane[3] - float(normal @ own.translation))
            nodes.append(node(k, local, points, rgb=piece.rgb, plane=plane, structure=piece.structure))
            truth[(k, local)] = piece.name
        if linked:
            links += [((k, a), (k, b)) for a in range(len(order)) for b in range(a)]
        shapes.append(chunk_shapes(nodes, IMAGE, chunk_id=k))
    return Walk(shapes, placed, links, truth)


TABLE = Piece("table", (0.0, 0.0, 0.70), (1.4, 0.8, 0.04), (150, 110, 70), plane=(0, 0, 1, -0.72), points=3000)
FLOOR = Piece("floor", (0, 0, -0.01), (4, 4, 0.02), (120, 120, 120), plane=(0, 0, 1, 0.0), structure=True, points=3000)
MUG = Piece("mug", (0.2, 0.1, 0.77), (0.08, 0.08, 0.1), (240, 240, 240), round=True, points=400)
TWIN = Piece("twin mug", (-0.2, 0.1, 0.77), (0.08, 0.08, 0.1), (240, 240, 240), round=True, points=400)
CLOSE = Piece("close mug", (0.2, -0.04, 0.77), (0.08, 0.08, 0.1), (240, 240, 240), round=True, points=400)
BOX = Piece("box", (-0.3, -0.2, 0.80), (0.3, 0.2, 0.16), (60, 60, 160), points=900)
MAGAZINE = Piece("magazine", (0.3, -0.25, 0.725), (0.21, 0.28, 0.01), (200, 60, 60), points=500)
CHAIR = Piece("chair", (0.0, 1.0, 0.45), (0.5, 0.5, 0.9), (90, 60, 30), points=2500)
CHAIR2 = Piece("chair beside", (0.62, 1.0, 0.45), (0.5, 0.5, 0.9), (90, 60, 30), points=2500)
WALL = Piece("wall", (0, 2.0, 1.2), (4, 0.02, 2.4), (230, 230, 220), plane=(0, -1, 0, 2.0), structure=True, points=3000)
ROOM = [FLOOR, TABLE, MUG, TWIN, CLOSE, BOX, MAGAZINE, CHAIR, CHAIR2, WALL]


def merge_nodes(
    chunks: Sequence[ChunkShapes],
    S_world_chunk: Mapping[int, Sim3],
    cannot_link: Sequence[tuple[Key, Key]],
    constraints: Constraints | None = None,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    """Group the local instances of chunks, by the defaults."""
    s, grown = MergeSettings(), GrownCells()
    chunks = sorted(chunks, key=lambda c: c.chunk_id)
    nodes, scores = Nodes.of(chunks, S_world_chunk), {}
    for n, u in enumerate(chunks):
        for v in chunks[n:]:
            S_u_v = S_world_chunk[u.chunk_id].inverse() @ S_world_chunk[v.chunk_id]
            scores[u.chunk_id, v.chunk_id] = pair_scores(u, v, S_u_v, grown)
    links = links_of(nodes, PairTable.of(scores, Numbering({c.chunk_id: c for c in chunks})), s)
    return form_groups(nodes, links, cannot_link, s, constraints)

"""Which moving local instances are one instance, with what it was where it stood still, and where it is now.

An instance that moves has no place of its own, so overlap in space says nothing about it. What does: two chunks saw it
in the frames that they share; or it looks the same and could have gone from where one track ends to where the other
begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.constraints import key_name
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import MergeDecision, MotionTrack
from list3r.memory.library.overlap.pair_scores import Key, PairScores, box_iou
from list3r.memory.library.overlap.voxels import ChunkShapes


@dataclass(frozen=True)
class MovingSettings:
    """What makes two tracks one instance."""

    min_shared_frames: int = 3
    """Frames of two chunks in which both see it."""
    same_mask_iou: float = 0.5
    """Mean IoU of the boxes in those frames."""
    apart_iou: float = 0.1
    """Mean IoU of the boxes in those frames below which two are seen side by side."""
    same_place: float = 0.4
    """Distance of the places in those frames, in shares of the larger diagonal."""
    max_size_ratio: float = 2.5
    min_cosine: float = 0.9
    """Of the features of two tracks that share no frame."""
    max_color: float = 20.0
    """Between their median colours, CIE L*a*b* with lightness at half weight."""
    most_gap_s: float = 30.0
    """Longest time between them,"""
    reach_m: float = 0.5
    """and how far it may have gone meanwhile,"""
    speed_m_per_s: float = 2.0
    """and how much further in each second."""
    rest_m: float = 0.08
    """Places within this of the last one are one place of rest."""
    rest_s: float = 1.0
    """An instance that stayed there this long is put down."""


@dataclass(frozen=True)
class PlacedChunks:
    """Chunks that may have seen one moving instance, by chunk id."""

    shapes: Mapping[int, ChunkShapes]
    S_world_chunk: Mapping[int, Sim3]
    components: Mapping[int, int]


@dataclass(frozen=True)
class Mover:
    """An instance that was seen moving."""

    last: tuple[Key, ...]
    """The members that show where it is now."""
    resting: bool
    """Whether it stands still there."""


@dataclass(frozen=True)
class Tracks:
    """What is known of the moving local instances of a memory."""

    motions: Mapping[Key, MotionTrack | None]
    """The moving local instances; where they were, chunk coordinates."""
    times_s: Mapping[tuple[int, int], float]
    """Seconds by (session id, Frame.index)."""


@dataclass(frozen=True)
class _Node:
    """One moving local instance, or a group of those that stay."""

    keys: tuple[Key, ...]
    moves: bool
    session: int
    first_s: float
    last_s: float


def without_moving(
    pairs: Mapping[tuple[int, int], PairScores], shapes: Mapping[int, ChunkShapes], motions: Mapping[Key, object]
) -> dict[tuple[int, int], PairScores]:
    """Return scores of the pairs of which both stay: where an instance passed says nothing about what it passed."""
    if not motions:
        return dict(pairs)
    moves = {k: np.array([(k, int(n)) in motions for n in s.local_id], bool) for k, s in shapes.items()}
    return {(u, v): p.only(~(moves[u][p.i] | moves[v][p.j])) for (u, v), p in pairs.items()}


def join_movers(
    groups: Sequence[Sequence[Key]],
    placed: PlacedChunks,
    cannot_link: Sequence[tuple[Key, Key]],
    tracks: Tracks,
    settings: MovingSettings | None = None,
) -> tuple[list[list[Key]], dict[Key, Mover], list[MergeDecision]]:
    """Join the moving local instances, each of which is a group by itself, to one another and to groups that stay.

    Returns all groups, in order; what is known of those that moved, by their first member; and the decisions. Edges are
    taken best first, ties by key, so the order of groups does not matter.
    """
    from scipy.cluster.hierarchy import DisjointSet

    if not tracks.motions:
        return [list(g) for g in groups], {}, []
    scene = _Scene(placed, tracks, settings or MovingSettings())
    nodes = [scene.node(tuple(g)) for g in sorted(map(sorted, groups))]
    enemies = {frozenset(pair) for pair in cannot_link}
    sets = DisjointSet(range(len(nodes)))
    decisions = []
    for edge in _edges(nodes, scene):
        if sets.connected(edge.a, edge.b):
            continue
        names = (key_name(nodes[edge.a].keys[0]), key_name(nodes[edge.b].keys[0]))
        left, right = sorted(sorted(sets.subset(n)) for n in (edge.a, edge.b))
        against = _objection([nodes[n] for n in left], [nodes[n] for n in right], enemies, scene)
        if against:
            decisions.append(MergeDecision("refuse", *names, edge.scores, against))
            continue
        decisions.append(MergeDecision("merge", *names, {**edge.scores, "score": round(edge.score, 3)}, edge.reason))
        sets.merge(edge.a, edge.b)
    joined: list[list[Key]] = []
    movers: dict[Key, Mover] = {}
    for members in map(sorted, sets.subsets()):
        keys = sorted(k for n in members for k in nodes[n].keys)
        joined.append(keys)
        if any(nodes[n].moves for n in members):
            movers[keys[0]] = scene.now([nodes[n] for n in members])
    return sorted(joined), movers, decisions


@dataclass(frozen=True)
class _MoverEdge:
    """Two nodes that may be one instance."""

    a: int
    b: int
    score: float
    scores: dict[str, float]
    reason: str


def _edges(nodes: Sequence[_Node], scene: _Scene) -> list[_MoverEdge]:
    """Return what ties the nodes that move to others of their session and component, best first, ties by number."""
    out = []
    moving = [n for n, node in enumerate(nodes) if node.moves]
    pairs = {(min(n, m), max(n, m)) for n in moving for m in range(len(nodes)) if n != m}
    for a, b in sorted(pairs):
        x, y = nodes[a], nodes[b]
        if x.session == y.session and scene.component(x) == scene.component(y):
            found = scene.edge(x, y)
            if found is not None:
                out.append(_MoverEdge(a, b, *found))
    return sorted(out, key=lambda e: (-e.score, e.a, e.b))


class _Scene:
    """Places and times of all local instances."""

    def __init__(self, placed: PlacedChunks, tracks: Tracks, settings: MovingSettings) -> None:
        self._shapes, self._placed, self._components = placed.shapes, placed.S_world_chunk, placed.components
        self._tracks, self._s = tracks, settings

    def component(self, node: _Node) -> int:
        return self._components[node.keys[0][0]]

    def node(self, keys: tuple[Key, ...]) -> _Node:
        session = self._shapes[keys[0][0]].session_id
        seen = [self.time(session, f) for k in keys for f in (self.frames(k)[0], self.frames(k)[-1])]
        return _Node(keys, keys[0] in self._tracks.motions and len(keys) == 1, session, min(seen), max(seen))

    def time(self, session: int, frame: int) -> float:
        return self._tracks.times_s.get((session, int(frame)), float(frame) / 30.0)

    def at(self, key: Key) -> int:
        return int(np.searchsorted(self._shapes[key[0]].local_id, key[1]))

    def frames(self, key: Key) -> NDArray[np.int64]:
        return self._shapes[key[0]].frames[self.at(key)]

    def _recorded(self, a: Key, b: Key, frames: int) -> int:
        """Return how many frames of the recording so many that two local instances share stand for."""
        return frames * min(self._shapes[k].stands_for for k, _ in (a, b))

    def size(self, key: Key) -> float:
        shape = self._shapes[key[0]]
        return float(shape.size[self.at(key)] * self._placed[key[0]].scale)

    def unit(self, key: Key) -> float:
        return float(self._shapes[key[0]].unit * self._placed[key[0]].scale)

    def places(self, key: Key, frames: NDArray[np.int64]) -> Array:
        """Return where a local instance was in these frames, world: along its track, or where its surface lies. (N,
        3).
        """
        motion = self._tracks.motions.get(key)
        placed, shape = self._placed[key[0]], self._shapes[key[0]]
        if motion is None or len(motion.frames) == 0:
            return np.tile(placed.apply(shape.center[[self.at(key)]]), (len(frames), 1))
        nearest = np.clip(np.searchsorted(motion.frames, frames), 0, len(motion.frames) - 1)
        return placed.apply(motion.positions[nearest])

    def edge(self, x: _Node, y: _Node) -> tuple[float, dict[str, float], str] | None:
        """Return the evidence that two nodes are one instance: (score, scores, reason)."""
        best: tuple[float, dict[str, float], str] | None = None
        for a in x.keys:
            for b in y.keys:
                found = self._same_frames(a, b) if a[0] != b[0] else None
                if found is not None and (best is None or found[0] > best[0]):
                    best = found
        if best is None and x.moves and y.moves:
            best = self._alike(x, y)
        return best

    def _same_frames(self, a: Key, b: Key) -> tuple[float, dict[str, float], str] | None:
        s = self._s
        common, at_a, at_b = np.intersect1d(self.frames(a), self.frames(b), return_indices=True)
        large, small = max(self.size(a), self.size(b)), min(self.size(a), self.size(b))
        if self._recorded(a, b, len(common)) < s.min_shared_frames or large > s.max_size_ratio * max(small, 1e-9):
            return None
        boxes_a = self._shapes[a[0]].boxes_xyxy[self.at(a)][at_a].astype(float)
        boxes_b = self._shapes[b[0]].boxes_xyxy[self.at(b)][at_b].astype(float)
        iou = float(np.mean(np.diagonal(box_iou(boxes_a, boxes_b))))
        apart = np.linalg.norm(self.places(a, common) - self.places(b, common), axis=1)
        near = float(np.median(apart)) / max(large, 1e-9)
        stays = (a in self._tracks.motions) != (b in self._tracks.motions)
        limit = 0.5 * s.same_place if stays else s.same_place
        if iou < s.same_mask_iou or near > limit:
            return None
        scores = {"frame_iou": round(iou, 3), "shared": float(len(common)), "apart": round(near, 3)}
        return 1.0 + iou, scores, "one mask in the frames that both chunks saw"

    def _alike(self, x: _Node, y: _Node) -> tuple[float, dict[str, float], str] | None:
        s = self._s
        x, y = (x, y) if x.first_s <= y.first_s else (y, x)
        a, b = x.keys[0], y.keys[0]
        gap_s = y.first_s - x.last_s
        shape_a, shape_b = self._shapes[a[0]], self._shapes[b[0]]
        i, j = self.at(a), self.at(b)
        if not 0 <= gap_s <= s.most_gap_s:
            return None
        cosine = float(shape_a.feature[i] @ shape_b.feature[j])
        color = float(np.linalg.norm((shape_a.lab[i] - shape_b.lab[j]) * np.array([0.5, 1.0, 1.0])))
        large, small = max(self.size(a), self.size(b)), min(self.size(a), self.size(b))
        if cosine < s.min_cosine or color > s.max_color or large > s.max_size_ratio * max(small, 1e-9):
            return None
        way = float(np.linalg.norm(self.places(b, self.frames(b)[:1]) - self.places(a, self.frames(a)[-1:])))
        if way > (s.reach_m + s.speed_m_per_s * gap_s) * self.unit(a):
            return None
        scores = {"cosine": round(cosine, 3), "gap_s": round(gap_s, 2), "way": round(way, 3)}
        return 0.5 * cosine, scores, "it looks the same and could have gone from one place to the other"

    def seen_apart(self, a: Key, b: Key) -> bool:
        """Return whether two local instances have frames in common in which they are two."""
        common, at_a, at_b = np.intersect1d(self.frames(a), self.frames(b), return_indices=True)
        recorded = self._recorded(a, b, len(common))
        if self._shapes[a[0]].session_id != self._shapes[b[0]].session_id or recorded < self._s.min_shared_frames:
            return False
        boxes_a = self._shapes[a[0]].boxes_xyxy[self.at(a)][at_a].astype(float)
        boxes_b = self._shapes[b[0]].boxes_xyxy[self.at(b)][at_b].astype(float)
        return bool(np.mean(np.diagonal(box_iou(boxes_a, boxes_b))) < self._s.apart_iou)

    def now(self, nodes: Sequence[_Node]) -> Mover:
        """Return where an instance is: where it was put down, or where its last track ends."""
        order = sorted(nodes, key=lambda n: (n.session, n.last_s, n.keys))
        last = order[-1]
        if not last.moves:
            return Mover(last.keys, True)
        return Mover(last.keys, self._rests(last.keys[0]))

    def _rests(self, key: Key) -> bool:
        frames = self.frames(key)
        if self._tracks.motions[key] is None:
            return False
        places = self.places(key, frames)
        away = np.linalg.norm(places - np.median(places[-3:], axis=0), axis=1) > self._s.rest_m * self.unit(key)
        since = frames[int(np.flatnonzero(away)[-1]) + 1 :] if away.any() else frames
        session = self._shapes[key[0]].session_id
        return bool(len(since) and self.time(session, since[-1]) - self.time(session, since[0]) >= self._s.rest_s)


def _objection(left: Sequence[_Node], right: Sequence[_Node], enemies: set[frozenset[Key]], scene: _Scene) -> str:
    """Return why two instances must stay apart, or nothing."""
    for x, y in product(left, right):
        for a, b in product(x.keys, y.keys):
            if frozenset((a, b)) in enemies or scene.seen_apart(a, b):
                return f"{key_name(a)} and {key_name(b)} were seen side by side in one frame"
    return ""

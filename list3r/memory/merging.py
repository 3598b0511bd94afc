"""Which local instances are one thing: edges of overlap, joined best first (paper 3.3, with complete links)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.constraints import Constraints, Growing
from list3r.memory.geometry import Array, Sim3
from list3r.memory.records import MergeDecision
from list3r.memory.shapes import ChunkShapes, Ints, coverage

Key = tuple[int, int]
"""(chunk id, local id)."""


@dataclass(frozen=True)
class MergeSettings:
    """What makes two local instances one thing."""

    min_overlap: float = 0.3
    """Of the less covered one, for two views of one thing."""
    min_containment: float = 0.5
    """Of the better covered one, for two views of one thing."""
    part_containment: float = 0.8
    """Of a smaller one inside a larger one, for a partial view."""
    min_truncated: float = 0.5
    """Share of its frames in which the image's border must cut a partial view."""
    max_part_color: float = 22.0
    """Between the median colours of a part and of the whole, CIE L*a*b* with lightness at half weight."""
    min_part_size: float = 0.3
    """Of a part that the border does not cut, over the size of the whole."""
    min_cosine: float = 0.0
    """Of the features; spaces without calibration only tell opposites apart."""
    max_center_offset: float = 0.45
    """Between the centres of two whole views of one thing that share no surface, over the diagonal of its extents."""
    max_size_ratio: float = 2.5
    """Of two whole views of one thing."""
    min_shared_frames: int = 3
    """Frames that two chunks share, before what the masks do in them counts."""
    same_mask_iou: float = 0.5
    """Mean IoU of the boxes in shared frames that makes up for poor overlap in space."""
    max_whole_m: float = 1.6
    """Diagonal up to which a view that the border does not cut is taken for whole; the far end of a larger thing is
    hidden or out of range."""
    max_conflicts: float = 0.25
    """Share of the pairs across two clusters that may speak against joining them."""
    max_angle_deg: float = 10.0
    """Between the normals of two pieces of one plane."""
    most_span_m: float = 20.0
    """Along the longest edge of its box: a floor or wall that goes on beyond is continued by another one. So no thing
    grows with the memory: its points stay dense, its box says where it is, and a new chunk touches only what is near.
    """


@dataclass(frozen=True)
class PairScores:
    """E pairs of local instances that meet, of two chunks (or of one)."""

    i: Ints
    """Position in the first chunk. Shape (E,)."""
    j: Ints
    """Position in the second chunk. Shape (E,)."""
    i_on_j: Array
    """Share of i's surface that lies on j. Shape (E,)."""
    j_on_i: Array
    """Share of j's surface that lies on i. Shape (E,)."""
    shared: Ints
    """Frames in which both are seen. Shape (E,)."""
    frame_iou: Array
    """Mean IoU of their boxes in those frames. Shape (E,)."""


@dataclass(frozen=True)
class _Edge:
    a: int
    b: int
    score: float
    kind: str
    scores: dict[str, float]


@dataclass(frozen=True)
class Edge:
    """A pair of local instances that argue for being one thing."""

    a: Key
    b: Key
    score: float
    kind: str
    scores: dict[str, float]


def pair_scores(u: ChunkShapes, v: ChunkShapes, S_u_v: Sim3) -> PairScores:
    """Compare all local instances of two chunks; pairs whose surfaces nowhere meet are left out.

    Pass the same chunk twice, with the identity, for the pairs within a chunk (i < j).
    """
    i_on_j = coverage(u, v, S_u_v.inverse())
    j_on_i = coverage(v, u, S_u_v).T
    meet = (i_on_j > 0) | (j_on_i > 0)
    if u.chunk_id == v.chunk_id:
        meet = np.triu(meet, 1)
    shared, iou = _shared_frames(u, v)
    i, j = np.nonzero(meet)
    return PairScores(i, j, i_on_j[i, j], j_on_i[i, j], shared[i, j], iou[i, j])


def merge_nodes(
    chunks: Sequence[ChunkShapes],
    S_world_chunk: Mapping[int, Sim3],
    cannot_link: Sequence[tuple[Key, Key]],
    settings: MergeSettings | None = None,
    pairs: Mapping[tuple[int, int], PairScores] | None = None,
    word: Constraints | None = None,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    """Group local instances into things.

    All chunks given must share one frame of reference. `pairs` are scores already known, by chunk ids (u <= v). The
    partition is the same in whatever order chunks and pairs are given: edges are taken best first, ties by key. Two
    groups are joined unless a cannot-link pair would come together, or too many pairs across speak against it
    (complete link), or the operator's `word` parts them. What that word holds together is joined afterwards, by
    `Constraints.joined`, so that each half of it goes on attracting what looks like it. Returns the groups, each
    sorted, ordered by their first member, and the decisions: one `merge` for each union, one `refuse` for each strong
    edge that was not taken.
    """
    s = settings or MergeSettings()
    chunks = sorted(chunks, key=lambda c: c.chunk_id)
    table = Nodes.of(chunks, S_world_chunk)
    known = pairs if pairs is not None else score_all(chunks, S_world_chunk)
    edges: list[_Edge] = []
    overlap: dict[tuple[int, int], float] = {}
    for (u, v), scores in sorted(known.items()):
        if u in table.start and v in table.start:
            edges += _edges(table, table.start[u], table.start[v], scores, overlap, s)
    edges.sort(key=lambda e: (-e.score, e.a, e.b))
    enemies = _enemies(table, cannot_link)
    return _join(table, edges, overlap, enemies, s, None if word is None or not word else word.growing())


def local_edges(
    u: Nodes, v: Nodes, scores: PairScores, settings: MergeSettings
) -> tuple[list[Edge], dict[tuple[Key, Key], float]]:
    """The pairs of two chunks that argue for being one thing, and how far each pair overlaps, both ways."""
    inside = u.keys == v.keys
    table = u if inside else Nodes.join([u, v])
    overlap: dict[tuple[int, int], float] = {}
    edges = _edges(table, 0, 0 if inside else len(u.keys), scores, overlap, settings)
    k = table.keys
    return (
        [Edge(k[e.a], k[e.b], e.score, e.kind, e.scores) for e in edges],
        {(k[a], k[b]): share for (a, b), share in overlap.items()},
    )


def form_groups(
    nodes: Nodes,
    edges: Sequence[Edge],
    overlap: Mapping[tuple[Key, Key], float],
    cannot_link: Sequence[tuple[Key, Key]],
    settings: MergeSettings,
    word: Constraints | None = None,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    """The same as `merge_nodes`, of these local instances alone, from edges that are known."""
    at = {key: n for n, key in enumerate(nodes.keys)}
    found = [_Edge(min(at[e.a], at[e.b]), max(at[e.a], at[e.b]), e.score, e.kind, e.scores) for e in edges]
    found.sort(key=lambda e: (-e.score, e.a, e.b))
    known: dict[tuple[int, int], float] = {}
    for (a, b), share in overlap.items():
        if a in at and b in at:
            known[at[a], at[b]] = share
    growing = None if word is None or not word else word.growing()
    return _join(nodes, found, known, _enemies(nodes, cannot_link), settings, growing)


def score_all(chunks: Sequence[ChunkShapes], S_world_chunk: Mapping[int, Sim3]) -> dict[tuple[int, int], PairScores]:
    """The scores of all pairs of chunks, by chunk ids (u <= v)."""
    out = {}
    for n, u in enumerate(chunks):
        for v in chunks[n:]:
            S_u_v = S_world_chunk[u.chunk_id].inverse() @ S_world_chunk[v.chunk_id]
            out[(u.chunk_id, v.chunk_id)] = pair_scores(u, v, S_u_v)
    return out


# ---------------------------------------------------------------------------------------------- the evidence


@dataclass(frozen=True)
class Nodes:
    """Local instances in one numbering, world coordinates: what merging asks about them."""

    keys: list[Key]
    start: dict[int, int]
    center: Array
    size: Array
    plane: Array
    truncated: Array
    structure: NDArray[np.bool_]
    feature: NDArray[np.float32]
    tolerance: Array
    unit: Array
    lab: Array
    low: Array
    high: Array
    """Corners of the boxes of their points, world. Shape (N, 3) each."""

    @staticmethod
    def of(chunks: Sequence[ChunkShapes], S_world_chunk: Mapping[int, Sim3]) -> Nodes:
        keys: list[Key] = []
        start, center, size, plane, tolerance, unit, low, high = {}, [], [], [], [], [], [], []
        for c in chunks:
            lower, upper = c.spans(S_world_chunk[c.chunk_id])
            low.append(lower)
            high.append(upper)
            placed = S_world_chunk[c.chunk_id]
            start[c.chunk_id] = len(keys)
            keys += [(c.chunk_id, int(n)) for n in c.local_id]
            center.append(placed.apply(c.center))
            size.append(c.size * float(placed.scale))
            normal = c.plane[:, :3] @ placed.rotation.T
            plane.append(np.column_stack([normal, c.plane[:, 3] * float(placed.scale) - normal @ placed.translation]))
            tolerance.append(np.full(len(c.local_id), 2.0 * c.grain * float(placed.scale)))
            unit.append(np.full(len(c.local_id), c.unit * float(placed.scale)))
        features = [c.feature for c in chunks if len(c.local_id)]
        return Nodes(
            keys,
            start,
            np.concatenate(center) if center else np.zeros((0, 3)),
            np.concatenate(size) if size else np.zeros(0),
            np.concatenate(plane) if plane else np.zeros((0, 4)),
            np.concatenate([c.truncated for c in chunks]) if chunks else np.zeros(0),
            np.concatenate([c.structure for c in chunks]) if chunks else np.zeros(0, bool),
            np.concatenate(features) if features else np.zeros((0, 1), np.float32),
            np.concatenate(tolerance) if tolerance else np.zeros(0),
            np.concatenate(unit) if unit else np.zeros(0),
            np.concatenate([c.lab for c in chunks]) if chunks else np.zeros((0, 3)),
            np.concatenate(low) if low else np.zeros((0, 3)),
            np.concatenate(high) if high else np.zeros((0, 3)),
        )

    @staticmethod
    def join(parts: Sequence[Nodes]) -> Nodes:
        """Those of several chunks, in the order of the chunks."""
        start: dict[int, int] = {}
        count = 0
        for p in parts:
            start |= {chunk: count + at for chunk, at in p.start.items()}
            count += len(p.keys)
        features = [p.feature for p in parts if len(p.keys)]
        joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS}
        feature = np.concatenate(features) if features else np.zeros((0, 1), np.float32)
        return Nodes(keys=[k for p in parts for k in p.keys], start=start, feature=feature, **joined)

    def only(self, keys: Collection[Key]) -> Nodes:
        """Some of them."""
        at = np.array([n for n, k in enumerate(self.keys) if k in keys], np.int64)
        chosen: dict[str, Any] = {name: getattr(self, name)[at] for name in (*_COLUMNS, "feature")}
        return Nodes(keys=[self.keys[n] for n in at], start={}, **chosen)

    def coplanar(self, a: Ints, b: Ints, angle_deg: float) -> NDArray[np.bool_]:
        """Whether pairs of flat nodes lie in one plane; false where one is not flat."""
        cosine = np.einsum("ij,ij->i", self.plane[a, :3], self.plane[b, :3])
        off_b = np.abs(np.einsum("ij,ij->i", self.plane[a, :3], self.center[b]) + self.plane[a, 3])
        off_a = np.abs(np.einsum("ij,ij->i", self.plane[b, :3], self.center[a]) + self.plane[b, 3])
        near = np.maximum(off_a, off_b) <= 2.0 * np.maximum(self.tolerance[a], self.tolerance[b])
        return np.asarray((cosine > np.cos(np.radians(angle_deg))) & near)


_COLUMNS = ("center", "size", "plane", "truncated", "structure", "tolerance", "unit", "lab", "low", "high")


def _edges(
    t: Nodes, start_u: int, start_v: int, p: PairScores, overlap: dict[tuple[int, int], float], s: MergeSettings
) -> list[_Edge]:
    """The pairs that argue for being one thing. Also notes how far each pair overlaps, both ways, in `overlap`."""
    a, b = p.i + start_u, p.j + start_v
    low, high = np.minimum(p.i_on_j, p.j_on_i), np.maximum(p.i_on_j, p.j_on_i)
    overlap.update(zip(zip(a.tolist(), b.tolist(), strict=True), low.tolist(), strict=True))
    cosine = np.einsum("ij,ij->i", t.feature[a], t.feature[b]).astype(float)
    compatible = cosine >= s.min_cosine
    across = np.full(len(a), start_u != start_v)
    enough = (p.shared >= s.min_shared_frames) & across
    alike = np.maximum(t.size[a], t.size[b]) < s.max_size_ratio * np.minimum(t.size[a], t.size[b])
    one_mask, apart = enough & (p.frame_iou >= s.same_mask_iou), enough & (p.frame_iou < 0.02)
    coplanar = t.coplanar(a, b, s.max_angle_deg)
    both_structure, one_structure = t.structure[a] & t.structure[b], t.structure[a] ^ t.structure[b]
    same = (low >= s.min_overlap) & (high >= s.min_containment) & (~one_structure | (low >= 0.5) & coplanar)
    same |= one_mask & alike & (high >= 0.2) & ~one_structure
    same &= across | (low >= s.min_containment)
    cut = np.where(p.i_on_j >= p.j_on_i, t.truncated[a], t.truncated[b])
    size = np.minimum(t.size[a], t.size[b]) / np.maximum(np.maximum(t.size[a], t.size[b]), 1e-12)
    color = np.linalg.norm((t.lab[a] - t.lab[b]) * np.array([0.5, 1.0, 1.0]), axis=1)
    part = (high >= s.part_containment) & (color <= s.max_part_color) & ~one_structure & across
    part &= (cut >= s.min_truncated) | (coplanar & (size >= s.min_part_size))
    piece = both_structure & coplanar & (high >= 0.05)
    base = np.sqrt(low * high)
    score = np.where(same, 0.5 + 0.5 * base, np.where(part, 0.3 + 0.2 * high, 0.2 + 0.2 * high))
    score += np.where(one_mask & alike, 0.5 * p.frame_iou, 0.0)
    wanted = (same | part | piece) & compatible & ~(apart & ~both_structure)
    out = []
    for n in np.flatnonzero(wanted):
        kind = "same" if same[n] else "part" if part[n] else "plane"
        scores = {"overlap": low[n], "containment": high[n], "cosine": cosine[n], "score": score[n]}
        if enough[n]:
            scores["frame_iou"] = p.frame_iou[n]
        rounded = {k: round(float(x), 3) for k, x in scores.items()}
        out.append(_Edge(int(a[n]), int(b[n]), round(float(score[n]), 6), kind, rounded))
    return out


def _shared_frames(u: ChunkShapes, v: ChunkShapes) -> tuple[Ints, Array]:
    """For all pairs: frames in which both are seen, and the mean IoU of their boxes there. Shape (N_u, N_v) each."""
    shape = (len(u.local_id), len(v.local_id))
    count, total = np.zeros(shape, np.int64), np.zeros(shape)
    if u.session_id != v.session_id or not shape[0] or not shape[1]:
        return count, total
    frames_u, frames_v = np.concatenate(u.frames), np.concatenate(v.frames)
    common = np.intersect1d(frames_u, frames_v)
    boxes_u, boxes_v = np.concatenate(u.boxes_xyxy).astype(float), np.concatenate(v.boxes_xyxy).astype(float)
    owner_u = np.repeat(np.arange(shape[0]), [len(f) for f in u.frames])
    owner_v = np.repeat(np.arange(shape[1]), [len(f) for f in v.frames])
    for frame in common:
        at_u, at_v = np.flatnonzero(frames_u == frame), np.flatnonzero(frames_v == frame)
        cell = np.ix_(owner_u[at_u], owner_v[at_v])
        count[cell] += 1
        total[cell] += box_iou(boxes_u[at_u], boxes_v[at_v])
    return count, total / np.maximum(count, 1)


def box_iou(a: Array, b: Array) -> Array:
    """IoU of boxes xyxy. Shape (A, 4), (B, 4) -> (A, B)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inter = np.prod(np.clip(high - low, 0, None), axis=2)
    area_a, area_b = np.prod(a[:, 2:] - a[:, :2], axis=1), np.prod(b[:, 2:] - b[:, :2], axis=1)
    return np.asarray(inter / np.maximum(area_a[:, None] + area_b[None] - inter, 1e-9))


# ---------------------------------------------------------------------------------------------- the decision


def _enemies(t: Nodes, cannot_link: Sequence[tuple[Key, Key]]) -> list[set[int]]:
    at = {key: n for n, key in enumerate(t.keys)}
    out: list[set[int]] = [set() for _ in t.keys]
    for a, b in cannot_link:
        if a in at and b in at:
            out[at[a]].add(at[b])
            out[at[b]].add(at[a])
    return out


def _join(
    t: Nodes,
    edges: Sequence[_Edge],
    overlap: dict[tuple[int, int], float],
    enemies: list[set[int]],
    s: MergeSettings,
    word: Growing | None = None,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    group = list(range(len(t.keys)))
    members = {n: [n] for n in group}
    low, high = t.low.copy(), t.high.copy()
    foes = {n: set(enemies[n]) for n in group}
    decisions: list[MergeDecision] = []
    refused: set[tuple[int, int]] = set()
    for e in edges:
        a, b = sorted((group[e.a], group[e.b]))
        if a == b or (a, b) in refused:
            continue
        against = word.objection(t.keys[a], t.keys[b]) if word is not None else ""
        span = float((np.maximum(high[a], high[b]) - np.minimum(low[a], low[b])).max())
        if not against and span > s.most_span_m * max(t.unit[a], t.unit[b]):
            against = f"together they would reach over {span:.0f} m"
        against = against or _objection(t, members[a], members[b], foes[a], overlap, s)
        name_a, name_b = _name(t.keys[e.a]), _name(t.keys[e.b])
        if against:
            refused.add((a, b))
            decisions.append(MergeDecision("refuse", name_a, name_b, e.scores, against))
            continue
        decisions.append(MergeDecision("merge", name_a, name_b, e.scores, _REASONS[e.kind]))
        if word is not None:
            word.join(t.keys[a], t.keys[b])
        members[a] = sorted(members[a] + members.pop(b))
        low[a], high[a] = np.minimum(low[a], low[b]), np.maximum(high[a], high[b])
        foes[a] |= foes.pop(b)
        for n in members[a]:
            group[n] = a
        refused = {pair for pair in refused if a not in pair and b not in pair}
    groups = sorted([t.keys[n] for n in ns] for ns in members.values())
    return groups, decisions


_REASONS = {
    "same": "two views of one thing: the surfaces cover each other",
    "part": "a partial view: its surface lies on that of the whole",
    "plane": "two pieces of one plane that touch",
}


def _objection(
    t: Nodes,
    a: list[int],
    b: list[int],
    foes_of_a: set[int],
    overlap: dict[tuple[int, int], float],
    s: MergeSettings,
) -> str:
    """Why two groups must stay apart, or nothing."""
    seen_apart = foes_of_a.intersection(b)
    if seen_apart:
        return f"{_name(t.keys[min(seen_apart)])} was seen beside a member of the other in one frame"
    left, right = (x.ravel() for x in np.meshgrid(a, b, indexing="ij"))
    whole = (t.truncated[left] < s.min_truncated) & (t.truncated[right] < s.min_truncated)
    whole &= np.maximum(t.size[left], t.size[right]) < s.max_whole_m * np.maximum(t.unit[left], t.unit[right])
    compared = np.flatnonzero(whole & ~t.coplanar(left, right, s.max_angle_deg))
    if len(compared) == 0:
        return ""
    x, y = left[compared], right[compared]
    smaller, larger = np.minimum(t.size[x], t.size[y]), np.maximum(t.size[x], t.size[y])
    offset = np.linalg.norm(t.center[x] - t.center[y], axis=1)
    shared = np.array([overlap.get((min(p), max(p)), 0.0) for p in zip(x.tolist(), y.tolist(), strict=True)])
    apart = (shared < 0.1) & (offset > s.max_center_offset * smaller) & (larger < s.max_size_ratio * smaller)
    if apart.sum() > s.max_conflicts * len(compared):
        return f"{int(apart.sum())} of {len(compared)} pairs of whole views lie apart"
    return ""


def _name(key: Key) -> str:
    return f"{key[0]}:{key[1]}"

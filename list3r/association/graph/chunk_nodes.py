"""Nodes along a chunk, and the relation of two chunks at each of their shared frames.

A reconstruction deforms slowly, which one similarity per chunk cannot correct; so a chunk is cut into runs of a few
frames, each with its own similarity (a node). Each shared frame relates the two chunks: its camera pose in both, and
the ratio of its depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.edge_information import about
from list3r.association.overlap.shared_points import shared_samples
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples
from list3r.reconstruction.scale_loss import lost_scale

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_LEAST_POINTS = 20
"""Shared points of a frame from which the ratio of its depths counts."""
_LEAST_FRAMES = 6
"""Shared frames of an edge from which their relations show how chunks deform."""


@dataclass(frozen=True)
class NodeSettings:
    """How chunks may deform."""

    enabled: bool = True
    """False: every chunk is rigid."""
    frames: int = 10
    """Frames of a node: enough to average the errors of single frames, few against the 30 of an overlap."""
    measured_share: float = 0.3
    """Share of the measured change of relation along overlaps that is modelled as a random walk of the chunks: the
    change includes errors of single frames, and deformation grows slower than a walk. Chosen among 0.03 to 3, see
    research/association 0043."""
    shift_walk: float = 1e-4
    """Standard deviation of the shift that a frame adds and overlaps do not show, as a share of the depth: chunks from
    the same depth images share this error."""
    turn_walk: float = 6e-4
    """The same of the rotation, radians: `WeightSettings.bending` in a chunk of 100 frames."""
    least_walk: float = 1e-5
    """Least standard deviation per frame, of all components."""
    common: float = 1e-3
    """Standard deviation that all frames of a node share, as a share of the depth, in radians, of the log scale."""


@dataclass(frozen=True)
class ChunkNodes:
    """One chunk cut into N nodes."""

    node: Ints
    """Node of each posed frame. Shape (G,)."""
    frames: Ints
    """Frame.index of each posed frame. Shape (G,)."""
    at: Array
    """Mean Frame.index of each node. Shape (N,)."""
    center: Array
    """Centre of the points that each node's frames see, chunk coordinates. Shape (N, 3)."""
    reach: Array
    """Distance of that centre from the camera. Shape (N,)."""
    count: Ints
    """Frames of each node. Shape (N,)."""
    turns: Array
    """Covariance of a node's similarity relative to the next one, from scale lost while the camera rotates (structure
    from motion). Shape (N - 1, 7, 7)."""

    @staticmethod
    def of(samples: FrameSamples, length: int) -> ChunkNodes:
        """Return runs of `length` frames, at the same frames in every chunk of a video; rigid chunks have length 0."""
        run = samples.camera_frames // length if length else np.zeros(len(samples.camera_frames), np.int64)
        _, node = np.unique(run, return_inverse=True)
        count = np.bincount(node)
        center, reach = _views(samples)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(node, values) / count)

        return ChunkNodes(
            node=node.astype(np.int64),
            frames=samples.camera_frames,
            at=mean(samples.camera_frames.astype(np.float64)),
            center=np.stack([mean(center[:, k]) for k in range(3)], axis=1),
            reach=mean(reach),
            count=count.astype(np.int64),
            turns=_turns(samples.T_chunk_cam, reach, node),
        )

    @property
    def middle(self) -> int:
        """The node in the middle of the chunk's posed frames."""
        return int(self.node[len(self.node) // 2])

    def turned(self, a: int, b: int) -> Array:
        """Return the covariance of one node's similarity relative to another, from rotations between. Shape (7, 7)."""
        return np.asarray(self.turns[min(a, b) : max(a, b)].sum(axis=0))

    def nearest(self, frame: int) -> int:
        """Return the node of the posed frame nearest to a frame."""
        return int(self.node[int(np.argmin(np.abs(self.frames - frame)))])


@dataclass(frozen=True)
class FrameRelations:
    """Relation of the two reconstructions at F shared frames."""

    frames: Ints
    """Frame.index. Shape (F,)."""
    off: Array
    """x in S_v_u(frame) = S_v_u exp(x), S_v_u that of the edge, about the centre of the points that the frame sees in
    u; shifts as shares of the distance of that centre. Shape (F, 7)."""

    def rigid(self) -> FrameRelations:
        """Return the relations for chunks of known scale: shift of the centre, and rotation about it."""
        return replace(self, off=self.off * ([1.0] * 6 + [0.0]))


@dataclass(frozen=True)
class Tie:
    """Mean relation of a node of u and a node of v over their shared frames."""

    u: int
    v: int
    S_v_u: Sim3
    covariance: Array
    """Of x in S_true = S_v_u exp(x), u's units. Shape (7, 7)."""


def relate_frames(u: FrameSamples, v: FrameSamples, edge: Edge, nodes_u: ChunkNodes) -> FrameRelations:
    """Return the relation of every frame that has enough depth in both chunks."""
    at_u, at_v = shared_samples(u, v)
    frames, rows = [], []
    S_u_v = edge.S_v_u.inverse()
    starts = np.searchsorted(u.frame[at_u], u.camera_frames, "left")
    stops = np.searchsorted(u.frame[at_u], u.camera_frames, "right")
    for k in np.flatnonzero(stops - starts >= _LEAST_POINTS).tolist():
        n = int(np.searchsorted(v.camera_frames, u.camera_frames[k]))
        if n == len(v.camera_frames) or v.camera_frames[n] != u.camera_frames[k]:
            continue
        T_u, T_v = u.T_chunk_cam[k], v.T_chunk_cam[n]
        mine = slice(int(starts[k]), int(stops[k]))
        depth_u, depth_v = _depth(T_u, u.points[at_u[mine]]), _depth(T_v, v.points[at_v[mine]])
        known = (depth_u > 0) & (depth_v > 0)
        if known.sum() < _LEAST_POINTS or not (np.isfinite(T_u).all() and np.isfinite(T_v).all()):
            continue
        ratio = float(np.exp(np.median(np.log(depth_v[known] / depth_u[known]))))
        S_v_u = (
            Sim3.from_matrix(T_v) @ Sim3(np.asarray(ratio), np.eye(3), np.zeros(3)) @ Sim3.from_matrix(T_u).inverse()
        )
        node = nodes_u.node[k]
        x = about(-nodes_u.center[node][None])[0] @ (S_u_v @ S_v_u).log()
        x[:3] /= nodes_u.reach[node]
        frames.append(int(u.camera_frames[k]))
        rows.append(x)
    return FrameRelations(np.array(frames, np.int64), np.array(rows).reshape(-1, 7))


def ties_of(
    relations: FrameRelations, edge: Edge, nodes_u: ChunkNodes, nodes_v: ChunkNodes, settings: NodeSettings
) -> list[Tie]:
    """Return the relations averaged over the frames of each node."""
    here = nodes_u.node[np.searchsorted(nodes_u.frames, relations.frames)]
    there = nodes_v.node[np.searchsorted(nodes_v.frames, relations.frames)]
    out = []
    for u, v in np.unique(np.stack([here, there], axis=1), axis=0).tolist():
        x = relations.off[(here == u) & (there == v)]
        middle, scatter = _robust_mean(x)
        variance = 1.5 * scatter**2 / len(x) + settings.common**2 * max(settings.frames, 1) / len(x)
        unit = np.array([nodes_u.reach[u]] * 3 + [1.0] * 4)
        back = about(nodes_u.center[u][None])[0]
        covariance = back @ np.diag(unit**2 * variance) @ back.T
        out.append(Tie(u, v, edge.S_v_u @ Sim3.exp(back @ (unit * middle)), covariance))
    return out


def measured_walk(relations: Sequence[FrameRelations]) -> Array:
    """Return the variance of shift, rotation and log scale that one frame adds in one chunk, from the change of
    relations along overlaps.

    Shares of the depth, radians. Each overlap is cut into thirds; two chunks change independently. Shape (3,), 0 where
    no overlap is long enough.
    """
    found = []
    for r in relations:
        third = len(r.frames) // 3
        if len(r.frames) < _LEAST_FRAMES:
            continue
        middle = np.median(r.off[: 3 * third].reshape(3, third, 7), axis=1)
        time = r.frames[: 3 * third].reshape(3, third).mean(axis=1)
        square = np.diff(middle, axis=0) ** 2 / (2.0 * np.diff(time)[:, None])
        found.append([square[:, :3].mean(), square[:, 3:6].mean(), square[:, 6].mean()])
    return np.mean(found, axis=0) if found else np.zeros(3)


def walk_covariance(nodes: ChunkNodes, first: int, walk: Array) -> Array:
    """Return the covariance of a node's similarity relative to the next one. Shape (7, 7)."""
    pair = slice(first, first + 2)
    center, reach = nodes.center[pair].mean(axis=0), float(nodes.reach[pair].mean())
    back = about(center[None])[0]
    variance = np.repeat(walk * [reach**2, 1.0, 1.0], [3, 3, 1]) * float(nodes.at[first + 1] - nodes.at[first])
    return np.asarray(back @ np.diag(variance) @ back.T)


def _turns(T_chunk_cam: Array, reach: Array, node: Ints) -> Array:
    """Return `ChunkNodes.turns`: the part of each step between two nodes' middle frames, about its camera."""
    starts = np.searchsorted(node, np.arange(int(node.max(initial=0)) + 2))
    if len(starts) < 3:
        return np.zeros((0, 7, 7))
    steps = np.zeros((len(node) - 1, 7))
    steps[:, :3], steps[:, 6] = -T_chunk_cam[:-1, :3, 3], 1.0
    each = lost_scale(T_chunk_cam, reach)[:, None, None] * steps[:, :, None] * steps[:, None, :]
    return np.asarray(np.add.reduceat(each[: (starts[-2] + starts[-1]) // 2], (starts[:-2] + starts[1:-1]) // 2))


def _depth(T_chunk_cam: Array, points: NDArray[np.float32]) -> Array:
    return np.asarray((points - T_chunk_cam[:3, 3]) @ T_chunk_cam[:3, 2])


def _robust_mean(x: Array) -> tuple[Array, Array]:
    """Return the mean of rows without outliers (Cauchy-like weights), and their robust deviation. Shapes (7,)."""
    middle = np.median(x, axis=0)
    scatter = 1.4826 * np.median(np.abs(x - middle), axis=0)
    for _ in range(5):
        off = (x - middle) / (2.0 * 1.4826 * np.median(np.abs(x - middle), axis=0) + 1e-9)
        weight = 1.0 / (1.0 + (off**2).mean(axis=1)) ** 2
        middle = weight @ x / weight.sum()
    return np.asarray(middle), np.asarray(scatter)


def _views(samples: FrameSamples) -> tuple[Array, Array]:
    """Return the centre of the points that each posed frame sees, and its distance. Shapes (G, 3) and (G,)."""
    order = np.argsort(samples.frame, kind="stable")
    points = samples.points[order].astype(np.float64)
    starts = np.searchsorted(samples.frame[order], samples.camera_frames, "left")
    stops = np.searchsorted(samples.frame[order], samples.camera_frames, "right")
    places = samples.T_chunk_cam[:, :3, 3]
    center, reach = places.copy(), np.full(len(starts), np.nan)
    for k in np.flatnonzero(stops - starts >= 5).tolist():
        mine = points[starts[k] : stops[k]]
        mine = mine[np.isfinite(mine).all(axis=1)]
        if len(mine):
            center[k] = np.median(mine, axis=0)
            reach[k] = np.median(np.linalg.norm(mine - places[k], axis=1))
    usual = float(np.nanmedian(reach)) if np.isfinite(reach).any() else 1.0
    return center, np.maximum(np.where(np.isfinite(reach), reach, usual), 1e-9)

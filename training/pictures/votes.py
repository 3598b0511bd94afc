"""What the network on pictures says of pieces and their borders, gathered over all views of a chunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.graph import ChunkSurface, PieceGraph, upright_frame
from training.pictures.images import Pictures, pictures_of
from training.pictures.network import REACHES, PictureNetwork

Float = NDArray[np.float32]

NODE_VOTES, EDGE_VOTES = 5, 12
STRONGEST = 6.0


@dataclass(frozen=True)
class Said:
    """What the network says of the V views of a chunk, at half size."""

    affinity: Float
    """Log odds right and down for each reach, as the network's first outputs. Shape (V, 6, h, w)."""
    structure: Float
    """Log odds. Shape (V, h, w)."""
    middle: Float
    """Where the middle of the pixel's thing is, chunk frame. Shape (V, h, w, 3)."""


def read_network(folder: Path) -> PictureNetwork:
    """Return the network that a fit left in a folder."""
    network = PictureNetwork()
    network.load_state_dict(torch.load(folder / "state.pt", weights_only=True)["network"])
    return network.eval().to(memory_format=torch.channels_last)


@torch.no_grad()
def say(networks: Sequence[PictureNetwork], surface: ChunkSurface) -> Said:
    """Return the mean of what some networks say of the views of a chunk."""
    views = list(surface.views)
    shown: Pictures = pictures_of(views, surface.around.up)
    x = torch.from_numpy(shown.x).contiguous(memory_format=torch.channels_last)
    out = sum(torch.cat([n(x[k : k + 1]) for k in range(len(x))]) for n in networks).numpy() / len(networks)
    middle = []
    for k, view in enumerate(views):
        h, w = out.shape[2:]
        way = out[k, 7:10].transpose(1, 2, 0) * shown.median[k]
        middle.append(view.points[: 2 * h : 2, : 2 * w : 2] + way @ shown.frames[k])
    return Said(np.clip(out[:, :6], -STRONGEST, STRONGEST), out[:, 6], np.stack(middle))


def with_votes(surface: ChunkSurface, labels: NDArray[np.int32], graph: PieceGraph, said: Said) -> PieceGraph:
    """Return the graph with what is said of its pieces (`labels` (N,)) and borders as further features."""
    count = len(graph.nodes)
    table = np.append(labels, -1)
    h, w = said.structure.shape[1:]
    images = np.stack([table[i[: 2 * h : 2, : 2 * w : 2]] for i in surface.cloud.index])
    nodes, middle = _of_pieces(images, said, surface, count, graph)
    edges = _of_borders(images, said, graph, count)
    scale = surface.around.unit
    off = middle[graph.right] - middle[graph.left]
    frame = upright_frame(surface.around.up)
    own = (graph.moments[graph.right, 1:4] - graph.moments[graph.left, 1:4]).astype(np.float64) @ frame * scale
    apart = np.linalg.norm(off, axis=1) / scale
    between = np.linalg.norm(own, axis=1) / scale
    spread = np.maximum(nodes[graph.left, 4], nodes[graph.right, 4])
    more = [np.log(apart + 0.02), np.log((apart + 0.01) / (between + 0.02)), np.minimum(apart / (spread + 0.02), 5.0)]
    return replace(
        graph,
        nodes=np.concatenate([graph.nodes, nodes], axis=1).astype(np.float32),
        edges=np.column_stack([graph.edges, edges, *more]).astype(np.float32),
    )


def _of_pieces(
    images: NDArray[np.int32], said: Said, surface: ChunkSurface, count: int, graph: PieceGraph
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Features of pieces (P, NODE_VOTES) and where the middle of each one's thing is said to be (P, 3)."""
    known = images >= 0
    own = images[known]
    size = np.maximum(np.bincount(own, minlength=count), 1).astype(np.float64)
    mean = lambda v: np.bincount(own, v, minlength=count) / size  # noqa: E731
    flat = mean(np.clip(said.structure[known], -STRONGEST, STRONGEST))
    place = said.middle[known].astype(np.float64)
    middle = np.stack([mean(place[:, k]) for k in range(3)], axis=1)
    spread = np.sqrt(sum(mean((place[:, k] - middle[own, k]) ** 2) for k in range(3))) / surface.around.unit
    frame = upright_frame(surface.around.up)
    seen = np.bincount(own, minlength=count) > 0
    way = np.where(seen[:, None], middle @ frame.T / surface.around.unit - graph.moments[:, 1:4], 0.0)
    level = np.hypot(way[:, 0], way[:, 1])
    return np.column_stack([flat, np.minimum(level, 2), np.clip(way[:, 2], -2, 2), seen, np.minimum(spread, 2)]), middle


def _of_borders(images: NDArray[np.int32], said: Said, graph: PieceGraph, count: int) -> NDArray[np.float64]:
    """Number, mean and share apart of the votes over each reach. Shape (E, 9)."""
    codes = graph.left * count + graph.right
    columns = []
    for k, reach in enumerate(REACHES):
        sums = np.zeros((3, len(codes)))
        for axis in (0, 1):
            vote = said.affinity[:, 2 * k + axis]
            head = (slice(None), slice(None, -reach)) if axis == 0 else (slice(None), slice(None), slice(None, -reach))
            tail = (slice(None), slice(reach, None)) if axis == 0 else (slice(None), slice(None), slice(reach, None))
            a, b, v = images[head].ravel().astype(np.int64), images[tail].ravel().astype(np.int64), vote[head].ravel()
            row = np.flatnonzero((a != b) & (a >= 0) & (b >= 0))
            code = np.minimum(a[row], b[row]) * count + np.maximum(a[row], b[row])
            at = np.minimum(np.searchsorted(codes, code), len(codes) - 1)
            hit = codes[at] == code
            at, v = at[hit], v[row[hit]].astype(np.float64)
            sums[0] += np.bincount(at, minlength=len(codes))
            sums[1] += np.bincount(at, v, minlength=len(codes))
            sums[2] += np.bincount(at, v < 0, minlength=len(codes))
        times = np.maximum(sums[0], 1.0)
        columns += [np.log1p(sums[0]), sums[1] / times, np.where(sums[0] > 0, sums[2] / times, 0.3)]
    return np.column_stack(columns)


def vote_graph(
    surface: ChunkSurface, labels: NDArray[np.int32], said: Said, apart: Sequence[float]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float, Float]:
    """Return pairs of pieces (neighbours or not) over which votes were cast, their mean log odds and their number.

    `apart` is how much more pairs of different things counted in training at each reach.
    """
    count = int(labels.max(initial=-1)) + 1
    table = np.append(labels, -1)
    h, w = said.structure.shape[1:]
    images = np.stack([table[i[: 2 * h : 2, : 2 * w : 2]] for i in surface.cloud.index]).astype(np.int64)
    codes, votes = [], []
    for k, reach in enumerate(REACHES):
        for axis in (0, 1):
            vote = said.affinity[:, 2 * k + axis] + np.float32(np.log(apart[k]))
            head = (slice(None), slice(None, -reach)) if axis == 0 else (..., slice(None, -reach))
            tail = (slice(None), slice(reach, None)) if axis == 0 else (..., slice(reach, None))
            a, b = images[head].ravel(), images[tail].ravel()
            row = np.flatnonzero((a != b) & (a >= 0) & (b >= 0))
            codes.append(np.minimum(a[row], b[row]) * count + np.maximum(a[row], b[row]))
            votes.append(vote[head].ravel()[row])
    code, at = np.unique(np.concatenate(codes), return_inverse=True)
    number = np.bincount(at).astype(np.float32)
    mean = (np.bincount(at, np.concatenate(votes)) / number).astype(np.float32)
    return code // count, code % count, mean, number

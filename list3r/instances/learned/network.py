"""A small message-passing network over a graph of pieces, in NumPy: affinities and classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.learned.graph import PieceGraph

Float = NDArray[np.float32]
Weights = Mapping[str, Float]


@dataclass(frozen=True)
class Classification:
    """A network's outputs for a graph of P pieces and E borders."""

    affinity: Float
    """Log odds that both sides of a border are one object. Shape (E,)."""
    structure: Float
    """Log odds that a piece bounds the room. Shape (P,)."""
    names: Float
    """Log probabilities of the names. Shape (P, C)."""
    hidden: Float
    """Hidden state of each piece. Shape (P, H)."""


def classify(weights: Weights, prefix: str, graph: PieceGraph) -> Classification:
    """Run the network `prefix` of the weights; `training.model.PieceNetwork` is its twin that can be trained."""
    w = _Layers(weights, prefix)
    count = len(graph.nodes)
    source = np.concatenate([graph.right, graph.left])
    target = np.concatenate([graph.left, graph.right])
    sums = _Sums(target, count)
    h = w.two("node", (graph.nodes - w["node_mean"]) / w["node_std"])
    both = np.concatenate([graph.edges, graph.reversed_edges()])
    e = w.two("edge", (both - w["edge_mean"]) / w["edge_std"])
    for k in range(int(w["depth"])):
        layer = f"layers.{k}"
        m = w.linear(f"{layer}.here", h)[target] + w.linear(f"{layer}.there", h)[source] + w.linear(f"{layer}.way", e)
        m = np.maximum(m, 0.0)
        scores = np.concatenate([h, sums.mean(m), sums.most(m)], axis=1)
        h = w.norm(f"{layer}.norm", h + w.two(f"{layer}.update", scores))
        e = w.norm(f"{layer}.edge_norm", e + w.linear(f"{layer}.edge_update", m))
    half = len(graph.left)
    a, b = h[graph.left], h[graph.right]
    pair = np.concatenate([e[:half] + e[half:], a + b, np.abs(a - b)], axis=1)
    heads = w.linear("node_head", h)
    names = heads[:, 1:]
    names = names - names.max(axis=1, keepdims=True)
    names = names - np.log(np.exp(names).sum(axis=1, keepdims=True))
    return Classification(w.two("pair_head", pair)[:, 0], heads[:, 0], names, h)


def two_layers(weights: Weights, name: str, x: Float) -> Float:
    """Apply a hidden layer and a linear one to x. Shape (N, D) -> (N, O)."""
    h = np.maximum(x @ weights[f"{name}.0.weight"].T + weights[f"{name}.0.bias"], 0.0)
    return np.asarray(h @ weights[f"{name}.2.weight"].T + weights[f"{name}.2.bias"], np.float32)


class _Layers:
    """The layers of one network by name."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        self._weights, self._prefix = weights, prefix

    def __getitem__(self, name: str) -> Float:
        return self._weights[f"{self._prefix}.{name}"]

    def linear(self, name: str, x: Float) -> Float:
        return np.asarray(x @ self[f"{name}.weight"].T + self[f"{name}.bias"], np.float32)

    def two(self, name: str, x: Float) -> Float:
        return self.linear(f"{name}.2", np.maximum(self.linear(f"{name}.0", x), 0.0))

    def norm(self, name: str, x: Float) -> Float:
        x = x - x.mean(axis=1, keepdims=True)
        x = x / np.sqrt((x * x).mean(axis=1, keepdims=True) + np.float32(1e-5))
        return np.asarray(x * self[f"{name}.weight"] + self[f"{name}.bias"], np.float32)


class _Sums:
    """Means and maxima of the messages to each piece."""

    def __init__(self, target: NDArray[np.int64], count: int) -> None:
        self._order = np.argsort(target, kind="stable")
        self._there, self._start, size = np.unique(target[self._order], return_index=True, return_counts=True)
        self._size, self._count = size.astype(np.float32)[:, None], count

    def mean(self, m: Float) -> Float:
        total = np.add.reduceat(m[self._order], self._start)
        return self._spread(np.asarray(total / self._size, np.float32), m)

    def most(self, m: Float) -> Float:
        return self._spread(np.maximum.reduceat(m[self._order], self._start), m)

    def _spread(self, values: Float, m: Float) -> Float:
        out = np.zeros((self._count, m.shape[1]), np.float32)
        out[self._there] = values
        return out

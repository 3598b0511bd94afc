"""The network over pieces in torch, to be trained; `list3r.instances.learned.network` runs it in NumPy."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def _two(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


class _Layer(nn.Module):
    """One round of messages."""

    def __init__(self, node: int, edge: int, dropout: float) -> None:
        super().__init__()
        self.drop = nn.Dropout(dropout)
        self.here, self.there, self.way = nn.Linear(node, node), nn.Linear(node, node), nn.Linear(edge, node)
        self.update, self.norm = _two(3 * node, node, node), nn.LayerNorm(node)
        self.edge_update, self.edge_norm = nn.Linear(node, edge), nn.LayerNorm(edge)

    def forward(self, h: Tensor, e: Tensor, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        m = torch.relu(self.here(h)[target] + self.there(h)[source] + self.way(e))
        size = h.new_zeros(len(h), 1).index_add_(0, target, h.new_ones(len(target), 1)).clamp(min=1)
        mean = torch.zeros_like(h).index_add_(0, target, m) / size
        most = torch.zeros_like(h).scatter_reduce(0, target[:, None].expand_as(m), m, "amax", include_self=True)
        h = self.norm(h + self.drop(self.update(torch.cat([h, mean, most], 1))))
        return h, self.edge_norm(e + self.edge_update(m))


class PieceNetwork(nn.Module):
    """Affinity of neighbours, structure and name of each piece."""

    def __init__(
        self,
        node_features: int,
        edge_features: int,
        names: int,
        *,
        node: int = 32,
        edge: int = 24,
        depth: int = 3,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.register_buffer("node_mean", torch.zeros(node_features))
        self.register_buffer("node_std", torch.ones(node_features))
        self.register_buffer("edge_mean", torch.zeros(edge_features))
        self.register_buffer("edge_std", torch.ones(edge_features))
        self.register_buffer("depth", torch.tensor(depth))
        self.node, self.edge = _two(node_features, node, node), _two(edge_features, edge, edge)
        self.layers = nn.ModuleList(_Layer(node, edge, dropout) for _ in range(depth))
        self.pair_head = _two(edge + 2 * node, node, 1)
        self.node_head = nn.Linear(node, 1 + names)

    def forward(
        self, nodes: Tensor, left: Tensor, right: Tensor, edges: Tensor, back: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return log odds of affinity (E,), of structure (P,), logits of names (P, C) and the hidden state (P, H)."""
        source, target = torch.cat([right, left]), torch.cat([left, right])
        h = self.node((nodes - self.node_mean) / self.node_std)
        e = self.edge((torch.cat([edges, back]) - self.edge_mean) / self.edge_std)
        for layer in self.layers:
            h, e = layer(h, e, source, target)
        a, b, half = h[left], h[right], len(left)
        pair = torch.cat([e[:half] + e[half:], a + b, (a - b).abs()], 1)
        heads = self.node_head(h)
        return self.pair_head(pair)[:, 0], heads[:, 0], heads[:, 1:], h

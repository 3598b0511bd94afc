"""Spread a map's drift over its frames by the accepted revisits: a graph of similarities, one per frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import GraphProblem
from list3r.association.whole_map.revisits import Revisit
from list3r.association.whole_map.settings import DriftSettings
from list3r.association.whole_map.views import MapView
from list3r.memory.core.geometry import Sim3, stack

Array = NDArray[np.float64]


def spread_drift(
    views: Sequence[MapView], revisits: Sequence[Revisit], settings: DriftSettings
) -> tuple[dict[int, Array], list[Revisit]]:
    """Return T_map_cam of the views by key, the first unchanged, and the accepted revisits."""
    count, steps = len(views), len(views) - 1
    poses = stack([Sim3.from_matrix(v.T_map_cam) for v in views])
    relations = [Sim3.from_matrix(np.linalg.inv(b.T_map_cam) @ a.T_map_cam) for a, b in pairwise(views)]
    u = np.array([*range(steps), *(r.a for r in revisits)], np.int64)
    v = np.array([*range(1, count), *(r.b for r in revisits)], np.int64)
    sigma = np.repeat(np.array([settings.step] * steps + [settings.revisit] * len(revisits)), [3, 3, 1], axis=1)
    sigma[:, :3] *= np.array([views[k].depth for k in u])[:, None]
    S_v_u = stack([*relations, *(r.S_b_a for r in revisits)])
    problem = GraphProblem.build(u, v, S_v_u, np.eye(7) / sigma[:, None, :] ** 2, np.arange(count) == 0)
    trust = np.ones(len(u))
    for _ in range(settings.rounds):
        poses = problem.solve(poses, trust, 20)
        off = problem.squares(poses)[steps:] / 7.0
        trust[steps:] = 1.0 / (1.0 + off / settings.gate**2) ** 2
    rigid = Sim3(np.ones(count), poses.rotation, poses.translation).as_matrix()
    believed = [r for r, t in zip(revisits, trust[steps:].tolist(), strict=True) if t >= settings.least_trust]
    return {view.key: rigid[k] for k, view in enumerate(views)}, believed

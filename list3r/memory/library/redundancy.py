"""Local instances that add nothing to what earlier chunks of their session saw.

A camera that stays in one room comes to the same things again and again. As ORB-SLAM (IEEE T-RO 2015) culls keyframes
whose points enough other keyframes see, a local instance is redundant whose surface enough earlier chunks of its
session saw, as one thing or in pieces: it counts among the observations of the instance that it is like, and nothing
else is derived from it. So a chunk costs what is new in it, not how often its place was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from list3r.memory.library.merging.edges import NONE, links_of
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairScores, PairTable
from list3r.memory.library.overlap.voxels import Ints
from list3r.memory.library.scene import Scene


@dataclass(frozen=True)
class Redundant:
    """What is left out, and where it belongs."""

    like: Mapping[Key, Key]
    """Leads from each redundant local instance to one of another chunk that is the same instance; to itself where there
    is none."""
    whole: frozenset[int]
    """Chunks of which nothing is left."""


def find_redundant(scene: Scene) -> Redundant:
    """Go through the chunks in order. What moves is not redundant, nor what an operator parted from what it is like."""
    settings, like, whole = scene.settings.redundancy, dict[Key, Key](), set[int]()
    if settings.chunks == 0:
        return Redundant({}, frozenset())
    for k in scene.rows:
        session = scene.session(k)
        earlier = [u for u in scene.near[k] if u < k and u not in whole and scene.session(u) == session]
        if len(earlier) < settings.chunks:
            continue
        shapes = scene.shapes(k)
        spared = [(k, n) in scene.motions for n in shapes.local_id.tolist()]
        empty = np.bincount(shapes.owner, minlength=len(spared)) == 0
        times, met = np.where(spared, -len(earlier), settings.chunks * empty), dict[int, PairScores]()
        for left, u in zip(range(len(earlier), 0, -1), reversed(earlier), strict=True):
            if not ((times < settings.chunks) & (times + left >= settings.chunks)).any():
                break
            p = scene.scores.of(u, k)
            stays = np.array([(u, n) not in like for n in scene.shapes(u).local_id.tolist()])
            met[u] = p.only(stays[p.i])
            share = np.bincount(met[u].j, met[u].j_on_i, minlength=len(times))
            times += share >= settings.covered
        found = np.flatnonzero(times >= settings.chunks)
        best = _most_like(scene, k, found, met)
        fresh = {(k, n): best.get(n, (k, n)) for n in shapes.local_id[found].tolist()}
        fresh = {key: other for key, other in fresh.items() if not _parted(scene, key, other)}
        like |= fresh
        if len(fresh) == len(times):
            whole.add(k)
    return Redundant(like, frozenset(whole))


def _parted(scene: Scene, key: Key, like: Key) -> bool:
    """Return whether an operator parted a local instance from what it is like, or spoke of one that is like nothing."""
    return scene.constraints.links.forbids(key, like) or (key == like and scene.constraints.speaks_of(key))


def _most_like(scene: Scene, k: int, wanted: Ints, met: Mapping[int, PairScores]) -> dict[int, Key]:
    """Return the local instances of other chunks that some of a chunk are most like, by local id."""
    if not len(wanted):
        return {}
    shapes = {u: scene.shapes(u) for u in (*met, k)}
    ordered = [shapes[u] for u in sorted(shapes)]
    nodes, numbering = Nodes.of(ordered, {u: scene.pose(u) for u in shapes}), Numbering(shapes)
    pairs = {(u, k): p.only(np.isin(p.j, wanted)) for u, p in met.items()}
    links = links_of(nodes, PairTable.of(pairs, numbering), scene.settings.merging)
    best: dict[int, tuple[float, Key]] = {}
    for n in np.flatnonzero(links.kind != NONE).tolist():
        found = float(links.score[n]), numbering.keys[links.a[n]]
        local_id = numbering.keys[links.b[n]][1]
        best[local_id] = max(found, best.get(local_id, found))
    return {local_id: key for local_id, (_, key) in best.items()}

"""Local instances that add nothing to what earlier chunks of their session saw.

A camera that stays in one room comes to the same things again and again. As ORB-SLAM (IEEE T-RO 2015) culls keyframes
whose points enough other keyframes see, a local instance is redundant whose surface enough earlier chunks of its
session saw, as one thing or in pieces: it counts among the observations of the instance that it is like, and nothing
else is derived from it. So a chunk costs what is new in it, not how often its place was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from list3r.memory.library.merging.edges import NONE, links_of
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairScores, PairTable
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
        meets = {(u, k): p.only(np.isin(p.j, found)) for u, p in met.items()} if len(found) else {}
        best = most_like(scene, k, meets) if meets else {}
        fresh = {(k, n): best.get((k, n), (k, n)) for n in shapes.local_id[found].tolist()}
        fresh = {key: other for key, other in fresh.items() if not _parted(scene, key, other)}
        like |= fresh
        if len(fresh) == len(times):
            whole.add(k)
    return Redundant(like, frozenset(whole))


def _parted(scene: Scene, key: Key, like: Key) -> bool:
    """Return whether an operator parted a local instance from what it is like, or spoke of one that is like nothing."""
    return scene.constraints.links.forbids(key, like) or (key == like and scene.constraints.speaks_of(key))


def most_like(
    scene: Scene,
    chunk_id: int,
    overlaps: Mapping[tuple[int, int], PairScores],
    apart: Callable[[Key, Key], bool] = lambda own, other: False,
) -> dict[Key, Key]:
    """Return what of other chunks each local instance of a chunk is most like, of what it is not `apart` from."""
    shapes = {k: scene.shapes(k) for k in sorted({k for pair in overlaps for k in pair})}
    numbering, nodes = Numbering(shapes), Nodes.of([*shapes.values()], {k: scene.pose(k) for k in shapes})
    links = links_of(nodes, PairTable.of(overlaps, numbering), scene.settings.merging)
    best: dict[Key, tuple[float, Key]] = {}
    for n in np.flatnonzero(links.kind != NONE).tolist():
        a, b = numbering.keys[links.a[n]], numbering.keys[links.b[n]]
        own, other = (a, b) if a[0] == chunk_id else (b, a)
        if other[0] != chunk_id and not apart(own, other):
            found = float(links.score[n]), other
            best[own] = max(found, best.get(own, found))
    return {own: other for own, (_, other) in best.items()}

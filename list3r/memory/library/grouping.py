"""Which local instances are one instance: by overlap, by what was seen of their motion, by what operators said."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from list3r.memory.core.records import MergeDecision
from list3r.memory.library.merging.edges import form_groups, links_of
from list3r.memory.library.merging.movers import Mover, join_movers
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairScores, PairTable
from list3r.memory.library.scene import Scene
from list3r.memory.library.scores import Pair

Group = tuple[Key, ...]


@dataclass(frozen=True)
class Groups:
    """The local instances of a memory, grouped."""

    groups: list[Group]
    """Each in order, ordered by their first members."""
    movers: Mapping[Key, Mover]
    """What is known of those that move, by their first members."""
    decisions: list[MergeDecision]


def group(scene: Scene, overlaps: Mapping[Pair, PairScores], left_out: Collection[Key]) -> Groups:
    """Group all local instances but some: edges of overlap are joined best first (paper 3.3, with complete links)."""
    chunks, settings = sorted(scene.rows), scene.settings
    shapes = {k: scene.shapes(k) for k in chunks}
    nodes = Nodes.of([shapes[k] for k in chunks], {k: scene.pose(k) for k in chunks})
    links = links_of(nodes, PairTable.of(overlaps, Numbering(shapes)), settings.merging)
    apart = [((k, int(a)), (k, int(b))) for k in chunks for a, b in scene.summaries[k].cannot_link]
    found, decisions = form_groups(nodes, links, apart, settings.merging, scene.constraints)
    groups = [g for g in found if g[0] not in left_out]
    movers: dict[Key, Mover] = {}
    if scene.motions:
        apart += scene.constraints.pairs_apart(scene.motions)
        groups, movers, joins = join_movers(groups, scene.placed(), apart, scene.tracks(), settings.moving)
        decisions += joins
    groups, movers = scene.constraints.joined(groups, {k: scene.component(k) for k in chunks}, movers)
    return Groups([tuple(g) for g in groups], movers, decisions)


def chunks_of(groups: Sequence[Sequence[Key]]) -> list[int]:
    """Return the chunks that hold a member of some groups, in order."""
    return sorted({k for g in groups for k, _ in g})

"""Find the shortest path between two instances in the relation graph."""

from __future__ import annotations

import itertools

from list3r.memory.core.records import Relation
from list3r.memory.library.relations.predicates import INVERSE, PREDICATES
from list3r.memory.store.store import Store
from list3r.queries.match import checked_instance
from list3r.queries.relations import Relations

_TELLING = ("in", "contains", "on", "supports", "attached_to", "under", "above", "below", "between", "next_to", "near")
"""Predicates from the most to the least specific: of two relations between the same instances the first is given."""


def path(store: Store, start: int, end: int, *, structure: bool = True) -> Relations:
    """Return the fewest relations that lead from one instance to another, in order; of equally short paths the surest.

    Where a step is stored only in the other direction and has an inverse, the inverse is given; where it has none
    (`under`, `attached_to`), the relation as it is stored, whose object then comes first on the path. Empty with a
    `reason` where there is no path. Without `structure` the path does not lead over floor and walls, which nearly
    everything stands on. Raises `UnknownIdError`.
    """
    import networkx

    a, b = checked_instance(store, start), checked_instance(store, end)
    if a.id == b.id:
        return Relations([], "known", f"both are #{a.id}")
    graph = networkx.Graph()
    usable = {i.id for i in store.instances.all() if structure or i.structure is None} | {a.id, b.id}
    best: dict[frozenset[int], Relation] = {}
    for r in store.relations.all():
        if r.subject not in usable or r.object not in usable or r.subject == r.object:
            continue
        key = frozenset((r.subject, r.object))
        if key not in best or telling(r) < telling(best[key]):
            best[key] = r
            # One more hop costs more than any doubt saved: confidences decide only among ways equally long.
            graph.add_edge(r.subject, r.object, weight=1.0 + 1e-6 * (1.0 - r.confidence))
    try:
        way = networkx.shortest_path(graph, a.id, b.id, weight="weight")
    except (networkx.NetworkXNoPath, networkx.NodeNotFound):
        apart = a.component != b.component
        why = "they are in different connected components" if apart else "no relations connect them"
        return Relations([], "known", f"no path from #{a.id} to #{b.id}: {why}")
    steps = [_forward(best[frozenset((s, o))], s) for s, o in itertools.pairwise(way)]
    return Relations(steps, "known", f"{len(steps)} step{'s' if len(steps) > 1 else ''}")


def telling(r: Relation) -> tuple[int, float, int]:
    """Return a key that sorts relations from the most specific and surest to the least."""
    known = _TELLING.index(r.predicate) if r.predicate in _TELLING else len(_TELLING) + (r.predicate in PREDICATES)
    return known, -r.confidence, r.subject


def _forward(r: Relation, subject: int) -> Relation:
    """Return the relation with this subject where it has an inverse."""
    if r.subject == subject or r.predicate not in INVERSE:
        return r
    return Relation(r.object, INVERSE[r.predicate], r.subject, r.confidence, r.margin)

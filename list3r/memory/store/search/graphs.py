"""The memory as networkx graphs: derived, never stored."""

from __future__ import annotations

from typing import TYPE_CHECKING

from list3r.memory.store.store import Store

if TYPE_CHECKING:
    import networkx


def relation_graph(store: Store) -> networkx.MultiDiGraph:
    """Return instances as nodes (attributes: description, label, center, size, structure, confidence, state), relations
    as edges from subject to object, keyed by predicate (attributes: predicate, confidence, margin).
    """
    import networkx

    graph = networkx.MultiDiGraph(name=str(store.path.name))
    for i in store.instances.all():
        graph.add_node(
            i.id,
            description=i.description,
            label=i.label,
            center=tuple(float(x) for x in i.center),
            size=tuple(float(x) for x in i.box.size),
            structure=i.structure,
            confidence=i.confidence,
            state=i.state,
        )
    for r in store.relations.all():
        graph.add_edge(
            r.subject, r.object, key=r.predicate, predicate=r.predicate, confidence=r.confidence, margin=r.margin
        )
    return graph


def merge_graph(store: Store) -> networkx.Graph:
    """Return local instances as nodes named `chunk:local` (attribute: instance), the merges that hold as edges.

    Edges carry the scores and the reason of the log. A merge is left out when its two sides have come apart since;
    the connected components are then the instances, as far as the log tells how they came about.
    """
    import networkx

    graph = networkx.Graph(name=str(store.path.name))
    for o in store.observations.all():
        graph.add_node(f"{o.chunk_id}:{o.local_id}", instance=o.instance_id, chunk=o.chunk_id, local=o.local_id)
    for d in store.merges.decisions():
        both = d.kind == "merge" and d.a in graph and d.b in graph
        if both and graph.nodes[d.a]["instance"] == graph.nodes[d.b]["instance"]:
            graph.add_edge(d.a, d.b, reason=d.reason, **d.scores)
    return graph

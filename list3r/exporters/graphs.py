"""Write the graph of relations and the graph of merges as GraphML or as node-link JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.exporters.output import part_path, write_together
from list3r.memory.core.description.printable import shown
from list3r.memory.store.search.graphs import merge_graph, relation_graph
from list3r.memory.store.store import Store

if TYPE_CHECKING:
    import networkx

Write = Callable[["networkx.Graph", Path], None]


def write_graphml(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write instances and relations to `path`, local instances and merges to `NAME.merges.graphml`; return both files.

    Unknown values have no attribute. Vectors are an attribute for each number (`center_x`); edges have an `id`.
    """
    return _write_both(store, Path(path), _write_graphml)


def write_node_link(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write the same graphs in the node-link form of networkx and D3: `nodes` with `id`, `edges` with `source` and
    `target`. Unknown values are left out.
    """
    return _write_both(store, Path(path), _write_node_link)


def _write_both(store: Store, path: Path, write: Write) -> tuple[Path, ...]:
    graphs = {path: relation_graph(store), part_path(path, "merges"): merge_graph(store)}
    return write_together(graphs.items(), write)


def _write_graphml(graph: networkx.Graph, path: Path) -> None:
    import networkx

    plain = graph.__class__(name=shown(graph.graph.get("name", "")))
    for node, facts in graph.nodes(data=True):
        plain.add_node(node, **_scalars(facts))
    for number, (a, b, facts) in enumerate(graph.edges(data=True)):
        plain.add_edge(a, b, **{**_scalars(facts), "id": f"e{number}"})
    networkx.write_graphml_xml(plain, path, edge_id_from_attribute="id")


def _write_node_link(graph: networkx.Graph, path: Path) -> None:
    nodes = ({"id": node, **_known(facts)} for node, facts in graph.nodes(data=True))
    edges = ({"source": a, "target": b, **_known(facts)} for a, b, facts in graph.edges(data=True))
    kind = {"directed": graph.is_directed(), "multigraph": graph.is_multigraph(), "graph": graph.graph}
    with path.open("w", encoding="utf-8") as file:
        file.write(json.dumps(kind)[:-1])
        for name, items in (("nodes", nodes), ("edges", edges)):
            lines = (json.dumps(item, ensure_ascii=False, allow_nan=False) for item in items)
            file.write(f', "{name}": [\n' + ",\n".join(lines) + "\n]")
        file.write("}\n")


def _known(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that are known: neither None nor a number that is none."""
    known = {}
    for name, value in facts.items():
        numbers = value if isinstance(value, tuple) else (value,)
        if all(v is not None and not (isinstance(v, float) and not math.isfinite(v)) for v in numbers):
            known[name] = value
    return known


def _scalars(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the known attributes as texts that XML takes and single numbers."""
    out: dict[str, Any] = {}
    for name, value in _known(facts).items():
        if isinstance(value, tuple):
            out |= {f"{name}_{axis}": v for axis, v in zip("xyz", value, strict=True)}
        else:
            out[name] = shown(value) if isinstance(value, str) else value
    return out

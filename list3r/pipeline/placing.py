"""Where all chunks lie: the pose graph is solved, the world is set upright, and every placement is written."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.chunk_nodes import NodeSettings
from list3r.association.graph.incremental import extend
from list3r.association.graph.node_graph import bend_chunks
from list3r.association.graph.pose_graph import GraphResult, optimize
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.graph.surface_graph import place_by_surfaces
from list3r.association.overlap.camera_edge import in_one_frame
from list3r.association.revisits.session_edges import defer_session_edges
from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Edge
from list3r.memory.library.world.gravity import estimate_gravity, world_from_graph
from list3r.memory.library.world.guess import GUESS, guess_metre
from list3r.memory.library.world.held import parse_up
from list3r.memory.library.world.scale import write_scale
from list3r.memory.library.world.session_ties import counted_once
from list3r.memory.store.store import Store
from list3r.pipeline.settings import AssociationSettings, session_settings
from list3r.reconstruction.registry import MODELS

T = TypeVar("T")

_BENT_TOGETHER = 3
"""Chunks that tell how a new one lies to the one before."""


def place_chunks(
    store: Store, settings: AssociationSettings | None = None, new: int | None = None, *, bend: bool = False
) -> None:
    """Optimise the graph, find which way is up, and write where every chunk lies.

    With the id of a `new` chunk in a long video only what that chunk touches is solved; `finish_session` solves all.
    With `bend` it is also found how each chunk bends. Chunks that hold nothing take no part: they come to lie
    where their neighbour does.
    """
    how = settings or AssociationSettings()
    blank = store.chunks.blank()
    chunks = [c for c in store.chunks.all() if c.chunk_id not in blank]
    if new in blank or not chunks:
        _place_blank(store, blank)
        return
    measured = store.edges.all()
    session_of = {c.chunk_id: c.session_id for c in store.chunks.all()}
    edges = defer_session_edges(measured, session_of, _metre(chunks), how.ties)
    ids = [c.chunk_id for c in chunks]
    metric = all(c.scale_kind == "metric" for c in chunks)
    fitted = new is not None and len(chunks) > how.solved_whole
    once = counted_once(edges, session_of)
    turning = set() if metric else _turning(store, chunks, once)
    weighed = _turned(store, once, turning, how.nodes, new if fitted else None)
    if new is not None and fitted:
        graph = extend(new, ids, weighed, _placed(store, chunks, weighed, new), metric, how.graph)
    else:
        graph = optimize(ids, weighed, _graph_poses(store), metric=metric, settings=how.graph)
    graph = _with_covariances(graph, once) if turning else graph
    judged = [_as_stated(after, own) for after, own in zip(graph.edges, edges, strict=True)]
    store.edges.add(after for before, after in zip(measured, judged, strict=True) if after is not before)
    if bend:
        graph = _straightened(store, graph, chunks, metric, how, turning)
    elif new is not None and how.nodes.enabled:
        _look_ahead(store, graph, new, metric, how)
        if fitted and metric:
            graph = _as_bent(store, graph, new, how)
    known = {} if store.facts.poses == "given" else graph.covariances
    settled = store.facts.gravity != "unknown" or len(chunks) % how.up_again
    if fitted and len(chunks) > how.up_always and settled:
        _place_fitted(store, graph, known)
        return
    stated_up = _stated_up(store, graph, chunks)
    apart = {**graph.components, **{k: k for k in blank}}
    gravity = estimate_gravity(store, graph.S_graph_chunk, apart, stated_up=stated_up, rule=_rule(store))
    upright = world_from_graph(gravity)
    rows = [replace(c, component=graph.components[c.chunk_id]) for c in chunks]
    if bend and how.guess_metre:
        main = [c for c in rows if c.component == min(graph.components.values())]
        store.facts[GUESS] = guess_metre(store, main, graph.S_graph_chunk, gravity)
    metre = write_scale(store, rows, graph.S_graph_chunk)
    S_world_graph = metre @ upright
    store.facts.S_world_graph = S_world_graph
    # To the digits that a deviation has: the last ones of a float64 differ from run to run.
    deviation = None if gravity.deviation_deg is None else round(gravity.deviation_deg, 3)
    store.facts.gravity, store.facts.gravity_deviation_deg = gravity.status, deviation
    stood = _parts_upright(store, graph, apart, metre) if bend else {}
    store.facts.upright_parts = tuple(stood)
    placed = {k: stood.get(graph.components[k], S_world_graph) @ graph.S_graph_chunk[k] for k in ids}
    store.chunks.place(placed, graph.components, known)
    _place_blank(store, blank)


def _parts_upright(store: Store, graph: GraphResult, apart: Mapping[int, int], metre: Sim3) -> dict[int, Sim3]:
    """S_world_graph of the parts that are not joined to the first, of those whose own surfaces tell up.

    Each lies anyhow, and how its cameras were held is not enough: a stretch between two bare walls is short.
    """
    parts = sorted(set(graph.components.values()))[1:]
    rule = _rule(store)
    found = {k: estimate_gravity(store, graph.S_graph_chunk, apart, rule=rule, component=k) for k in parts}
    return {k: metre @ world_from_graph(up) for k, up in found.items() if up.status == "estimated"}


def _place_blank(store: Store, blank: Collection[int]) -> None:
    """Let chunks that hold nothing lie with the one before in their session, or else the one behind.

    So they are no part of the world that could not be joined to the others.
    """
    beside: dict[int, ChunkRow] = {}
    for session in store.sessions.all() if blank else ():
        rows = store.chunks.all(session.session_id)
        near = next((c for c in rows if c.chunk_id not in blank), None)
        for row in rows:
            near = near if row.chunk_id in blank else row
            if row.chunk_id in blank and near is not None:
                beside[row.chunk_id] = near
    poses = {k: c.S_world_chunk for k, c in beside.items()}
    store.chunks.place(poses, {k: c.component for k, c in beside.items()})


def _turning(store: Store, chunks: Sequence[ChunkRow], edges: Sequence[Edge]) -> set[int]:
    """Chunks that structure from motion mapped one by one, which lose scale where their camera turns."""
    follow = {k: knows_cameras(store, k) and not poses_given(store, k) for k in {c.session_id for c in chunks}}
    alone = {c.chunk_id for c in chunks if c.scale_kind != "metric" and follow[c.session_id]}
    return alone - {chunk for e in edges if in_one_frame(e) for chunk in (e.u, e.v)}


def _turned(
    store: Store, edges: Sequence[Edge], turning: Collection[int], nodes: NodeSettings, only: int | None
) -> Sequence[Edge]:
    """The edges, or `only` those of one chunk, with the scale that is lost where the camera turned."""
    if not turning:
        return edges
    samples = SampledChunks.of(store)
    return [samples.turned(e, turning, nodes.frames) if only is None or only in (e.u, e.v) else e for e in edges]


def _with_covariances(graph: GraphResult, stated: Sequence[Edge]) -> GraphResult:
    """The graph whose edges have the covariances of others."""
    return replace(graph, edges=tuple(_as_stated(e, own) for e, own in zip(graph.edges, stated, strict=True)))


def _as_stated(judged: Edge, own: Edge) -> Edge:
    """An edge as the graph judged it, with the covariance that it states itself."""
    return judged if judged.covariance is own.covariance else replace(judged, covariance=own.covariance)


def _place_fitted(store: Store, graph: GraphResult, covariances: Mapping[int, NDArray[np.float64]]) -> None:
    """Write where the new chunk lies, and those that moved for it, in the world as it stands."""
    store.facts.upright_parts = ()  # until the end of the session: parts may have become one
    S_world_graph = store.facts.S_world_graph
    layers = graph.S_graph_chunk.maps if isinstance(graph.S_graph_chunk, ChainMap) else [graph.S_graph_chunk]
    moved = sorted({k for layer in layers if isinstance(layer, dict) for k in layer})
    store.chunks.place({k: S_world_graph @ graph.S_graph_chunk[k] for k in moved}, graph.components, covariances)


def _straightened(
    store: Store,
    graph: GraphResult,
    chunks: Sequence[ChunkRow],
    metric: bool,
    how: AssociationSettings,
    turning: Collection[int],
) -> GraphResult:
    """The graph with the bending of chunks undone; chunks whose poses were given do not bend, nor do those that were
    mapped together."""
    given = {s.session_id for s in store.sessions.all() if poses_given(store, s.session_id)}
    rigid = {c.chunk_id for c in chunks if c.session_id in given}
    rigid |= {chunk for e in graph.edges if in_one_frame(e) for chunk in (e.u, e.v)}
    bends: dict[int, Bend] = {}
    if len(rigid) < len(chunks):
        graph, bends = bend_chunks(SampledChunks.of(store), graph, rigid, metric, how.nodes, how.graph, turning)
    if not metric and not rigid and all(knows_cameras(store, k) for k in {c.session_id for c in chunks}):
        graph, bends = place_by_surfaces(SampledChunks.of(store), graph, bends, how.surfaces)
    store.bends.replace(bends)
    return graph


def _look_ahead(store: Store, graph: GraphResult, new: int, metric: bool, how: AssociationSettings) -> None:
    """Find what the samples of a new chunk tell of how it and the one before bend while they are at hand, so that the
    end of the session has them all."""
    samples = SampledChunks.of(store)
    adjacent = (e for e in graph.edges if e.v == new and e.kind == "adjacent" and e.accepted and not in_one_frame(e))
    for edge in adjacent:
        if not poses_given(store, store.chunks.get(new).session_id):
            found = samples.relations(edge, how.nodes.frames)
            nodes = samples.nodes(edge.u, how.nodes.frames), samples.nodes(new, how.nodes.frames)
            samples.ties(edge, found.rigid() if metric else found, nodes, how.nodes)


def _as_bent(store: Store, graph: GraphResult, new: int, how: AssociationSettings) -> GraphResult:
    """The graph with a new chunk that hangs on the one before alone where it will lie when all chunks bend.

    How two neighbours lie to each other then is told by them and the one before to some micrometres; so the end of a
    long session finds the chunks where they are (decision 0156).
    """
    mine = [e for e in graph.edges if new in (e.u, e.v) and e.accepted]
    if len(mine) != 1 or mine[0].kind != "adjacent" or poses_given(store, store.chunks.get(new).session_id):
        return graph
    known = {e.v: e for e in graph.edges if e.kind == "adjacent" and e.accepted and not in_one_frame(e)}
    chain = [new]
    while len(chain) < _BENT_TOGETHER and (edge := known.get(chain[0])) is not None:
        chain.insert(0, edge.u)
    if len(chain) < 2:
        return graph
    start = {chain[0]: Sim3.identity()}  # not where they lie, whose rounding would grow from chunk to chunk
    for k in chain[1:]:
        start[k] = start[known[k].u] @ known[k].S_v_u.inverse()
    part = GraphResult(
        S_graph_chunk=start,
        components=dict.fromkeys(chain, chain[0]),
        edges=tuple(known[k] for k in chain[1:]),
        residual=1.0,
        covariances={},
    )
    S, here = bend_chunks(SampledChunks.of(store), part, (), True, how.nodes, how.graph)[0].S_graph_chunk, chain[-2]
    placed = graph.S_graph_chunk[here] @ S[here].inverse() @ S[new]
    layers = graph.S_graph_chunk.maps if isinstance(graph.S_graph_chunk, ChainMap) else [dict(graph.S_graph_chunk)]
    return replace(graph, S_graph_chunk=ChainMap({new: placed}, *layers))


def _stated_up(store: Store, graph: GraphResult, chunks: Sequence[ChunkRow]) -> NDArray[np.float64] | None:
    """Up in the graph's frame (3,), as chunks say whose frame has z up by their source, or as the user says; None where
    nobody knows."""
    asked = {s.session_id: session_settings(s).up for s in store.sessions.all()}
    main = min(graph.components.values(), default=0)
    rows = [c for c in chunks if graph.components[c.chunk_id] == main]
    ups = [graph.S_graph_chunk[c.chunk_id].rotation[:, 2] for c in rows if asked[c.session_id] == "source"]
    for session, text in asked.items():
        if text not in ("planes", "source", "camera", "unknown"):
            first = next((c for c in rows if c.session_id == session), None)
            ups += [] if first is None else [graph.S_graph_chunk[first.chunk_id].rotation @ _said(store, first, text)]
    total = np.sum(ups, axis=0) if ups else np.zeros(3)
    length = float(np.linalg.norm(total))
    return None if length < 1e-6 else np.asarray(total / length)


def _said(store: Store, chunk: ChunkRow, text: str) -> NDArray[np.float64]:
    """A direction (3,) that a user gave, in a chunk's frame: of the world of given poses, else of its first camera."""
    up = parse_up(text)
    assert up is not None
    T_chunk_cam = next(f.T_chunk_cam for f in store.frames.of(chunk) if f.state == "posed")
    return up if poses_given(store, chunk.session_id) else np.asarray(T_chunk_cam[:3, :3] @ up)


def _rule(store: Store) -> str:
    """What is to tell up where nobody said it: planes, camera or unknown, as the first session was asked for."""
    first = min(store.sessions.all(), key=lambda s: s.session_id)
    rule = session_settings(first).up
    return rule if rule in ("camera", "unknown") else "planes"


def _metre(chunks: Sequence[ChunkRow]) -> float:
    """What a metre is in the graph's units, where that is known; else nothing is asked of lengths."""
    return 1.0 if all(c.scale_kind == "metric" for c in chunks) else float("inf")


def _placed(store: Store, chunks: Sequence[ChunkRow], edges: Sequence[Edge], new: int) -> GraphResult:
    """The graph as it was solved before the new chunk came, looked up where it is asked for."""
    rows = {c.chunk_id: c for c in chunks if c.chunk_id != new}
    T_graph_world = store.facts.S_world_graph.inverse()
    return GraphResult(
        S_graph_chunk=_Of(rows, lambda c: T_graph_world @ c.S_world_chunk),
        components=_Of(rows, lambda c: c.component),
        edges=tuple(edges),
        residual=1.0,
        covariances=_Of(rows, lambda c: np.zeros((7, 7)) if c.covariance is None else c.covariance),
    )


class _Of(Mapping[int, T]):
    """Something of each chunk, told when it is asked for."""

    def __init__(self, rows: Mapping[int, ChunkRow], tell: Callable[[ChunkRow], T]) -> None:
        self._rows, self._tell = rows, tell

    def __getitem__(self, chunk_id: int) -> T:
        return self._tell(self._rows[chunk_id])

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


def _graph_poses(store: Store) -> dict[int, Sim3]:
    """Where the chunks lay before, in the graph's frame."""
    T_graph_world = store.facts.S_world_graph.inverse()
    return {c.chunk_id: T_graph_world @ c.S_world_chunk for c in store.chunks.all()}


def poses_given(store: Store, session_id: int) -> bool:
    """Whether the source of a session said where its camera was; each session has a world of its own for that."""
    chosen = {s.session_id: session_settings(s).poses for s in store.sessions.all()}
    first = min(chosen, default=session_id)
    return (chosen.get(session_id) if session_id != first else store.facts.poses) == "given"


def knows_cameras(store: Store, session_id: int) -> bool:
    """Whether a session's cameras are known better than its surfaces."""
    models = {s.session_id: MODELS.get(session_settings(s).reconstruction) for s in store.sessions.all()}
    model = models.get(session_id)
    return model is not None and model.by_cameras

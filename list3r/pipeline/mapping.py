"""What is done when a chunk arrives: join it to the others, place all chunks, consolidate the library.

One transaction a chunk. All state lies in the store, so that a build that goes on after a crash takes the same path
as one that was never interrupted.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.growth import extend
from list3r.association.graph.node_graph import bend_chunks
from list3r.association.graph.pose_graph import GraphResult, optimize
from list3r.association.graph.surface_graph import place_by_surfaces
from list3r.association.overlap.camera_edge import better_edge, camera_edge
from list3r.association.overlap.edges import EdgeEnd, measure_edge
from list3r.association.revisits.joint_window import JointReconstructor
from list3r.association.revisits.overlays import write_loop
from list3r.association.revisits.reprojection_edge import ReprojectionSettings, refine_loop
from list3r.association.revisits.search import find_loops
from list3r.association.revisits.session_ties import hold_back
from list3r.frames.base import Camera
from list3r.instances.carving.carved_instances import ChangedPlaceSettings, add_changed_places
from list3r.instances.overlays import write_support
from list3r.memory.bends import Bend
from list3r.memory.errors import DegenerateError
from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels, put_votes, votes_of_names
from list3r.memory.records import ChunkResult, ChunkRow, Edge
from list3r.memory.store.store import Store
from list3r.memory.world.gravity import estimate_gravity, world_from_graph
from list3r.memory.world.scale import write_scale
from list3r.pipeline.settings import AssociationSettings, session_settings
from list3r.reconstruction.registry import MODELS

T = TypeVar("T")


def add_chunk(
    store: Store,
    session_id: int,
    result: ChunkResult,
    joint: JointReconstructor | None = None,
    settings: AssociationSettings | None = None,
    *,
    library: bool = True,
    debug_dir: Path | None = None,
) -> int:
    """Add one chunk to the memory, all of it or nothing; its id.

    `joint` makes joint windows of frames of two places, for revisits of chunks without metric scale. Without `library`
    the chunks are only placed. What the edge to the chunk before and the loops stand on is drawn into
    `debug_dir`/edges.
    """
    chosen = settings or AssociationSettings()
    with store.transaction():
        chunk_id = store.chunks.add(session_id, result)
        named = {i.local_id: votes_of_names(i.names) for i in result.library.instances if i.names}
        if named:
            put_votes(store, chunk_id, result.library.feature_space.partition("/")[0], named)
        given = _poses_given(store, session_id)
        if given:
            store.edges.add(_edge_of_given_poses(store, session_id))
        else:
            store.edges.add(_adjacent_edge(store, session_id, chosen, debug_dir))
        if not given or len(store.sessions.all()) > 1:
            loops = find_loops(store, chunk_id, joint, chosen.revisits)
            store.edges.add(_refined(store, e, chosen.reprojection) if e.accepted else e for e in loops)
        place_chunks(store, chosen, chunk_id)
        if debug_dir is not None:
            _draw_loops(store, chunk_id, debug_dir)
        if library:
            apply_labels(store, written=consolidate(store, chunk_id).written)
    return chunk_id


def _poses_given(store: Store, session_id: int) -> bool:
    """Whether the source of a session said where its camera was; each session has a world of its own for that."""
    chosen = {s.session_id: session_settings(s).poses for s in store.sessions.all()}
    first = min(chosen, default=session_id)
    return (chosen.get(session_id) if session_id != first else store.facts.poses) == "given"


def _adjacent_edge(store: Store, session_id: int, how: AssociationSettings, debug_dir: Path | None) -> list[Edge]:
    """The edge to the chunk before, from the frames that both hold; none when too little is shared to measure it.

    What moved between the two is flagged on the way.
    """
    chunks = store.chunks.all(session_id)
    if len(chunks) < 2:
        return []
    u, v = chunks[-2], chunks[-1]
    metric = u.scale_kind == v.scale_kind == "metric"
    samples_u, samples_v = store.chunks.samples(u.chunk_id), store.chunks.samples(v.chunk_id)
    by_cameras = None
    if not metric and _from_motion(store, session_id):
        by_cameras = camera_edge(samples_u, samples_v, u.chunk_id, v.chunk_id, how.cameras)
    try:
        ends = (
            EdgeEnd(u.chunk_id, samples_u, store.local_instances.dynamic(u.chunk_id)),
            EdgeEnd(v.chunk_id, samples_v, store.local_instances.dynamic(v.chunk_id)),
        )
        found = measure_edge(*ends, _camera(v), metric, how.edges)
    except DegenerateError:
        return [] if by_cameras is None else [by_cameras]
    if by_cameras is None:  # where points lie less well than cameras, what they disagree in has not moved
        for chunk, moving in ((u, found.moving_u), (v, found.moving_v)):
            store.local_instances.flag_dynamic(chunk.chunk_id, dict.fromkeys(sorted(moving)))
    if debug_dir is not None:
        pictures = [k for c in (u, v) for k in store.keyframes.of(c.chunk_id)]
        write_support(found, pictures, _camera(v), debug_dir)
    return [better_edge(found.edge, by_cameras) or found.edge]


def _refined(store: Store, edge: Edge, settings: ReprojectionSettings) -> Edge:
    """A loop between chunks of structure from motion, refined by where features are seen."""
    if edge.frames is None:
        return edge
    owner = {c.chunk_id: c for c in store.chunks.all()}
    u, v = owner[edge.u], owner[edge.v]
    if "metric" in (u.scale_kind, v.scale_kind) or not all(_from_motion(store, c.session_id) for c in (u, v)):
        return edge
    keyframes = store.keyframes.get(u.chunk_id, edge.frames[0]), store.keyframes.get(v.chunk_id, edge.frames[1])
    return refine_loop(edge, *keyframes, _camera(u), _camera(v), settings)


def _from_motion(store: Store, session_id: int) -> bool:
    """Whether a session's cameras are known better than its surfaces."""
    models = {s.session_id: MODELS.get(session_settings(s).reconstruction) for s in store.sessions.all()}
    model = models.get(session_id)
    return model is not None and model.by_cameras


def _draw_loops(store: Store, chunk_id: int, debug_dir: Path) -> None:
    """Pictures of the revisits of a chunk that geometry measured."""
    rows = {c.chunk_id: c for c in store.chunks.all()}
    for edge in store.edges.all():
        if edge.kind != "loop" or edge.v != chunk_id or edge.frames is None or not edge.S_v_u.translation.any():
            continue
        ends = [
            (store.chunks.samples(chunk), store.keyframes.get(chunk, frame), _camera(rows[chunk]))
            for chunk, frame in zip((edge.u, edge.v), edge.frames, strict=True)
        ]
        write_loop(edge, ends[0], ends[1], debug_dir)


def _camera(chunk: ChunkRow) -> Camera:
    height, width = chunk.image_size
    return Camera(width, height, *chunk.intrinsics)


def _edge_of_given_poses(store: Store, session_id: int) -> list[Edge]:
    """With given poses all chunks have the source's own world as their frame."""
    chunks = store.chunks.all(session_id)
    if len(chunks) < 2:
        return []
    u, v = chunks[-2].chunk_id, chunks[-1].chunk_id
    return [Edge(u, v, "adjacent", Sim3.identity(), 1.0, 1.0, 0, 0.0, True, "both lie in the source's own world")]


def place_chunks(
    store: Store, settings: AssociationSettings | None = None, new: int | None = None, *, bend: bool = False
) -> None:
    """Optimise the graph, find which way is up, and write where every chunk lies.

    With the id of a `new` chunk in a long video only what that chunk touches is solved; `finish_session` solves all.
    With `bend` it is also found how each chunk bends.
    """
    how = settings or AssociationSettings()
    chunks = store.chunks.all()
    measured = store.edges.all()
    edges = hold_back(measured, {c.chunk_id: c.session_id for c in chunks}, _metre(chunks), how.ties)
    ids = [c.chunk_id for c in chunks]
    metric = all(c.scale_kind == "metric" for c in chunks)
    fitted = new is not None and len(chunks) > how.solved_whole
    if new is not None and fitted:
        graph = extend(new, ids, edges, _placed(store, chunks, edges, new), metric, how.graph)
    else:
        graph = optimize(ids, edges, _graph_poses(store), metric=metric, settings=how.graph)
    store.edges.add(after for before, after in zip(measured, graph.edges, strict=True) if after is not before)
    if bend:
        graph = _straightened(store, graph, chunks, metric, how)
    known = {} if store.facts.poses == "given" else graph.covariances
    settled = store.facts.gravity == "estimated" or len(chunks) % how.up_again
    if fitted and len(chunks) > how.up_always and settled:
        _place_fitted(store, graph, known)
        return
    gravity = estimate_gravity(store, graph.S_graph_chunk, graph.components)
    upright = world_from_graph(gravity)
    rows = [replace(c, component=graph.components[c.chunk_id]) for c in store.chunks.all()]
    S_world_graph = write_scale(store, rows, graph.S_graph_chunk) @ upright
    store.facts.S_world_graph = S_world_graph
    store.facts.gravity = gravity.status
    store.chunks.place({k: S_world_graph @ S for k, S in graph.S_graph_chunk.items()}, graph.components, known)


def _place_fitted(store: Store, graph: GraphResult, covariances: Mapping[int, NDArray[np.float64]]) -> None:
    """Write where the new chunk lies, and those that moved for it, in the world as it stands."""
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
) -> GraphResult:
    """The graph with the bending of chunks undone; chunks whose poses were given do not bend."""
    given = {s.session_id for s in store.sessions.all() if _poses_given(store, s.session_id)}
    rigid = {c.chunk_id for c in chunks if c.session_id in given}
    bends: dict[int, Bend] = {}
    if len(rigid) < len(chunks):
        graph, bends = bend_chunks(store.chunks.samples, graph, rigid, metric, how.nodes, how.graph)
    if not metric and not rigid and all(_from_motion(store, k) for k in {c.session_id for c in chunks}):
        graph, bends = place_by_surfaces(store.chunks.samples, graph, bends, how.surfaces)
    store.bends.replace(bends)
    return graph


def _metre(chunks: Sequence[ChunkRow]) -> float:
    """What a metre is in the graph's units, where that is known; else nothing is asked of lengths."""
    return 1.0 if all(c.scale_kind == "metric" for c in chunks) else float("inf")


def finish_session(
    store: Store,
    session_id: int,
    settings: AssociationSettings | None = None,
    carving: ChangedPlaceSettings | None = None,
    *,
    library: bool = True,
) -> None:
    """Place all chunks once more by all edges, derive the library from that, and mark the session as complete."""
    chosen = settings or AssociationSettings()
    with store.transaction():
        place_chunks(store, chosen, bend=True)
        if library:
            add_changed_places(store, session_id, carving)
            consolidate(store)
            apply_labels(store)
        store.sessions.complete(session_id)


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

"""What is done when a chunk arrives: join it to the others, place all chunks, consolidate the library.

One transaction a chunk. All state lies in the store, so that a build that goes on after a crash takes the same path
as one that was never interrupted.
"""

from __future__ import annotations

from pathlib import Path

from list3r.association.overlap.camera_edge import better_edge, camera_edge, in_one_frame, one_frame_edge
from list3r.association.overlap.overlap_edge import EdgeEnd, measure_edge
from list3r.association.overlap.prior_edge import prior_edge
from list3r.association.paper.loops import loops_by_score
from list3r.association.revisits.joint_window import JointReconstructor
from list3r.association.revisits.loop_overlay import write_loop
from list3r.association.revisits.reprojection_edge import ReprojectionSettings, refine_loop
from list3r.association.revisits.search import find_loops
from list3r.frames.base import Camera
from list3r.instances.carving.carved_instances import ChangedPlaceSettings, add_changed_places
from list3r.instances.overlays import write_support
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, ChunkRow, Edge
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import (
    OWN_NAMES,
    apply_labels,
    put_votes,
    votes_of_names,
    votes_of_probabilities,
)
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import PART_STEP
from list3r.pipeline.placing import knows_cameras, place_chunks, poses_given
from list3r.pipeline.settings import AssociationSettings, session_settings


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
        probable = {i.local_id: votes_of_probabilities(i.named) for i in result.library.instances if i.named}
        if probable:
            put_votes(store, chunk_id, OWN_NAMES, probable)
        if result.posed.any():
            _relate(store, session_id, chunk_id, result, joint, chosen, debug_dir)
        place_chunks(store, chosen, chunk_id)
        if debug_dir is not None:
            _draw_loops(store, chunk_id, debug_dir)
        if library:
            apply_labels(store, written=consolidate(store, chunk_id).written)
    return chunk_id


def _relate(
    store: Store,
    session_id: int,
    chunk_id: int,
    result: ChunkResult,
    joint: JointReconstructor | None,
    how: AssociationSettings,
    debug_dir: Path | None,
) -> None:
    """Add the edges of a new chunk that holds something: to the one before of these, and to places seen before."""
    given = poses_given(store, session_id)
    if given:
        store.edges.add(_edge_of_given_poses(store, session_id))
    else:
        adjacent = _adjacent_edges(store, session_id, how, debug_dir)
        store.edges.add(adjacent)
        given = any(in_one_frame(e) for e in adjacent)
        store.edges.add([] if given else _prior_edge(store, session_id, result, how))
    if not given or len(store.sessions.all()) > 1:
        by_score = how.revisits.rule == "score"
        loops = (loops_by_score if by_score else find_loops)(store, chunk_id, joint, how.revisits)
        store.edges.add(_refined(store, e, how.reprojection) if e.accepted else e for e in loops)


def _last_two(store: Store, session_id: int) -> list[ChunkRow]:
    """The new chunk of a session and the one before it, of those that hold something."""
    blank = store.chunks.blank()
    return [c for c in store.chunks.all(session_id) if c.chunk_id not in blank][-2:]


def _adjacent_edges(store: Store, session_id: int, how: AssociationSettings, debug_dir: Path | None) -> list[Edge]:
    """The edges to the chunk before, or to all the parts that it fell into, from the frames that both hold.

    None when too little is shared to measure it. What moved between the two is flagged on the way.
    """
    blank = store.chunks.blank()
    *before, v = (c for c in store.chunks.all(session_id) if c.chunk_id not in blank)
    span = before[-1].index % PART_STEP if before else 0
    together = [u for u in before if u.index % PART_STEP == span]
    return [e for u in together for e in _adjacent_edge(store, u, v, how, debug_dir)]


def _adjacent_edge(
    store: Store, u: ChunkRow, v: ChunkRow, how: AssociationSettings, debug_dir: Path | None
) -> list[Edge]:
    session_id = v.session_id
    metric = u.scale_kind == v.scale_kind == "metric"
    samples_u, samples_v = store.chunks.samples(u.chunk_id), store.chunks.samples(v.chunk_id)
    by_cameras = None
    if not metric and knows_cameras(store, session_id):
        mapped = one_frame_edge(samples_u, samples_v, u.chunk_id, v.chunk_id)
        if mapped is not None:
            return [mapped]
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


def _prior_edge(store: Store, session_id: int, result: ChunkResult, how: AssociationSettings) -> list[Edge]:
    """The edge to the chunk before by poses that the source gives as a prior; none where it gives none."""
    chunks = _last_two(store, session_id)
    if len(chunks) < 2 or session_settings(store.sessions.get(session_id)).poses != "prior":
        return []
    u, v = chunks
    edge = prior_edge(u, store.frames.of(u), result, v.chunk_id, how.prior)
    return [] if edge is None else [edge]


def _refined(store: Store, edge: Edge, settings: ReprojectionSettings) -> Edge:
    """A loop between chunks of structure from motion, refined by where features are seen; not one by things alone."""
    if edge.frames is None or edge.by_things:
        return edge
    owner = {c.chunk_id: c for c in store.chunks.all()}
    u, v = owner[edge.u], owner[edge.v]
    if "metric" in (u.scale_kind, v.scale_kind) or not all(knows_cameras(store, c.session_id) for c in (u, v)):
        return edge
    keyframes = store.keyframes.get(u.chunk_id, edge.frames[0]), store.keyframes.get(v.chunk_id, edge.frames[1])
    return refine_loop(edge, *keyframes, _camera(u), _camera(v), settings)


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
    chunks = _last_two(store, session_id)
    if len(chunks) < 2:
        return []
    u, v = (c.chunk_id for c in chunks)
    return [Edge(u, v, "adjacent", Sim3.identity(), 1.0, 1.0, 0, 0.0, True, "both lie in the source's own world")]


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

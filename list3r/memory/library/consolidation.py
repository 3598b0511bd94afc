"""Local instances of all chunks to the global library (paper 3.3): group, keep ids, derive, relate, log.

The library is derived whole, as a function of the chunks and of their poses (`library.derivation`): with each of the
first chunks, whenever they have grown by a quarter, and when a session ends. In between, what a new chunk saw comes to
the instances by overlap alone (`library.attaching`).
"""

from __future__ import annotations

from list3r.memory.library.attaching import attach
from list3r.memory.library.derivation import derive
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.rules import ConsolidationReport, ConsolidationSettings, look_at_world, settings_of
from list3r.memory.library.scene import Scene
from list3r.memory.library.world.world import WORLD
from list3r.memory.library.writing import read_known, write_library
from list3r.memory.store.store import Store

__all__ = ["ConsolidationReport", "ConsolidationSettings", "consolidate"]

_ALWAYS, _GROWN = 8, 1.25
"""Chunks up to which the library is derived with each, and by how much they grow until it is again."""


def consolidate(
    store: Store, chunk_id: int | None = None, settings: ConsolidationSettings | None = None
) -> ConsolidationReport:
    """Bring the library up to date with the chunks as they are placed now; call inside a transaction.

    `chunk_id` is the chunk that has just come in and names the entries of the merge log. None means the last one
    and the end of a session, whose changes are found. The result depends on what the store holds alone, so a build
    that goes on after a crash comes to the same library.
    """
    s, chunks = settings_of(store, settings), store.chunks.all()
    if not chunks:
        return ConsolidationReport(0, 0, (), (), 0)
    summaries, before = chunk_summaries(store, s.shapes), store.facts[WORLD]
    if chunk_id is not None:
        store.derived.end_turn()
    if chunk_id is not None and before is not None and not _is_due(len(chunks), before.chunks):
        return attach(Scene(store, summaries, before, s), chunk_id)
    world = look_at_world(store, chunks, summaries, s)
    scene, known = Scene(store, summaries, world, s), read_known(store)
    library = derive(scene, known, ended=chunk_id is None)
    write_library(scene, library, known, chunks[-1].chunk_id if chunk_id is None else chunk_id)
    store.facts[WORLD] = world
    instances, structure = store.instances.count()
    return ConsolidationReport(instances, structure, library.ids.new, library.ids.aliases, library.hidden)


def _is_due(chunks: int, derived: int) -> bool:
    """Return whether the library is derived, with so many chunks since it was with fewer."""
    return chunks <= _ALWAYS or chunks >= _GROWN * derived

"""What a memory is: sessions, frames, scale, gravity, counts."""

from __future__ import annotations

from typing import Any

from list3r.memory.library.world.scale import lengths_of
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.store import Store
from list3r.queries.trust import path_trust


def info(store: Store) -> dict[str, Any]:
    """Return the facts of a memory as plain values."""
    frames, chunks, edges = store.frames.all(), store.chunks.all(), store.edges.all()
    states = {state: sum(f.state == state for f in frames) for state in ("posed", "lost", "bad")}
    return {
        "memory": str(store.path),
        "size_mb": round(store.path.stat().st_size / 1e6, 2),
        "beside": store.beside(),
        "created_by": store.facts.created_by,
        "scale": store.facts.scale_kind,
        "scale_source": store.facts.scale_source,
        "metre_deviation": lengths_of(store).deviation,
        "units_per_metre": _guessed_metre(store),
        "units": lengths_of(store).units,
        "gravity": store.facts.gravity,
        "gravity_deviation_deg": _rounded(store.facts.gravity_deviation_deg),
        "frames": len(frames),
        **states,
        "chunks": len(chunks),
        "components": len({c.component for c in chunks}),
        "trust": path_trust(frames, chunks),
        "loops": sum(e.kind == "loop" and e.accepted for e in edges),
        "loops_rejected": sum(e.kind == "loop" and not e.accepted for e in edges),
        "instances": len(store.instances.all(structure=False)),
        "structure": len(store.instances.all(structure=True)),
        "relations": len(store.relations.all()),
        "aliases": len(store.ids.aliases()),
        "embedding_spaces": store.embeddings.spaces(),
        "sessions": [
            {"id": s.session_id, "source": s.source, "frames": s.frame_count, "state": s.state}
            for s in store.sessions.all()
        ],
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)


def _guessed_metre(store: Store) -> float | None:
    """Return about how many units a metre is in a memory of relative scale, by depths and the height of the cameras."""
    if store.facts.scale_kind != "relative":
        return None
    world = store.facts[WORLD]
    return None if world is None else round(world.unit, 3)


def describe_counts(store: Store) -> str:
    """Return one line on what a memory holds: instances, structure, sessions, scale and gravity."""
    things, structure = len(store.instances.all(structure=False)), len(store.instances.all(structure=True))
    sessions = len(store.sessions.all())
    kind, gravity = lengths_of(store), store.facts.gravity
    scale = {"relative": "no scale", "guessed": "about metres"}.get(kind.metric, "metric")
    up = {"unknown": "up unknown", "assumed": "z up, assumed"}.get(gravity, "z up")
    counts = (
        f"{things} instance{'s' * (things != 1)}, {structure} of structure, {sessions} session{'s' * (sessions != 1)}"
    )
    return f"{counts}, {scale}, {up}"

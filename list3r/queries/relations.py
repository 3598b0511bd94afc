"""Relations of a memory."""

from __future__ import annotations

from list3r.memory.errors import OptionError
from list3r.memory.records import Relation
from list3r.memory.relations import PREDICATES
from list3r.memory.store import Store


def relations(
    store: Store,
    subject: int | None = None,
    predicate: str | None = None,
    object: int | None = None,
    min_confidence: float = 0.0,
) -> list[Relation]:
    """Relations that match what is given, the surest first; ids may be aliases.

    An empty answer to a vertical predicate means nothing where gravity is unknown: see `SceneMemory.gravity`. Raises
    `OptionError` for a predicate that does not exist, `UnknownIdError` for an id that was never given.
    """
    if predicate is not None and predicate not in PREDICATES:
        raise OptionError(f"predicate {predicate!r} is not known; choose one of: {', '.join(PREDICATES)}")
    if not 0.0 <= min_confidence <= 1.0:
        raise OptionError(f"min_confidence {min_confidence} must lie between 0 and 1")
    found = [r for r in store.relations(subject, predicate, object) if r.confidence >= min_confidence]
    return sorted(found, key=lambda r: (-r.confidence, r.subject, r.predicate, r.object))

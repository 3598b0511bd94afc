"""The memory with what it keeps but does not list, for every question."""

from __future__ import annotations

from functools import partial

import numpy as np

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Observation
from list3r.memory.library.maintenance.scraps import derive_scraps
from list3r.memory.library.maintenance.temporary_views import put_before, store_shown
from list3r.memory.library.maintenance.unlisted import derive_unlisted
from list3r.memory.library.rules import WORLD
from list3r.memory.store.rows.columns import UNREADABLE
from list3r.memory.store.store import Store


def store_with_scraps(store: Store, min_confidence: float) -> Store:
    """Return a store to read that holds all that is at least so sure to be one thing, scraps too; close it like any
    other. Scraps have no relations and no changes.
    """
    return store_shown(store.path, partial(_take_in, min_confidence=min_confidence))


def _take_in(shown: Store, *, min_confidence: float) -> None:
    """Show the file as it is now, with its scraps."""
    try:
        derived = [*derive_scraps(shown), *derive_unlisted(shown)]
    except MemoryFileError:
        raise
    except UNREADABLE as error:
        what = f"what the chunks of {shown.path} found cannot be put together ({error})"
        raise MemoryFileError(f"{what}; run `list3r verify` on the file") from error
    scraps = [s for s in derived if s.instance.confidence >= min_confidence]
    listed = [i for i in shown.instances.all() if i.confidence >= min_confidence]
    world, connection = shown.facts[WORLD], shown.connection
    put_before(shown, [*listed, *(s.instance for s in scraps)], "observations", "embeddings")
    ids = "(SELECT id FROM temp.instances)"
    with connection.temporary():
        for table in ("observations", "embeddings"):
            connection.execute(f"INSERT INTO temp.{table} SELECT * FROM main.{table} WHERE instance IN {ids}")
        shown.observations.set(Observation(s.instance.id, *key) for s in scraps for key in s.members)
        if world is not None and world.space and scraps:
            features = np.array([s.feature for s in scraps], np.float32)
            shown.embeddings.put(world.space, [s.instance.id for s in scraps], features)
        both = f"subject IN {ids} AND object IN {ids}"
        connection.execute(f"CREATE TEMP VIEW relations AS SELECT * FROM main.relations WHERE {both}")
        for table in ("events", "detected_labels"):
            condition = f"instance IN {ids}"
            connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM main.{table} WHERE {condition}")

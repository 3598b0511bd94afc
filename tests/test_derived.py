"""What is derived from an open memory belongs to it: one object of each class, bounded, gone with the store."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from list3r.memory.overlap.summaries import SummaryCache
from list3r.memory.store.derived import Derived, LruCache
from list3r.memory.store.store import Store


@given(st.integers(1, 9), st.lists(st.tuples(st.booleans(), st.integers(0, 6), st.integers(0, 4)), max_size=60))
def test_a_cache_holds_what_was_asked_for_last_within_its_limit(limit: int, steps: list[tuple[bool, int, int]]) -> None:
    cache: LruCache[int, int] = LruCache(limit, size=lambda value: value)
    order: list[tuple[int, int]] = []
    for put, key, value in steps:
        known = dict(order)
        if put:
            assert cache.put(key, value) == value
            known[key] = value
        else:
            assert cache.get(key) == known.get(key)
        if key in known:
            order = [item for item in order if item[0] != key] + [(key, known[key])]
        while put and len(order) > 1 and sum(v for _, v in order) > limit:
            del order[0]
        assert len(cache) == len(order)
    assert [cache.get(key) for key, _ in order] == [value for _, value in order]


def test_each_store_has_its_own_objects_and_drops_them(tmp_path: Path) -> None:
    kept = []
    for name in ("one.l3r", "two.l3r"):
        with Store.create(tmp_path / name) as store:
            found = store.derived.of(SummaryCache)
            assert found is store.derived.of(SummaryCache) and found not in kept
            kept.append(found)
    gone = weakref.ref(found)
    del store, found
    kept.clear()
    gc.collect()
    assert gone() is None


def test_objects_are_told_apart_by_class() -> None:
    derived = Derived()
    assert derived.of(list) is derived.of(list) and derived.of(dict) == {}

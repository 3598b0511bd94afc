"""What is derived from an open memory belongs to it: one object of each class, bounded, gone with the store."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from list3r.memory.library.overlap.summaries import SummaryCache, sample_of
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


def test_what_nobody_asked_for_in_the_last_turns_is_dropped() -> None:
    kept: LruCache[str, str] = LruCache(100, len, turns=2)
    kept.put("left", "behind")
    kept.put("asked", "again")
    for _ in range(3):
        assert kept.get("asked") == "again"
        kept.end_turn()
    assert kept.get("left") is None and len(kept) == 1
    kept.put("large", "x" * 95)
    assert kept.get("asked") == "again"


class _Passing(LruCache[str, str]):
    def __init__(self) -> None:
        super().__init__(100, turns=1)


class _Lasting(LruCache[str, str]):
    def __init__(self) -> None:
        super().__init__(100)


def test_a_turn_ends_for_all_caches_of_a_store_that_have_turns() -> None:
    derived = Derived()
    derived.of(_Passing).put("left", "behind")
    derived.of(_Lasting).put("kept", "on")
    for _ in range(3):
        derived.end_turn()
    assert derived.of(_Passing).get("left") is None and derived.of(_Lasting).get("kept") == "on"


@pytest.mark.parametrize("period", [2, 3, 4])
@pytest.mark.parametrize("count", [65, 100, 200, 1000])
def test_the_sample_of_a_walk_to_and_fro_holds_all_places_about_as_often(count: int, period: int) -> None:
    seen = np.bincount(np.array(sample_of(range(count))) % period, minlength=period)
    assert seen.min() > 0.5 * seen.mean()


@pytest.mark.parametrize("count", [1, 64, 65, 128, 129, 300, 1000, 1025])
def test_the_sample_of_a_longer_walk_is_some_of_the_earlier_one_and_later_chunks(count: int) -> None:
    sample = sample_of(range(count))
    assert min(count, 33) <= len(sample) <= 64
    for longer in range(count, 2 * count):
        assert {k for k in sample_of(range(longer)) if k < count} <= set(sample)

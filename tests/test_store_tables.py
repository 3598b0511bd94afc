"""What tables hold as records: round trips, what older schemas kept elsewhere, and values that are none."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.records import DetectedLabel, SessionCamera, Votes
from list3r.memory.store.facts import Fact
from list3r.memory.store.rows.json_values import array_scalar, typed
from list3r.memory.store.store import Store

Make = Callable[..., Path]
CUP = Votes(0.5, {"cup": (4.0, 16.0)}, 4.0)


def test_what_schema_7_kept_as_key_and_value_is_in_columns(tmp_path: Path) -> None:
    path = Path(shutil.copy(Path(__file__).parent / "fixtures" / "schema7.l3r", tmp_path / "old.l3r"))
    with Store.open(path, writable=True) as store:
        first, second = store.sessions.all()
        camera = SessionCamera((80.5, 80.25, 48.0, 36.0), (0.01, -0.02, 0.0, 0.0, 0.0), ("the camera was estimated",))
        assert (first.camera, first.cuts, first.depth_step, first.lost_reasons) == (camera, (), 2, ())
        assert (second.camera, second.cuts, second.depth_step) == (None, (7,), 1)
        assert second.lost_reasons == ("too few matches",)
        assert store.votes.of(1) == store.votes.of(2) == {"old-net": {0: CUP}}
        assert store.detected_labels.all() == {1: DetectedLabel("cup", 0.9566, 8.0, "old-net")}
        keys = {key for (key,) in store.connection.rows("SELECT key FROM memory")}
        assert keys <= {
            "created_by",
            "gravity",
            "label classes",
            "last_id",
            "poses",
            "scale_source",
        }
        assert store.verify() == []


def test_a_session_is_written_anew_as_it_is_said(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        said = replace(store.sessions.get(1), cuts=(4, 9), depth_step=3, lost_reasons=("dark", "fast"))
        with store.transaction():
            store.sessions.put(said)
        assert store.sessions.get(1) == said and store.verify() == []
        with pytest.raises(MemoryFileError, match="no session 2"):
            store.sessions.get(2)


def test_a_source_of_votes_replaces_what_it_said_itself(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.votes.put(1, "one", {2: CUP, 3: CUP})
            store.votes.put(1, "two", {2: CUP})
            store.votes.put(1, "one", {3: replace(CUP, missed=1.0)})
        assert store.votes.of(1) == {"one": {3: replace(CUP, missed=1.0)}, "two": {2: CUP}}
        with store.transaction():
            store.sessions.drop(1)
        assert store.votes.of(1) == {}


def test_the_label_of_a_detector_goes_with_its_instance(make_memory: Make) -> None:
    label = DetectedLabel("cup", 0.9, 3.0, "net")
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.detected_labels.replace({2: label, 3: label, 4: label})
            store.detected_labels.replace({3: replace(label, label="mug")}, [2, 3])
            store.observations.forget([(1, 3)])
            store.instances.drop(4, None)
        assert store.detected_labels.all() == {3: replace(label, label="mug")}
        assert store.verify() == []


def test_a_fact_is_what_was_written_last_and_none_forgets_it(make_memory: Make) -> None:
    pairs = Fact[tuple[tuple[int, str], ...] | None]("pairs", tuple[tuple[int, str], ...], None)
    with Store.open(make_memory(), writable=True) as store:
        before = store.connection.stamp()[1]
        with store.transaction():
            store.facts.gravity = "estimated"
        assert store.connection.stamp()[1] == before, "what is known already is not written again"
        with store.transaction():
            store.facts[pairs] = ((1, "a"), (2, "b"))
        assert store.facts[pairs] == ((1, "a"), (2, "b"))
        with store.transaction():
            store.facts[pairs] = None
            store.connection.execute("UPDATE memory SET value = '3' WHERE key = 'gravity'")
        assert store.facts[pairs] is None
        with pytest.raises(MemoryFileError, match="the value gravity cannot be read"):
            _ = store.facts.gravity


@pytest.mark.parametrize(
    ("statement", "ask", "where"),
    [
        (
            "UPDATE frames SET time_s = 'soon' WHERE frame_index = 3",
            lambda s: s.frames.all(),
            "frames 1:3: time_s .*str",
        ),
        ("UPDATE instances SET label = x'00' WHERE id = 4", lambda s: s.instances.all(), "instances 4: label .*bytes"),
        ("UPDATE instances SET geometry = x'00' WHERE id = 4", lambda s: s.instances.get(4), "instances 4: geometry"),
        ("UPDATE sessions SET settings = '[]'", lambda s: s.sessions.all(), "sessions 1: settings .*list"),
        ("UPDATE placements SET S_world_chunk = x'0000'", lambda s: s.chunks.all(), "chunks 1: S_world_chunk"),
        (
            "UPDATE local_instances SET track = x'0000'",
            lambda s: s.local_instances.nodes(),
            "s 1:0: track",
        ),
    ],
)
def test_a_value_that_is_none_of_its_column_names_the_row(
    make_memory: Make, statement: str, ask: Callable[[Store], object], where: str
) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.connection.execute(statement)
        store.connection.forget()
        with pytest.raises(MemoryFileError, match=where):
            ask(store)


def test_arrays_are_known_by_their_type_in_every_numpy() -> None:
    assert array_scalar(NDArray[np.float32]) is np.float32
    assert array_scalar(np.ndarray[tuple[int], np.dtype[np.int8]]) is np.int8
    assert [array_scalar(kind) for kind in (int, list[int], tuple[int, ...])] == [None] * 3
    assert typed(NDArray[np.float32], [1, 2]).dtype == np.float32

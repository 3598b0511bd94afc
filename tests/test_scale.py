"""Scale: relative and said so, anchored by one known length, and what an anchor survives."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.feedforward_sim.feedforward import FeedForwardModel
from benchmarks.simulation.presets import make_video
from list3r.api import open as open_scene
from list3r.cli.app import run
from list3r.exporters.scene_json import write_scene_json
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.records import ChunkResult, Instance
from list3r.memory.library.maintenance import edits
from list3r.memory.library.world.scale import parse_anchor
from list3r.memory.store.store import Store
from list3r.pipeline import mapping


@pytest.fixture(scope="module")
def chunks() -> list[ChunkResult]:
    """Three chunks of a simulated model without scale."""
    model = FeedForwardModel(make_video("calm", 102), seed=102)
    return [model.chunk(span) for span in plan_chunks(400, ChunkSettings())[:3]]


@pytest.fixture(scope="module")
def two(chunks: list[ChunkResult], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A relative memory of the first two."""
    path = tmp_path_factory.mktemp("scale") / "two.l3r"
    with Store.create(path) as store:
        with store.transaction():
            session = store.sessions.add("simulation", "", {}, 240)
        for chunk in chunks[:2]:
            mapping.add_chunk(store, session, chunk)
    return path


@pytest.fixture
def memory(two: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(two, tmp_path / "m.l3r"))


def middling(store: Store) -> Instance:
    """A thing of the middle size, seen in both chunks."""
    found = [i for i in store.instances.all(structure=False) if len(store.observations.of(i.id)) == 2]
    return sorted(found, key=lambda i: float(i.box.size.max()))[len(found) // 2]


@pytest.mark.slow
def test_a_memory_without_scale_says_so(memory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_scene(memory) as scene:
        assert scene.units == "unit" and scene.store.facts.scale_kind == "relative"
        assert not any("cm" in i.description for i in scene.instances())
    assert run(["edit", "scale", str(memory)]) == 0 and "relative" in capsys.readouterr().out
    assert run(["nearest", str(memory), "--point", "0,0,0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["units"] == "unit"
    assert run(["list", str(memory)]) == 0 and "centre x y z (unit)" in capsys.readouterr().out


def test_an_anchored_thing_has_the_size_that_was_said(memory: Path, tmp_path: Path) -> None:
    with Store.open(memory, writable=True) as store:
        chosen = middling(store)
        before = {i.id: i for i in store.instances.all()}
        report = edits.scale(store, f"{chosen.id}=25cm", "ann")
        after = {i.id: i for i in store.instances.all()}
        assert after[chosen.id].box.size.max() == pytest.approx(0.25, rel=0.02)
        factor = 0.25 / float(chosen.box.size.max())
        kept = [n for n in before if n in after]
        assert len(kept) > 0.9 * len(before)
        np.testing.assert_allclose(
            [after[n].center for n in kept], [factor * before[n].center for n in kept], atol=0.1 * factor
        )
        assert (store.facts.scale_kind, report.kind) == ("anchored", "scale")
        assert "ann" in str(store.facts.scale_source) and "25cm" in report.text
        assert not store.verify()
        write_scene_json(store, tmp_path / "s.json")
    frame = json.loads((tmp_path / "s.json").read_text())["frame"]
    assert (frame["units"], frame["metric"]) == ("m", "anchored")
    with open_scene(memory) as scene:
        assert scene.units == "m" and all("m" in i.description for i in scene.instances())


def test_an_anchor_holds_when_later_chunks_come(memory: Path, chunks: list[ChunkResult]) -> None:
    with Store.open(memory, writable=True) as store:
        chosen = middling(store)
        edits.scale(store, f"{chosen.id}=0.25m", "ann")
        scale = [float(c.S_world_chunk.scale) for c in store.chunks.all()]
        mapping.add_chunk(store, 1, chunks[2])
        mapping.finish_session(store, 1)
        rows = store.chunks.all()
        assert store.facts.scale_kind == "anchored" and len(rows) == 3
        assert float(rows[0].S_world_chunk.scale) == pytest.approx(scale[0], rel=1e-9)
        assert store.instances.get(store.ids.resolve(chosen.id)).box.size.max() == pytest.approx(0.25, rel=0.1)
        assert not store.verify()


def test_undo_takes_an_anchor_back_and_undo_again_brings_it(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        chosen = middling(store)
        placed = [c.S_world_chunk for c in store.chunks.all()]
        first = edits.scale(store, f"{chosen.id}=0.25m", "ann")
        second = edits.scale(store, "0,0,0:1,0,0=3m", "bob")
        assert store.instances.get(chosen.id).box.size.max() == pytest.approx(0.75, rel=0.02)
        edits.undo(store, second.entry)
        assert store.instances.get(chosen.id).box.size.max() == pytest.approx(0.25, rel=0.02)
        taken = edits.undo(store, first.entry)
        assert store.facts.scale_kind == "relative"
        for before, now in zip(placed, store.chunks.all(), strict=True):
            np.testing.assert_allclose(now.S_world_chunk.as_matrix(), before.as_matrix(), atol=1e-9)
        edits.undo(store, taken.entry)
        assert store.facts.scale_kind == "anchored"
        assert store.instances.get(chosen.id).box.size.max() == pytest.approx(0.25, rel=0.02)


def test_the_height_of_the_cameras(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        edits.scale(store, "camera_height=1.6m")
        heights = [S.translation[2] for _, S in store.trajectory.poses()]
        assert np.median(heights) == pytest.approx(1.6, rel=1e-6)
        with store.transaction():
            store.facts.gravity = "unknown"
        with pytest.raises(OptionError, match="floor"):
            edits.scale(store, "camera_height=1.6m")
        with pytest.raises(OptionError, match="up"):
            edits.scale(store, f"{middling(store).id}.height=1m")


def test_metric_memories_need_no_anchor(make_memory, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    path = make_memory()
    assert run(["edit", "scale", str(path), "--anchor", "3=1m"]) == 2
    assert "metres already" in capsys.readouterr().err
    assert run(["edit", "scale", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["scale"] == "metric"


def test_a_memory_that_gets_a_metric_chunk_is_metric(tmp_path: Path, chunks: list[ChunkResult]) -> None:
    with Store.create(tmp_path / "mixed.l3r") as store:
        with store.transaction():
            session = store.sessions.add("simulation", "", {}, 240)
        for chunk in (chunks[0], replace(chunks[1], scale_kind="metric")):
            mapping.add_chunk(store, session, chunk, library=False)
        rows = store.chunks.all()
        assert store.facts.scale_kind == "metric" and "1 of 2" in store.facts.scale_source
        assert float(rows[1].S_world_chunk.scale) == pytest.approx(1.0)
        assert float(rows[0].S_world_chunk.scale) != pytest.approx(1.0)


@given(st.floats(0.002, 900.0), st.sampled_from(["m", "cm", "mm", ""]), st.integers(1, 99))
def test_anchors_are_read(metres: float, unit: str, number: int) -> None:
    value = metres * {"m": 1, "cm": 100, "mm": 1000, "": 1}[unit]
    assert parse_anchor(f"{number}={value:.12g}{unit}").metres == pytest.approx(max(metres, 0.002), rel=1e-6)
    assert parse_anchor(f"#{number}.height = {metres + 1:.6f}m").kind == "height"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "12",
        "12=",
        "=1m",
        "12=-1m",
        "12=0m",
        "12=1km",
        "12=nan",
        "12=1..2m",
        "a=1m",
        "1,2:3,4,5=1m",
        "1,2,3:4,5,x=1m",
        "camera=1m",
        "12=5000m",
        "12.width=1m",
        "1,2,3=1m",
        "12=1e999m",
    ],
)
def test_anchors_that_are_none_are_refused_before_anything_is_built(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(OptionError, match="anchor"):
        parse_anchor(text)
    (tmp_path / "walk").mkdir()
    assert run(["build", str(tmp_path / "walk"), "-m", str(tmp_path / "m.l3r"), "--scale-anchor", text or " "]) == 2
    assert "anchor" in capsys.readouterr().err and not (tmp_path / "m.l3r").exists()


def test_anchors_that_cannot_be_measured(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        with pytest.raises(UnknownIdError):
            edits.scale(store, "9999=1m")
        with pytest.raises(OptionError, match="no length"):
            edits.scale(store, "1,1,1:1,1,1=1m")
        with store.transaction():
            rows = store.chunks.all()
            store.chunks.place({c.chunk_id: c.S_world_chunk for c in rows}, {rows[0].chunk_id: 1, rows[1].chunk_id: 2})
        assert store.facts.scale_kind == "relative" and not store.edits.all()


def test_python_face(memory: Path) -> None:
    with open_scene(memory, writable=True) as scene:
        before = scene.store.facts.S_world_graph
        scene.scale("0,0,0:0,0,2=1m", author="ann")
        after = scene.store.facts.S_world_graph
        assert float(after.scale) == pytest.approx(0.5 * float(before.scale))

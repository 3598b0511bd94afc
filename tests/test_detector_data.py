"""Names on a real table: a short part of redkitchen through the commands; the whole is benchmarks/detection.py."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from list3r.cli.app import run
from list3r.memory.store.store import Store

SHARED = Path(__file__).resolve().parents[2] / "shared"
WEIGHTS = SHARED / "weights" / "nanodet"
KITCHEN = SHARED / "data" / "redkitchen"
TRUTH = {"cup": [(80, 238), (502, 312)], "dining table": [(400, 330)], "chair": [(240, 205), (548, 230)]}
"""Pixels of frame 300 on both mugs, on the table, and on the backs of the two chairs behind it."""

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"the detector's weights are not at {WEIGHTS}"),
    pytest.mark.skipif(not KITCHEN.is_dir(), reason=f"redkitchen is not at {KITCHEN}"),
]


def shown_at(store: Store, frame: int, x: int, y: int) -> int:
    """The instance with the smallest box around a pixel."""
    areas: dict[int, float] = {}
    for o in store.observations.all():
        track = store.local_instances.mask_track(o.chunk_id, o.local_id)
        for box in track.boxes_xyxy[track.frames == frame]:
            if box[0] <= x <= box[2] and box[1] <= y <= box[3]:
                areas[o.instance_id] = float(np.prod(box[2:] - box[:2]))
    return min(areas, key=lambda i: areas[i])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames around the table, built with given poses and named by the small detector."""
    pytest.importorskip("ncnn")
    path = tmp_path_factory.mktemp("kitchen") / "table.l3r"
    source = [str(KITCHEN), "--frames", "266:334", "--every", "2", "--poses", "given"]
    detector = ["--detector", str(WEIGHTS / "nanodet-m.param")]
    assert run(["build", *source, "-m", str(path), "--chunk", "50", "--workers", "0", *detector]) == 0
    return path


@pytest.mark.slow
def test_mugs_chairs_and_the_table_get_their_names(table: Path) -> None:
    with Store.open(table) as store:
        for name, pixels in TRUTH.items():
            ids = {shown_at(store, 300, *p) for p in pixels}
            assert len(ids) == len(pixels) and {store.instances.get(i).label for i in ids} == {name}
        assert all(i.label is None for i in store.instances.all(structure=True))
        named = [i.label for i in store.instances.all()]
        assert named.count("cup") == 2 and named.count("dining table") == 1


def test_a_phrase_finds_both_mugs_first(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert run(["find", str(table), "cup on dining table", "--json"]) == 0
    answers = json.loads(capsys.readouterr().out)["matches"]
    with Store.open(table) as store:
        assert {a["id"] for a in answers[:2]} == {shown_at(store, 300, *p) for p in TRUTH["cup"]}


def test_a_detector_that_looks_again_at_other_frames_keeps_the_names(table: Path, tmp_path: Path) -> None:
    path = tmp_path / "again.l3r"
    path.write_bytes(table.read_bytes())
    with Store.open(path) as store:
        before = {i.id: i.label for i in store.instances.all()}
    assert run(["detect", str(path), "--detector", str(WEIGHTS / "nanodet-m-416.param")]) == 0
    with Store.open(path) as store:
        cups = {shown_at(store, 300, *p) for p in TRUTH["cup"]}
        assert all(before[i] == store.instances.get(i).label == "cup" for i in cups)

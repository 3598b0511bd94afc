"""The association benchmark on a video that never comes back to a place: every variant measures it to the end."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks.feedforward_sim.feedforward import FeedForwardModel
from benchmarks.simulation.presets import make_video
from list3r.frames.chunking.chunks import ChunkSettings

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SHORT = 64
"""Frames: two chunks, which share some and so are no revisit of each other."""


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(FOLDER)
    spec = importlib.util.spec_from_file_location("benchmark_association", FOLDER / "association.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_every_variant_measures_a_video_without_loops(
    benchmark: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = make_video("calm", 102)
    video = replace(
        whole,
        time_s=whole.time_s[:SHORT],
        T_world_cam=whole.T_world_cam[:SHORT],
        depth=whole.depth[:SHORT],
        ids=whole.ids[:SHORT],
    )
    assert not whole.movers and not whole.cuts
    model = FeedForwardModel(video, seed=102)
    rows = benchmark.run_variants(video, model, benchmark.VARIANTS, length=ChunkSettings(40, 16))
    assert [r["variant"] for r in rows] == list(benchmark.VARIANTS)
    for row in rows:
        assert row["posed"] == 1.0 and row["components"] == 1 and row["ate_sim3_m"] < 0.1
        assert (row["revisits"], row["true_loops"], row["false_loops"]) == (0, 0, 0)
    assert any(r["candidates"] == 0 for r in rows)
    judged = [("calm", r["variant"], benchmark._judgement(json.loads(json.dumps(r.pop("judgement"))))) for r in rows]
    benchmark.print_tables(benchmark.summarise(rows, ["calm"], benchmark.VARIANTS), ["calm"], benchmark.VARIANTS)
    table = benchmark.revisit_table(judged, ["calm"], "full")
    assert table["all"]["revisits"] == 0 and table["all"]["false"] == 0
    said = capsys.readouterr().out
    assert all(title in said for title in benchmark.TITLES.values())

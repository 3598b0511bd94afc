"""Chunks as they come: fitted in one by one or solved anew each time, the finished session is the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.feedforward_sim.feedforward import FeedForwardModel
from benchmarks.simulation.presets import make_video
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult
from list3r.memory.store.store import Store
from list3r.pipeline import mapping, placing
from list3r.pipeline.settings import AssociationSettings


def placed(
    path: Path, chunks: list[ChunkResult], model: FeedForwardModel, settings: AssociationSettings | None = None
) -> list[Sim3]:
    with Store.create(path) as store:
        with store.transaction():
            store.facts.scale_kind = "relative"
            session = store.sessions.add("simulation", "", {}, 310)
        for chunk in chunks:
            mapping.add_chunk(store, session, chunk, model, settings, library=False)
        mapping.finish_session(store, session, settings, library=False)
        rows = store.chunks.all()
        assert len({c.component for c in rows}) == 1
        assert all(c.covariance is not None for c in rows)
        return [c.S_world_chunk for c in rows]


@pytest.mark.slow
def test_a_chunk_fitted_in_ends_where_solving_the_whole_graph_puts_it(tmp_path: Path) -> None:
    model = FeedForwardModel(make_video("calm", 102), seed=102)
    chunks = [model.chunk(span) for span in plan_chunks(310, ChunkSettings())]
    whole = placed(tmp_path / "whole.l3r", chunks, model)
    grown = placed(tmp_path / "grown.l3r", chunks, model, AssociationSettings(solved_whole=0))
    for a, b in zip(whole, grown, strict=True):
        assert np.abs((a.inverse() @ b).log()).max() < 1e-6


def test_a_camera_that_turns_makes_chunks_of_structure_from_motion_less_sure_and_edges_stay_as_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = FeedForwardModel(make_video("calm", 102), seed=102)
    chunks = [model.chunk(span) for span in plan_chunks(170, ChunkSettings())]
    sure, stated = [], []
    for follows in (False, True):
        monkeypatch.setattr(placing, "knows_cameras", lambda store, session_id, follows=follows: follows)
        with Store.create(tmp_path / f"{follows}.l3r") as store:
            with store.transaction():
                store.facts.scale_kind = "relative"
                session = store.sessions.add("simulation", "", {}, 170)
            for chunk in chunks:
                mapping.add_chunk(store, session, chunk, model, library=False)
            covariance = store.chunks.all()[-1].covariance
            assert covariance is not None
            sure.append(covariance[6, 6])
            stated.append([e.covariance for e in store.edges.all() if e.kind == "adjacent"])
    assert sure[1] > sure[0]
    assert all(np.array_equal(a, b) for a, b in zip(*stated, strict=True))

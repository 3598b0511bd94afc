"""Loops as the paper accepts them (3.2), by s_loop alone, for a row of `benchmarks/association.py`.

The paper gives no threshold of s_loop; the one here is ours. Every relation that can be measured is accepted.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

from list3r.association.revisits import search
from list3r.association.revisits.frame_search import find_candidates
from list3r.association.revisits.joint_window import joint_edge
from list3r.association.revisits.search import RevisitSearch, RevisitSettings, ranked, with_scores
from list3r.memory.core.records import Edge
from list3r.memory.store.store import Store


@dataclass(frozen=True)
class PaperRevisitSettings(RevisitSettings):
    """Settings under which loops are accepted as the paper writes it."""

    least_score: float = 0.7
    """Least s_loop of a candidate, unless its frames alone are alike enough."""
    strict: float = 0.85
    """s_det, in [0, 1], from which they are (VGGT-Long)."""


@contextmanager
def paper_loops() -> Iterator[None]:
    """Let loops be found as the paper writes it under `PaperRevisitSettings`, and as builds do under all others."""
    with patch("list3r.pipeline.mapping.find_loops", _find_loops):
        yield


def _find_loops(store: Store, chunk_id: int, joint: Any, settings: RevisitSettings) -> list[Edge]:
    if isinstance(settings, PaperRevisitSettings):
        return loops_by_score(store, chunk_id, joint, settings)
    return search.find_loops(store, chunk_id, joint, settings)


def loops_by_score(store: Store, chunk_id: int, joint: Any, settings: PaperRevisitSettings) -> list[Edge]:
    """Return the loop edges between a chunk and those before it, accepted by s_loop."""
    chunks = RevisitSearch(store, chunk_id, settings)
    edges: list[Edge] = []
    tried = 0
    for scored in ranked(find_candidates(store, chunk_id, settings.search), chunks, settings.lambda_):
        c = scored.candidate
        if c.s_det < settings.strict and scored.score < settings.least_score:
            reason = f"frames and instances are not alike enough (s_loop {scored.score:.2f})"
            edge = chunks.refused(scored, reason)
        elif tried >= settings.verify or sum(e.accepted for e in edges) >= settings.enough:
            edge = chunks.refused(scored, "not tried: enough better candidates of this chunk were tried")
        else:
            edge = joint_edge(joint, *chunks.ends(c), None, settings.window)
            tried += 1
        edges.append(with_scores(edge, scored))
    return edges

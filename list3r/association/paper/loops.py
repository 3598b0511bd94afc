"""Loops by their score alone: s_loop, as the paper accepts them (3.2), or s_det, as VGGT-Long does.

Every relation above the threshold that a joint window measures is accepted. Where no model makes one, keyframes measure
it, which may refuse it: the paper has no such case.
"""

from __future__ import annotations

from list3r.association.revisits.frame_search import find_candidates
from list3r.association.revisits.joint_window import JointReconstructor, joint_edge
from list3r.association.revisits.search import RevisitSearch, RevisitSettings, ranked, with_scores
from list3r.memory.core.records import Edge
from list3r.memory.store.store import Store


def loops_by_score(
    store: Store, chunk_id: int, joint: JointReconstructor | None, settings: RevisitSettings
) -> list[Edge]:
    """Return the loop edges between a chunk and those before it, accepted by s_loop.

    They are measured by a joint window where the model makes one, else by the keyframes' features and depth.
    """
    chunks = RevisitSearch(store, chunk_id, settings)
    edges: list[Edge] = []
    tried = 0
    for scored in ranked(find_candidates(store, chunk_id, settings.search), chunks, settings.lambda_):
        if scored.score < settings.least_score:
            edge = chunks.refused(scored, f"frames and instances are not alike enough (s_loop {scored.score:.2f})")
        elif tried >= settings.verify or sum(e.accepted for e in edges) >= settings.enough:
            edge = chunks.refused(scored, "not tried: enough better candidates of this chunk were tried")
        else:
            if joint is not None:
                edge = joint_edge(joint, *chunks.ends(scored.candidate), None, settings.window)
            else:
                edge = chunks.verified(scored, None, ())
            tried += 1
        edges.append(with_scores(edge, scored))
    return edges

"""Find loop closures (paper 3.2 and A.2): frames propose, instances rank, geometry decides.

1. Frame descriptors propose candidates with a relaxed threshold (`frame_search`).
2. The instances of the two chunks add s_sem and s_rel (`instance_similarity`). Candidates are ranked by
   s_loop = lambda s_det + (1 - lambda) (s_sem + s_rel).
3. The best are verified by the keyframes' features and depth (`verification`) or, where keyframes have none, by a joint
   window (`joint_window`). Where networks make the chunks, a joint window is also tried after features failed.
4. A relation that the chain of accepted edges contradicts is refused (`chain`).

Every candidate becomes an edge, accepted or not, with its scores and the reason. The choice of the weights:
research/association 0045. `association/paper/loops.py` accepts loops by s_loop alone, as in the paper.
"""

from __future__ import annotations

import itertools
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from list3r.association.revisits.all_keyframes import (
    WITNESSED,
    AllKeyframesSettings,
    contradicted,
    place_by_all_keyframes,
)
from list3r.association.revisits.chain import ChainSettings, EdgeChains, Prediction
from list3r.association.revisits.constellations.instance_search import InstanceSearch, InstanceSearchSettings
from list3r.association.revisits.cross_check import Side
from list3r.association.revisits.frame_search import Candidate, SearchSettings, find_candidates, is_revisit
from list3r.association.revisits.further_pairs import FurtherPairSettings, are_independent, similar_views
from list3r.association.revisits.instance_similarity import (
    NO_SIMILARITY,
    InstanceSet,
    InstanceSimilarity,
    SimilaritySettings,
    compare_instances,
    instance_set,
    loop_score,
)
from list3r.association.revisits.joint_window import (
    JointReconstructor,
    Objection,
    Place,
    WindowSettings,
    joint_edge,
    no_edge,
)
from list3r.association.revisits.scaled_verification import verify_scaled
from list3r.association.revisits.verification import VerificationSettings, verify
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Edge, Keyframe
from list3r.memory.store.derived import LruCache
from list3r.memory.store.store import Store

_KEPT_BYTES = 16 << 20
"""Features of instances that are kept between chunks."""


@dataclass(frozen=True)
class RevisitSettings:
    """How revisits are found."""

    lambda_: float = 0.5
    """Weight of frame similarity in s_loop (the paper gives none), which ranks candidates (research/association
    0149)."""
    rule: str = "geometry"
    """What accepts a loop: geometry, or score (s_loop alone)."""
    least_score: float = 1.3
    """Of the rule score: least s_loop. The paper gives none; of 0.9 to 1.3 this one has the least error on the seeds
    1 to 3 of `benchmarks/association.py`, which no table holds."""
    verify: int = 24
    """Most candidates of a chunk that are verified."""
    enough: int = 8
    """Accepted edges after which no further candidate of a chunk is verified."""
    second_opinions: int = 0
    """Most joint windows of a chunk for keyframes with features and depth that were rejected. For RGB-D they cost
    seconds each and find little more (redkitchen)."""
    of_networks: int = 3
    """The same where a network makes the chunks: three passes over 40 frames take about as long as the chunk itself,
    and a network relates views that share too little for features (research/association 0151)."""
    most_ambiguous: float = 2.0
    """Least ratio of the relations that agree on the place of another component to those that contradict them, for
    them to be accepted."""
    layout_pairs: int = 5
    """Instances that must agree on a layout for its scale to count."""
    most_scale_ratio: float = 1.6
    """Largest ratio of an edge's scale to that of the instances' layout."""
    search: SearchSettings = field(default_factory=SearchSettings)
    similarity: SimilaritySettings = field(default_factory=SimilaritySettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    chain: ChainSettings = field(default_factory=ChainSettings)
    instances: InstanceSearchSettings = field(default_factory=InstanceSearchSettings)
    """Used where similar frames do not suffice."""
    further_pairs: FurtherPairSettings = field(default_factory=FurtherPairSettings)
    """Used where a single relation joins two sessions."""
    all_keyframes: AllKeyframesSettings = field(default_factory=AllKeyframesSettings)
    """Used where similar frames do not place a session."""


@dataclass(frozen=True)
class ScoredCandidate:
    """A candidate with the similarity of the instances of its two chunks."""

    candidate: Candidate
    similarity: InstanceSimilarity
    score: float
    """s_loop."""


def find_loops(
    store: Store,
    chunk_id: int,
    joint: JointReconstructor | None = None,
    settings: RevisitSettings | None = None,
) -> list[Edge]:
    """Find the loop edges, accepted or rejected, between a chunk and those stored before it.

    `joint` reconstructs frames of both places together; without one, chunks are compared by their keyframes alone.
    """
    chosen = settings or RevisitSettings()
    search = RevisitSearch(store, chunk_id, chosen)
    found = _by_frames(store, chunk_id, search, joint, chosen)
    edges = search.unambiguous(found)
    if chosen.instances.enabled and (by_instances := search.by_instances(edges)):
        edges = search.unambiguous([*found, *by_instances])  # instances also decide between places of frames
    return edges


def _by_frames(
    store: Store, chunk_id: int, search: RevisitSearch, joint: JointReconstructor | None, chosen: RevisitSettings
) -> list[Edge]:
    """Find the loop edges between a chunk and those with similar frames. The edges may contradict each other."""
    candidates = find_candidates(store, chunk_id, chosen.search)
    edges: list[Edge] = []
    tried = 0
    for scored in ranked(candidates, search, chosen.lambda_):
        accepted = [e for e in edges if e.accepted]
        if not search.wants_another(scored.candidate, accepted):
            edge = search.refused(scored, "not tried: a better candidate joins the two chunks")
        elif tried >= chosen.verify or len(accepted) >= chosen.enough:
            edge = search.refused(scored, "not tried: enough better candidates of this chunk were tried")
        else:
            edge = search.verified(scored, joint, accepted)
            tried += 1
        edges.append(with_scores(edge, scored))
    if (alone := search.alone(edges)) is not None:
        edges += search.further_pairs(alone, {e.frames for e in edges if e.u == alone.u})
    return search.by_all_keyframes(edges) if chosen.all_keyframes.chunks else edges


def ranked(candidates: Sequence[Candidate], search: RevisitSearch, weight: float) -> list[ScoredCandidate]:
    """Return candidates in order of s_loop with this weight of frame similarity, the best one of every pair of chunks
    before any second one."""
    out = []
    for candidate in candidates:
        similarity = search.similarity(candidate.u)
        out.append(ScoredCandidate(candidate, similarity, loop_score(candidate.s_det, similarity, weight)))
    out.sort(key=lambda s: (-s.score, s.candidate.u, s.candidate.frame_u, s.candidate.frame_v))
    seen: list[int] = []
    turn = []
    for scored in out:
        turn.append(seen.count(scored.candidate.u))
        seen.append(scored.candidate.u)
    return [out[n] for n in sorted(range(len(out)), key=lambda n: (turn[n], n))]


def with_scores(edge: Edge, scored: ScoredCandidate) -> Edge:
    """Return an edge with the scores of its candidate."""
    scores = {
        "cosine": scored.candidate.cosine,
        "s_det": scored.candidate.s_det,
        "s_sem": scored.similarity.s_sem,
        "s_rel": scored.similarity.s_rel,
        "s_loop": scored.score,
        "pairs": float(len(scored.similarity.pairs)),
    }
    return replace(edge, scores=edge.scores | scores)


def _objected(edge: Edge, objection: Objection) -> Edge:
    """Return an edge, rejected where there is an objection."""
    against = objection(edge.S_v_u) if edge.accepted else None
    return edge if against is None else _rejected(edge, against)


def _rejected(edge: Edge, why: str) -> Edge:
    return replace(edge, accepted=False, weight=0.0, reason=f"{why} ({edge.reason})")


def _comparable(keyframe: Keyframe) -> bool:
    """Tell whether a keyframe has local features and depth."""
    return bool(keyframe.depth_small.size) and len(keyframe.keypoints_xy) > 0


class InstanceSets(LruCache[int, tuple[object, InstanceSet]]):
    """Instances of the chunks that were compared last, with a key of their inputs."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, lambda held: held[1].feature.nbytes + held[1].center.nbytes)


class RevisitSearch:
    """The new chunk and the stored ones that it is compared with, each read once."""

    def __init__(self, store: Store, chunk_id: int, settings: RevisitSettings) -> None:
        self._store = store
        self._id = chunk_id
        self._settings = settings
        self._rows = {c.chunk_id: c for c in store.chunks.all()}
        self._sides: dict[int, Side] = {}
        self._similarity: dict[int, InstanceSimilarity] = {}
        self._chains = EdgeChains(store.edges.all(), settings.chain)
        self._connected = self._chains.connected_to(chunk_id)
        self._second_opinions = settings.second_opinions

    def similarity(self, u: int) -> InstanceSimilarity:
        """Compare the instances of a stored chunk with those of the new one."""
        if u not in self._similarity:
            here, there = self._instances(self._id), self._instances(u)
            self._similarity[u] = compare_instances(there, here, self._settings.similarity)
        return self._similarity[u]

    def _keyframes(self, c: Candidate) -> tuple[Keyframe, Keyframe]:
        return self._store.keyframes.get(c.u, c.frame_u), self._store.keyframes.get(self._id, c.frame_v)

    def by_instances(self, found: Sequence[Edge]) -> list[Edge]:
        """Return loop edges by the chunks' instances alone, to chunks that no frame joins to the new one."""
        joined = {k for e in found if e.accepted for k in self._chains.connected_to(e.u)}
        revisits = [k for k, row in self._rows.items() if is_revisit(self._rows[self._id], row, self._settings.search)]
        apart = [k for k in revisits if self._apart(k) and k not in joined]
        tied = [] if any(e.accepted for e in found) else [k for k in revisits if not self._apart(k)]
        if not apart and not tied:
            return []
        by_instances = InstanceSearch(self._store, self._rows, self._id, self._side, self._settings.instances)
        return by_instances.edges(apart, tied, self._chains, self._settings.chain.most_deviations)

    def refused(self, scored: ScoredCandidate, reason: str) -> Edge:
        """Return an edge that is kept only for the record."""
        return no_edge(self._id_of(scored), (self._id, scored.candidate.frame_v), reason)

    def verified(self, scored: ScoredCandidate, joint: JointReconstructor | None, found: Sequence[Edge]) -> Edge:
        """Return the edge of a candidate, by keyframes where they have features and depth, else by a joint window."""
        c = scored.candidate
        u, v = self._rows[c.u], self._rows[self._id]
        chain = None if self._apart(c.u) else self._chains.predict(c.u, self._id, found)
        metric = u.scale_kind == v.scale_kind == "metric"
        later = u.session_id != v.session_id
        objection = partial(self._objection, NO_SIMILARITY if metric else scored.similarity, chain)
        edge = None
        keyframe_u, keyframe_v = self._keyframes(c)
        if _comparable(keyframe_u) and _comparable(keyframe_v):
            check = verify if metric else verify_scaled
            edge = check(keyframe_u, keyframe_v, c.u, self._id, settings=self._settings.verification, later=later)
            edge = _objected(edge, objection)
        if joint is None or (edge is not None and (edge.accepted or not self._second_opinions)):
            edge = edge or self.refused(scored, "its keyframes have no features and depth, and no model is available")
        else:
            self._second_opinions -= edge is not None
            edge = joint_edge(joint, *self.ends(c), objection, self._settings.window)
        measured = bool(edge.S_v_u.translation.any())
        off = {"way": chain.deviations(edge.S_v_u)} if chain is not None and measured else {}
        return replace(edge, scores=edge.scores | off)

    def wants_another(self, c: Candidate, accepted: Sequence[Edge]) -> bool:
        """Return whether a candidate would join two chunks at frames apart from those that join them so far.

        Where a joint window has to tell, and between sessions, one relation of a pair of chunks is enough, but for a
        single one of two components.
        """
        joined = [e for e in accepted if e.u == c.u]
        if not joined or self._apart(c.u):
            return not joined or len(accepted) == 1
        apart = self._settings.further_pairs.apart
        return all(map(_comparable, self._keyframes(c))) and all(
            e.frames is not None and apart.of(e.frames, (c.frame_u, c.frame_v)) for e in joined
        )

    def alone(self, edges: Sequence[Edge]) -> Edge | None:
        """Return the accepted edge that joins the new chunk to another session, if no other edge supports it."""
        accepted = [e for e in edges if e.accepted]
        session = {k: row.session_id for k, row in self._rows.items()}
        apart = self._settings.further_pairs.apart
        if any(e.frames is None or session[e.u] == session[self._id] or not self._apart(e.u) for e in accepted):
            return None
        if any(are_independent(e, f, session, apart) for e, f in itertools.combinations(accepted, 2)):
            return None
        return max(accepted, key=lambda e: (e.confidence, -e.u), default=None)

    def further_pairs(self, edge: Edge, known: Container[tuple[int, int] | None]) -> list[Edge]:
        """Return relations of further keyframes of two chunks, until one more is accepted (research/sessions 0056).

        The edge only decides which keyframes are compared: each pair is compared as if nothing were known.
        """
        sides = self._side(edge.u).samples, self._side(self._id).samples
        u, v = (self._store.keyframes.descriptors([k])[0][:, 1].tolist() for k in (edge.u, self._id))
        out: list[Edge] = []
        for frame_u, frame_v in similar_views(edge, sides, (u, v), self._settings.further_pairs):
            scored = ScoredCandidate(Candidate(edge.u, frame_u, frame_v, 0.0, 0.0), NO_SIMILARITY, 0.0)
            if (frame_u, frame_v) not in known and all(map(_comparable, self._keyframes(scored.candidate))):
                out.append(self.verified(scored, None, ()))
            if out and out[-1].accepted:
                break
        return out

    def by_all_keyframes(self, edges: Sequence[Edge]) -> list[Edge]:
        """Return the edges with those between all keyframes of this chunk and other sessions, where similar frames do
        not place it (research/sessions 0134). Edges that they contradict are rejected, repeated ones replaced."""
        s, here, session = self._settings, self._rows[self._id], {k: r.session_id for k, r in self._rows.items()}
        others = [e for e in edges if session[e.u] != here.session_id and self._apart(e.u)]
        similar = sorted(others, key=lambda e: (not e.accepted, -e.scores.get("s_det", 0.0), e.u))
        metric = [e.u for e in similar if self._rows[e.u].scale_kind == here.scale_kind == "metric"]
        sure = [e for e in similar if e.accepted and e.u in metric]
        agree = [
            e
            for e, f in itertools.combinations(sure, 2)
            if are_independent(e, f, session, s.further_pairs.apart) and self._agree(e, f)
        ]
        if agree and not contradicted(
            agree[0], self._comparable_keyframes(agree[0].u), self._comparable_keyframes(self._id), s.all_keyframes
        ):
            return list(edges)
        out = list(edges)
        for u in list(dict.fromkeys(metric))[: s.all_keyframes.chunks]:
            ends = (u, self._comparable_keyframes(u)), (self._id, self._comparable_keyframes(self._id))
            found = place_by_all_keyframes(*ends, s.verification, s.all_keyframes)
            again = {e.frames for e in found}
            rest = [e for e in out if e.u != u or e.frames not in again]
            out = [self._contradicted(e, found) for e in rest] + found
        if agree and not any(WITNESSED in e.scores for e in out):
            wrong, why = {(e.u, e.frames) for e in sure}, "the rest of both chunks contradicts it"
            out = [_rejected(e, why) if (e.u, e.frames) in wrong else e for e in out]
        return out

    def _comparable_keyframes(self, chunk_id: int) -> list[Keyframe]:
        """Return the keyframes of a chunk that have features and depth."""
        return [f for f in self._store.keyframes.of(chunk_id) if _comparable(f)]

    def _contradicted(self, edge: Edge, found: Sequence[Edge]) -> Edge:
        """Return an edge, rejected if it disagrees with the place that all keyframes of both chunks support."""
        if not edge.accepted or not found or self._agree(found[0], edge):
            return edge
        return _rejected(edge, "all keyframes of both chunks contradict it")

    def unambiguous(self, edges: Sequence[Edge]) -> list[Edge]:
        """Return the edges, with those rejected that join separate components in contradictory ways.

        If no chain of edges leads from one chunk to the other, only another relation can contradict a false one. So
        each relation is found without regard to the others, and those that agree support each other. If the other
        places have too many relations (`most_ambiguous`), none is accepted until a later chunk decides.
        """
        across = [k for k, e in enumerate(edges) if e.accepted and self._apart(e.u)]
        if len(across) < 2:
            return list(edges)
        agree = {k: [n for n in across if n == k or self._agree(edges[k], edges[n])] for k in across}
        best = max(across, key=lambda k: (len(agree[k]), edges[k].confidence))
        others = [k for k in across if k not in agree[best]]
        unsure = len(agree[best]) < self._settings.most_ambiguous * len(others)
        out = list(edges)
        for k in across if others and unsure else others:
            why = "other places fit as well" if unsure else "more relations contradict it"
            out[k] = _rejected(edges[k], why)
        return out

    def _agree(self, one: Edge, other: Edge) -> bool:
        """Return whether two relations of the new chunk can both be true; to different components they always can."""
        chain = self._chains.predict(other.u, self._id, [one])
        return chain is None or chain.deviations(other.S_v_u) <= self._settings.chain.most_deviations

    def _apart(self, u: int) -> bool:
        """Return whether no edges joined a chunk to the new one before."""
        return u not in self._connected

    def _objection(self, similarity: InstanceSimilarity, chain: Prediction | None, S_v_u: Sim3) -> str | None:
        """Return how the chain of edges between the chunks or the layout of instances contradicts a relation."""
        if chain is not None and (off := chain.deviations(S_v_u)) > self._settings.chain.most_deviations:
            return f"the chain of edges between the chunks contradicts it by {off:.0f} deviations"
        if len(similarity.pairs) >= self._settings.layout_pairs and np.isfinite(similarity.log_scale):
            ratio = float(np.exp(abs(np.log(float(S_v_u.scale)) - similarity.log_scale)))
            if ratio > self._settings.most_scale_ratio:
                return f"its scale is {ratio:.1f} times off that of the instances' layout"
        return None

    def ends(self, c: Candidate) -> tuple[Place, Place]:
        """Return the two places of a candidate."""
        return self._place(self._rows[c.u], c.frame_u), self._place(self._rows[self._id], c.frame_v)

    def _place(self, row: ChunkRow, frame: int) -> Place:
        return Place(row.chunk_id, row.session_id, frame, row.scale_kind == "metric", self._side(row.chunk_id))

    def _side(self, chunk_id: int) -> Side:
        if chunk_id not in self._sides:
            row, samples = self._rows[chunk_id], self._store.chunks.samples(chunk_id)
            height, width = row.image_size
            moving = frozenset(self._store.local_instances.dynamic(chunk_id))
            camera = Camera(width, height, *row.intrinsics)
            self._sides[chunk_id] = Side(samples, camera, self._instances(chunk_id), moving)
        return self._sides[chunk_id]

    def _instances(self, chunk_id: int) -> InstanceSet:
        """Return the instances of a chunk, cached while the store is open: a place is compared again and again."""
        store, kept = self._store, self._store.derived.of(InstanceSets)
        key = (store.chunks.checksum(chunk_id), self._settings.similarity)
        held = kept.get(chunk_id)
        if held is None or held[0] != key:
            samples, nodes = store.chunks.samples(chunk_id), store.local_instances.nodes([chunk_id])
            space = store.chunks.feature_space(chunk_id)
            held = kept.put(chunk_id, (key, instance_set(nodes, samples.T_chunk_cam, space, self._settings.similarity)))
        return held[1]

    def _id_of(self, scored: ScoredCandidate) -> tuple[int, int]:
        return scored.candidate.u, scored.candidate.frame_u

"""The graph of chunks against gtsam: time, optimum, uncertainty, false loops.

    python benchmarks/pose_graph.py [--json FILE] [--seeds 1,2,3]

A walk of 1,000 chunks through a building of 60 m x 60 m that comes by the same places again: 999 adjacent edges and
4,001 loops between the nearest chunks. gtsam (a development dependency) gets the same graph, weights and start. Seconds
are of processor time, on one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from list3r.association.graph.edge_information import WeightSettings, information_of
from list3r.association.graph.incremental import extend
from list3r.association.graph.marginals import marginals
from list3r.association.graph.pose_graph import GraphResult, GraphSettings, optimize
from list3r.association.graph.solver import GraphProblem
from list3r.memory.core.geometry import Sim3, stack, take, umeyama
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Walk:
    """Truth and measured edges."""

    truth: Sim3
    """Shape (K,)."""
    edges: list[Edge]
    false: NDArray[np.bool_]
    """Shape (E,)."""


def walk(
    chunks: int, edge_count: int, seed: int, false: float = 0.0, alike: bool = False, metric: bool = False
) -> Walk:
    """A seeded walk with loops between near chunks; `false` ones are added, in runs that agree if `alike`."""
    rng = np.random.default_rng(seed)
    truth = stack(_poses(chunks, rng))
    if metric:
        truth = replace(truth, scale=np.ones(chunks))
    near = np.linalg.norm(truth.translation[:, None] - truth.translation[None], axis=2)
    i, j = np.triu_indices(chunks, 6)
    closest = np.argsort(near[i, j], kind="stable")[: edge_count - chunks + 1]
    pairs = [(k, k + 1) for k in range(chunks - 1)] + list(zip(i[closest], j[closest], strict=True))
    edges = [
        _edge(truth, int(u), int(v), rng, "adjacent" if n < chunks - 1 else "loop") for n, (u, v) in enumerate(pairs)
    ]
    wrong: list[Edge] = []
    count = round(len(closest) * false / (1 - false))
    while len(wrong) < count:
        a, b = sorted(int(k) for k in rng.choice(chunks, 2, replace=False))
        turn = Sim3.exp([0, 0, 0, 0, 0, rng.uniform(-np.pi, np.pi), 0]).rotation
        S = Sim3(np.ones(()), turn, truth.translation[b] - turn @ truth.translation[a])
        for _ in range(min(int(rng.integers(3, 7)) if alike else 1, count - len(wrong))):
            u, v = (int(np.clip(k + rng.integers(-2, 3), 0, chunks - 1)) for k in (a, b))
            if v - u > 5 and near[u, v] > 4.0:
                wrong.append(_edge(truth, u, v, rng, "loop", S))
    return Walk(truth, edges + wrong, np.arange(len(edges) + len(wrong)) >= len(edges))


def _poses(chunks: int, rng: np.random.Generator) -> list[Sim3]:
    heading, position, out = 0.0, np.zeros(3), []
    for _ in range(chunks):
        heading += rng.normal(0, 0.35)
        step = 1.5 * np.array([np.cos(heading), np.sin(heading), 0.0])
        if np.abs(position + step).max() > 30.0:
            heading += np.pi / 2
            step = np.clip(position + step, -30.0, 30.0) - position
        position = position + step
        tilt = rng.normal(0, 0.05, 2)
        rotation = Sim3.exp([0, 0, 0, *tilt, heading, 0]).rotation
        out.append(Sim3(np.exp(rng.normal(0, 0.2)), rotation, position.copy()))
    return out


def _edge(truth: Sim3, u: int, v: int, rng: np.random.Generator, kind: str, alike: Sim3 | None = None) -> Edge:
    S_world_u, S_world_v = (take(truth, np.array(k)) for k in (u, v))
    S_v_u = S_world_v.inverse() @ (S_world_u if alike is None else alike @ S_world_u)
    lever = 1.5 / float(S_world_u.scale)
    deviation = 0.006 * np.exp(rng.normal(0, 0.5)) * np.array([lever] * 3 + [1.0] * 4)
    noise = deviation * rng.normal(size=7)
    if (truth.scale == 1.0).all():
        noise[6] = 0.0
    S_v_u = S_v_u @ Sim3.exp(noise)
    scores = {"spread": 3.0 / float(S_world_v.scale)}
    return Edge(u, v, kind, S_v_u, 0.8, 0.8, 500, 0.01, True, "measured", scores, covariance=np.diag(deviation**2))


def chained(edges: list[Edge], first: Sim3) -> Sim3:
    """Poses along the adjacent edges, the poor start."""
    out = [first]
    for edge in edges:
        if edge.kind == "adjacent":
            out.append(out[-1] @ edge.S_v_u.inverse())
    return stack(out)


def ate(poses: Sim3, truth: Sim3) -> float:
    """RMSE of positions after Sim(3) alignment."""
    fit = umeyama(poses.translation, truth.translation, with_scale=True)
    return float(np.sqrt(((fit.apply(poses.translation) - truth.translation) ** 2).sum(axis=1).mean()))


def timed(run: Callable[[], Any], repeat: int = 3) -> tuple[Any, float]:
    """The result, and the least processor time of some runs."""
    best, result = np.inf, None
    for _ in range(repeat):
        started = time.process_time()
        result = run()
        best = min(best, time.process_time() - started)
    return result, round(best, 4)


def as_gtsam(S: Sim3, k: int, metric: bool = False) -> gtsam.Similarity3 | gtsam.Pose3:
    """gtsam writes a similarity as s (R p + t)."""
    rotation = gtsam.Rot3(S.rotation[k])
    if metric:
        return gtsam.Pose3(rotation, S.translation[k])
    return gtsam.Similarity3(rotation, S.translation[k] / S.scale[k], float(S.scale[k]))


def gtsam_graph(
    w: Walk, start: Sim3, stated: bool = False, metric: bool = False
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same cost: unit weights, or each edge's covariance where `stated`."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    measured = stack([e.S_v_u for e in w.edges])
    between = gtsam.BetweenFactorPose3 if metric else gtsam.BetweenFactorSimilarity3
    held = gtsam.NonlinearEqualityPose3 if metric else gtsam.NonlinearEqualitySimilarity3
    order = [3, 4, 5, 0, 1, 2, 6]  # gtsam: turn, shift, scale
    for k, e in enumerate(w.edges):
        noise = gtsam.noiseModel.Unit.Create(6 if metric else 7)
        if stated:
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diag(e.covariance))[order])
        graph.add(between(e.v, e.u, as_gtsam(measured, k, metric), noise))
    graph.add(held(0, as_gtsam(start, 0, metric)))
    for k in range(len(start.scale)):
        values.insert(k, as_gtsam(start, k, metric))
    return graph, values


def from_gtsam(values: gtsam.Values, count: int, metric: bool = False) -> Sim3:
    """Poses of a gtsam solution."""
    if metric:
        rigid = [values.atPose3(k) for k in range(count)]
        return stack([Sim3(np.ones(()), T.rotation().matrix(), T.translation()) for T in rigid])
    found = [values.atSimilarity3(k) for k in range(count)]
    return stack([Sim3(np.array(s.scale()), s.rotation().matrix(), s.translation() * s.scale()) for s in found])


def uncertainty(chunks: int, edges: int, seed: int) -> dict[str, Any]:
    """Covariance of every chunk and redundancy of every edge, by our factor and by gtsam's `Marginals`; and whether
    two runs of gtsam give the same bits."""
    w = walk(chunks, edges, seed)
    start = chained(w.edges, take(w.truth, np.array(0)))
    u, v = np.array([e.u for e in w.edges]), np.array([e.v for e in w.edges])
    unit = np.tile(np.eye(7), (len(u), 1, 1))
    problem = GraphProblem.build(u, v, stack([e.S_v_u for e in w.edges]), unit, np.arange(chunks) == 0)

    def solved() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        graph, values = gtsam_graph(w, start)
        return graph, gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()

    (graph, at), again = solved(), solved()[1]
    first, second = from_gtsam(at, chunks), from_gtsam(again, chunks)
    blocks, seconds = timed(lambda: marginals(problem, first, np.ones(len(u))), 1)

    def chunk_blocks() -> gtsam.Marginals:
        found = gtsam.Marginals(graph, at)
        for k in range(chunks):
            found.marginalCovariance(k)
        return found

    found, seconds_chunks = timed(chunk_blocks, 1)

    def edge_blocks() -> None:
        for e in w.edges:
            found.jointMarginalCovariance(gtsam.KeyVector([e.u, e.v])).at(e.u, e.v)

    _, seconds_edges = timed(edge_blocks, 1)
    return {
        "seed": seed,
        "redundancy": float(blocks.redundancy.sum()),
        "seconds": seconds,
        "seconds_gtsam_chunks": seconds_chunks,
        "seconds_gtsam_edges": seconds_edges,
        "gtsam_twice_the_same_bits": all(
            np.array_equal(getattr(first, part), getattr(second, part)) for part in ("scale", "rotation", "translation")
        ),
    }


def full(chunks: int, edges: int, seed: int, metric: bool) -> dict[str, Any]:
    """Plain least squares from the chain, compared with gtsam's Levenberg-Marquardt."""
    w = walk(chunks, edges, seed, metric=metric)
    start = chained(w.edges, take(w.truth, np.array(0)))
    u, v = np.array([e.u for e in w.edges]), np.array([e.v for e in w.edges])
    fixed, ones, unit = np.arange(chunks) == 0, np.ones(len(u)), np.eye(6 if metric else 7)

    def ours() -> tuple[GraphProblem, Sim3]:
        problem = GraphProblem.build(u, v, stack([e.S_v_u for e in w.edges]), np.tile(unit, (len(u), 1, 1)), fixed)
        return problem, problem.solve(start, ones, 50)

    def theirs(tight: bool) -> gtsam.Values:
        graph, values = gtsam_graph(w, start, metric=metric)
        parameters = gtsam.LevenbergMarquardtParams()
        if tight:
            parameters.setRelativeErrorTol(1e-12)
            parameters.setAbsoluteErrorTol(1e-12)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()

    (problem, poses), seconds = timed(ours)
    _, seconds_gtsam = timed(lambda: theirs(tight=False))
    tight = theirs(tight=True)
    _, seconds_marginals = timed(lambda: marginals(problem, poses, ones))
    graph, at_ours = gtsam_graph(w, poses, metric=metric)
    return {
        "seed": seed,
        "group": "SE(3)" if metric else "Sim(3)",
        "cost_at_start": float(problem.squares(start).sum()),
        "cost": float(problem.squares(poses).sum()),
        "cost_over_gtsam_minus_1": graph.error(at_ours) / graph.error(tight) - 1.0,
        "our_cost_over_gtsams_cost_of_our_poses_minus_1": float(problem.squares(poses).sum())
        / (2 * graph.error(at_ours))
        - 1.0,
        "seconds": seconds,
        "seconds_gtsam": seconds_gtsam,
        "seconds_marginals": seconds_marginals,
    }


def one_more(chunks: int, edges: int, seed: int) -> dict[str, Any]:
    """One chunk into a finished graph: a leaf, with loops that agree, with a loop that moves the map."""
    w = walk(chunks, edges, seed)
    ids, last = list(range(chunks)), chunks - 1
    start = {0: take(w.truth, np.array(0))}
    before = [e for e in w.edges if last not in (e.u, e.v)]
    placed, seconds_full = timed(lambda: optimize(ids[:-1], before, start, metric=False), 1)
    new = [e for e in w.edges if last in (e.u, e.v)]
    leaf = [e for e in new if e.kind == "adjacent"]
    loops = new if len(new) > 1 else [*leaf, _edge(w.truth, last // 2, last, np.random.default_rng(1), "loop")]
    moved = [
        replace(e, S_v_u=e.S_v_u @ Sim3.exp([0.05, 0.03, 0, 0, 0.01, 0, 0])) if e.kind == "loop" else e for e in loops
    ]
    out: dict[str, Any] = {"seconds_full_robust_weighted": seconds_full, "loops": len(loops) - 1}
    for name, added in (("leaf", leaf), ("agreeing_loops", loops), ("loops_that_move_the_map", moved)):
        known = [*placed.edges, *added]
        result, out[f"seconds_{name}"] = timed(lambda known=known: extend(last, ids, known, placed, metric=False))
        out[f"ate_{name}"] = ate(stack([result.S_graph_chunk[k] for k in ids]), w.truth)
    return out


def gnc(w: Walk, start: Sim3, weights: Array | None) -> tuple[Sim3, NDArray[np.bool_]]:
    """gtsam's graduated non-convexity with our limits: poses, and which edges it believes. Without `weights` every edge
    has the covariance that it states, else the information that we give it. Shape (E, 7, 7)."""
    chunks = len(start.scale)
    graph, values = gtsam_graph(w, start, stated=True)
    if weights is not None:
        order, measured = [3, 4, 5, 0, 1, 2, 6], stack([e.S_v_u for e in w.edges])
        for k, e in enumerate(w.edges):
            noise = gtsam.noiseModel.Gaussian.Information(weights[k][np.ix_(order, order)])
            graph.replace(k, gtsam.BetweenFactorSimilarity3(e.v, e.u, as_gtsam(measured, k), noise))
    parameters = gtsam.GncLMParams()
    parameters.setKnownInliers([*range(chunks - 1), len(w.edges)])
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    optimizer.setInlierCostThresholds(float(chi2.ppf(GraphSettings().trust.loop_quantile, 7)) / 2)
    poses = from_gtsam(optimizer.optimize(), chunks)
    return poses, optimizer.getWeights()[: len(w.edges)] > 0.5


def false_loops(chunks: int, edges: int, seed: int, alike: bool, drift: float = 1.0) -> dict[str, Any]:
    """The same graph without and with 30 % false loops; gtsam's GNC (truncated least squares) next to it. `drift` times
    as large as stated are the errors of adjacent edges."""
    clean, spoilt = (drifting(walk(chunks, edges, seed, *bad), drift, seed) for bad in ((0.0, False), (0.3, alike)))
    first = {0: take(clean.truth, np.array(0))}
    ids = list(range(chunks))

    def solved(w: Walk, settings: GraphSettings | None = None) -> GraphResult:
        return optimize(ids, w.edges, first, metric=False, settings=settings)

    def placed(result: GraphResult) -> float:
        return ate(stack([result.S_graph_chunk[k] for k in ids]), clean.truth)

    without, (with_false, seconds) = placed(solved(clean)), timed(lambda: solved(spoilt), 1)
    plain = solved(spoilt, GraphSettings(weights=WeightSettings(rule="equal"), robust=False))
    believed = np.array([e.accepted for e in with_false.edges])
    start = chained(spoilt.edges, first[0])
    row = {
        "seed": seed,
        "alike": alike,
        "drift": drift,
        "ate": without,
        "ate_with_false": placed(with_false),
        "ratio": placed(with_false) / without,
        "ate_plain": placed(plain),
        "seconds": seconds,
        "false_kept": int((believed & spoilt.false).sum()),
        "true_lost": int((~believed & ~spoilt.false).sum()),
    }
    ours = information_of(spoilt.edges, False, WeightSettings())
    for name, weights in (("gnc", None), ("gnc_our_weights", ours)):
        (poses, kept), row[f"seconds_gtsam_{name}"] = timed(lambda weights=weights: gnc(spoilt, start, weights), 1)
        row[f"ate_gtsam_{name}"] = ate(poses, clean.truth)
        row[f"false_kept_gtsam_{name}"] = int((kept & spoilt.false).sum())
        row[f"true_lost_gtsam_{name}"] = int((~kept & ~spoilt.false).sum())
    return row


def drifting(w: Walk, times: float, seed: int) -> Walk:
    """The walk with overconfident adjacent edges, as those of bent chunks."""
    if times == 1.0:
        return w
    rng = np.random.default_rng(seed + 1000)
    edges = [
        replace(e, S_v_u=e.S_v_u @ Sim3.exp(np.sqrt((times**2 - 1.0) * np.diag(e.covariance)) * rng.normal(size=7)))
        if e.kind == "adjacent"
        else e
        for e in w.edges
    ]
    return replace(w, edges=edges)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--seeds", default="1,2,3")
    chosen = parser.parse_args()
    seeds = [int(s) for s in chosen.seeds.split(",")]
    print(machine())
    with threadpool_limits(1):  # matrices of 7 x 7: several threads only wait for each other
        measure(seeds, chosen.json)


def measure(seeds: list[int], path: Path | None) -> None:
    """All parts, printed and written."""
    result: dict[str, Any] = {"full": [full(1000, 5000, s, metric) for s in seeds for metric in (False, True)]}
    print(*result["full"], sep="\n")
    result["uncertainty"] = [uncertainty(1000, 5000, seed) for seed in seeds]
    print(*result["uncertainty"], sep="\n")
    result["one_more"] = one_more(1000, 5000, seeds[0])
    print(result["one_more"])
    result["false_loops"] = [
        false_loops(200, 600, s, alike, drift) for s in seeds for drift in (1.0, 5.0) for alike in (False, True)
    ]
    print(*result["false_loops"], sep="\n")
    write_json(path, result)


if __name__ == "__main__":
    main()

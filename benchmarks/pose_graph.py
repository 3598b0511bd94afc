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
from threadpoolctl import threadpool_limits

from list3r.association.graph.growth import extend
from list3r.association.graph.marginals import marginals
from list3r.association.graph.pose_graph import GraphResult, GraphSettings, optimize
from list3r.association.graph.solver import GraphProblem, stack, take
from list3r.memory.geometry import Sim3, umeyama
from list3r.memory.records import Edge

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


def full(chunks: int, edges: int, seed: int, metric: bool) -> dict[str, Any]:
    """Plain least squares from the chain, beside gtsam's Levenberg-Marquardt."""
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


def false_loops(chunks: int, edges: int, seed: int, alike: bool) -> dict[str, Any]:
    """The same graph without and with 30 % false loops; gtsam's GNC (truncated least squares) beside it."""
    clean, spoilt = walk(chunks, edges, seed), walk(chunks, edges, seed, 0.3, alike)
    first = {0: take(clean.truth, np.array(0))}
    ids = list(range(chunks))

    def solved(w: Walk, settings: GraphSettings | None = None) -> GraphResult:
        return optimize(ids, w.edges, first, metric=False, settings=settings)

    def placed(result: GraphResult) -> float:
        return ate(stack([result.S_graph_chunk[k] for k in ids]), clean.truth)

    without, (with_false, seconds) = placed(solved(clean)), timed(lambda: solved(spoilt), 1)
    graph, values = gtsam_graph(spoilt, chained(spoilt.edges, first[0]), stated=True)
    parameters = gtsam.GncLMParams()
    parameters.setKnownInliers(list(range(chunks - 1)))
    gnc, seconds_gnc = timed(lambda: gtsam.GncLMOptimizer(graph, values, parameters).optimize(), 1)
    kept = sum(e.accepted for e, wrong in zip(with_false.edges, spoilt.false, strict=True) if wrong)
    lost = sum(not e.accepted for e, wrong in zip(with_false.edges, spoilt.false, strict=True) if not wrong)
    return {
        "seed": seed,
        "alike": alike,
        "ate": without,
        "ate_with_false": placed(with_false),
        "ratio": placed(with_false) / without,
        "ate_plain": placed(solved(spoilt, GraphSettings(weighted=False, robust=False))),
        "ate_gtsam_gnc": ate(from_gtsam(gnc, chunks), clean.truth),
        "seconds": seconds,
        "seconds_gtsam_gnc": seconds_gnc,
        "false_kept": kept,
        "true_lost": lost,
    }


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
    result["one_more"] = one_more(1000, 5000, seeds[0])
    print(result["one_more"])
    result["false_loops"] = [false_loops(200, 600, s, alike) for s in seeds for alike in (False, True)]
    print(*result["false_loops"], sep="\n")
    write_json(path, result)


if __name__ == "__main__":
    main()

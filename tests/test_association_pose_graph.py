"""Laws of the graph: gauge, order, streaming and batch; what its covariances promise; and degenerate graphs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from list3r.association.graph.block_cholesky import BlockFactor, BlockPattern, NotPositiveError
from list3r.association.graph.edge_information import WeightSettings, support_of
from list3r.association.graph.edge_trust import Tree, chain_squares
from list3r.association.graph.incremental import extend
from list3r.association.graph.pose_graph import GraphResult, GraphSettings, optimize
from list3r.association.graph.solver import GraphProblem, adjoint
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3, skew, stack, take
from list3r.memory.core.records import Edge

UNIT = np.array([1.5] * 3 + [1.0] * 4)


def walk(count: int, seed: int) -> list[Sim3]:
    """Chunks twice round a square of 8 m, each with a scale of its own."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        angle = 4 * np.pi * k / count
        position = 4 * np.array([np.cos(angle), np.sin(angle), 0.0]) + rng.normal(0, 0.1, 3)
        turn = Sim3.exp([0, 0, 0, *rng.normal(0, 0.05, 2), angle, 0]).rotation
        out.append(Sim3(np.exp(rng.normal(0, 0.3)), turn, position))
    return out


def measured(
    truth: list[Sim3], u: int, v: int, kind: str, rng: np.random.Generator, deviation: float = 0.01, stated: float = 1.0
) -> Edge:
    unit = UNIT / np.array([float(truth[u].scale)] * 3 + [1.0] * 4) * deviation
    S_v_u = truth[v].inverse() @ truth[u] @ Sim3.exp(unit * rng.normal(size=7))
    scores = {"spread": 3.0 / float(truth[v].scale)}
    covariance = np.diag((unit * stated) ** 2)
    return Edge(u, v, kind, S_v_u, 0.8, 0.8, 100, 0.01, True, "measured", scores, covariance=covariance)


def graph(seed: int, count: int = 40, loops: int = 30, stated: float = 1.0) -> tuple[list[Sim3], list[Edge]]:
    truth, rng = walk(count, seed), np.random.default_rng([seed, 1])
    edges = [measured(truth, k, k + 1, "adjacent", rng, stated=stated) for k in range(count - 1)]
    half = count // 2
    for _ in range(loops):
        u = int(rng.integers(0, half))
        edges.append(measured(truth, u, int(np.clip(u + half + rng.integers(-1, 2), 0, count - 1)), "loop", rng))
    return truth, edges


def solved(truth: list[Sim3], edges: list[Edge], settings: GraphSettings | None = None) -> GraphResult:
    return optimize(range(len(truth)), edges, {0: truth[0]}, metric=False, settings=settings)


def apart(a: Sim3, b: Sim3) -> float:
    return float(np.abs((a.inverse() @ b).log()).max())


def normalised(result: GraphResult, truth: list[Sim3]) -> np.ndarray:
    """Squared Mahalanobis distance of every position but the first."""
    out = []
    for k in range(1, len(truth)):
        error = (result.S_graph_chunk[k].inverse() @ truth[k]).log()[:3]
        out.append(error @ np.linalg.solve(result.covariances[k][:3, :3], error))
    return np.array(out)


# -------------------------------------------------------------------------------------------------------- laws


def test_the_world_may_lie_anywhere() -> None:
    truth, edges = graph(1)
    moved = Sim3.exp([3.0, -2.0, 1.0, 0.4, -0.3, 1.0, 0.6])
    here, there = solved(truth, edges), optimize(range(40), edges, {0: moved @ truth[0]}, metric=False)
    for k in range(40):
        assert apart(moved @ here.S_graph_chunk[k], there.S_graph_chunk[k]) < 1e-6
        assert np.allclose(here.covariances[k], there.covariances[k], rtol=1e-4, atol=1e-12)


def test_every_chunk_may_have_a_frame_of_its_own() -> None:
    truth, edges = graph(2)
    rng = np.random.default_rng(0)
    gauges = [Sim3.exp(rng.normal(0, 0.5, 7)) for _ in truth]
    turned = []
    for e in edges:
        gauge = gauges[e.u].inverse()
        covariance = adjoint(gauge) @ e.covariance @ adjoint(gauge).T
        scores = {"spread": e.scores["spread"] / float(gauges[e.v].scale)}
        S_v_u = gauges[e.v].inverse() @ e.S_v_u @ gauges[e.u]
        turned.append(replace(e, S_v_u=S_v_u, covariance=covariance, scores=scores))
    here = solved(truth, edges)
    there = optimize(range(40), turned, {0: truth[0] @ gauges[0]}, metric=False)
    for k in range(40):
        assert apart(here.S_graph_chunk[k] @ gauges[k], there.S_graph_chunk[k]) < 1e-5


def test_the_order_of_edges_does_not_matter() -> None:
    truth, edges = graph(3)
    order = np.random.default_rng(1).permutation(len(edges))
    here, there = solved(truth, edges), solved(truth, [edges[k] for k in order])
    assert max(apart(here.S_graph_chunk[k], there.S_graph_chunk[k]) for k in range(40)) < 1e-8
    assert [there.edges[n].accepted for n in np.argsort(order)] == [e.accepted for e in here.edges]


def test_streaming_and_a_last_full_solution_are_batch() -> None:
    truth, edges = graph(4)
    batch = solved(truth, edges)
    result = optimize([0], [], {0: truth[0]}, metric=False)
    for k in range(1, 40):
        known = [*result.edges, *(e for e in edges if max(e.u, e.v) == k)]
        result = extend(k, range(k + 1), known, result, metric=False)
        assert set(result.components.values()) == {0}
    streamed = max(float(np.linalg.norm(result.S_graph_chunk[k].translation - truth[k].translation)) for k in range(40))
    assert streamed < 0.25
    order = {(e.u, e.v, n): n for n, e in enumerate(batch.edges)}
    last = solved(truth, list(result.edges))
    assert len(last.edges) == len(order)
    assert max(apart(last.S_graph_chunk[k], batch.S_graph_chunk[k]) for k in range(40)) < 1e-7


def test_a_leaf_is_chained_and_nothing_else_moves() -> None:
    truth, edges = graph(5)
    inner = [e for e in edges if 39 not in (e.u, e.v)]
    placed = optimize(range(39), inner, {0: truth[0]}, metric=False)
    leaf = next(e for e in edges if (e.u, e.v) == (38, 39))
    result = extend(39, range(40), [*placed.edges, leaf], placed, metric=False)
    full = optimize(range(40), [*placed.edges, leaf], {0: truth[0]}, metric=False)
    assert all(result.S_graph_chunk[k] is placed.S_graph_chunk[k] for k in range(39))
    assert apart(result.S_graph_chunk[39], full.S_graph_chunk[39]) < 1e-6
    assert result.edges[: len(inner)] == placed.edges


def test_a_loop_that_moves_the_map_moves_all_of_it() -> None:
    truth, edges = graph(6, loops=0)
    chain = [e for e in edges if 39 not in (e.u, e.v)]
    placed = optimize(range(39), chain, {0: truth[0]}, metric=False)
    loop = measured(truth, 0, 39, "loop", np.random.default_rng(2), deviation=1e-3)
    result = extend(39, range(40), [*placed.edges, edges[38], loop], placed, metric=False)
    full = optimize(range(40), [*chain, edges[38], loop], {0: truth[0]}, metric=False)
    before = np.linalg.norm(placed.S_graph_chunk[20].translation - full.S_graph_chunk[20].translation)
    after = np.linalg.norm(result.S_graph_chunk[20].translation - full.S_graph_chunk[20].translation)
    assert after < 0.3 * before


# ------------------------------------------------------------------------------------------------- covariances


@pytest.mark.parametrize(("loops", "stated"), [(30, 1.0), (30, 0.7), (0, 1.0)])
def test_true_positions_lie_inside_the_stated_region(loops: int, stated: float) -> None:
    exact = GraphSettings(weights=WeightSettings(bending=1e-6, own_bending=0.0))
    inside = []
    for seed in range(10):
        truth, edges = graph(seed + 20, loops=loops, stated=stated)
        inside.append(normalised(solved(truth, edges, exact), truth) < chi2.ppf(0.95, 3))
    assert 0.9 <= np.concatenate(inside).mean() <= 1.0


def test_marginals_are_the_blocks_of_the_inverse() -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.array([0, 1, 2, 3, 0, 1, 4, 4, 1]), np.array([1, 2, 3, 4, 4, 3, 0, 2, 2])
    dense = np.eye(15)
    off = rng.normal(size=(9, 3, 3)) * 0.1
    for i, j, block in zip(rows, columns, off, strict=True):
        dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += block
        dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] += block.T
    diagonal = np.stack([dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(5)])
    factor = BlockFactor.of(BlockPattern.analyse(5, rows, columns, 3), diagonal, off)
    inverse = np.linalg.inv(dense)
    right = rng.normal(size=(5, 3))
    assert np.allclose(factor.solve(right).ravel(), inverse @ right.ravel())
    on, beside = factor.inverse_blocks()
    for k in range(5):
        assert np.allclose(on[k], inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3])
    for i, j, block in zip(rows, columns, beside, strict=True):
        assert np.allclose(block, inverse[3 * i : 3 * i + 3, 3 * j : 3 * j + 3])
    with pytest.raises(NotPositiveError):
        BlockFactor.of(factor.pattern, -diagonal, off)


def test_jacobians_are_those_of_the_logarithm() -> None:
    rng = np.random.default_rng(3)
    poses = stack([Sim3.exp(rng.normal(0, 0.4, 7)) for _ in range(2)])
    measure = stack([Sim3.exp(rng.normal(0, 0.4, 7))])
    problem = GraphProblem.build(np.array([0]), np.array([1]), measure, np.eye(7)[None], np.array([False, False]))
    e = problem.residuals(poses)
    for chunk, jacobian in enumerate(problem.jacobians(e)):
        for axis in range(7):
            step = np.zeros((2, 7))
            step[chunk, axis] = 1e-6
            ahead, back = (problem.residuals(poses @ Sim3.exp(s * step)) for s in (1, -1))
            assert np.allclose((ahead - back)[0] / 2e-6, jacobian[0, :, axis], atol=1e-5)


def test_a_covariance_tells_where_its_points_were() -> None:
    center, radius = np.array([3.0, -1.0, 2.0]), 1.3
    about = np.eye(7)
    about[:3, 3:6], about[:3, 6] = skew(center), -center
    covariance = about @ np.diag([radius**2] * 3 + [1.0] * 4) @ about.T * 1e-4
    found, size = support_of(np.stack([covariance, np.zeros((7, 7))]))
    assert np.allclose(found[0], center, atol=1e-6)
    assert size[0] == pytest.approx(radius)
    assert size[1] == 1.0


# ------------------------------------------------------------------------------------------------ false edges


def test_false_loops_that_agree_with_each_other_are_switched_off() -> None:
    truth, edges = graph(7)
    rng = np.random.default_rng(5)
    shift = Sim3.exp([2.5, 0.5, 0, 0, 0, 0.7, 0])
    elsewhere = [*truth[:5], *(shift @ S for S in truth[5:9]), *truth[9:]]
    false = [measured(elsewhere, u, v, "loop", rng) for u, v in ((5, 30), (6, 31), (7, 30), (8, 32), (6, 30))]
    clean, result = solved(truth, edges), solved(truth, edges + false)
    assert [e.accepted for e in result.edges[-5:]] == [False] * 5
    assert "contradicts" in result.edges[-1].reason
    assert all(apart(clean.S_graph_chunk[k], result.S_graph_chunk[k]) < 0.02 for k in range(40))


def test_a_wrong_adjacent_edge_yields_to_many_loops() -> None:
    truth, edges = graph(8)
    wrong = replace(edges[10], S_v_u=edges[10].S_v_u @ Sim3.exp([1.0, 0.5, 0, 0.2, 0, 0.3, 0.1]))
    edges = [*edges[:10], wrong, *edges[11:]]
    result = solved(truth, edges)
    assert not result.edges[10].accepted
    assert sum(not e.accepted for e in result.edges) <= 2
    errors = [np.linalg.norm(result.S_graph_chunk[k].translation - truth[k].translation) for k in range(40)]
    assert max(errors) < 0.5
    plain = solved(truth, edges, GraphSettings(weights=WeightSettings(rule="equal"), robust=False))
    assert all(e.accepted for e in plain.edges)


# ------------------------------------------------------------------------------------------------- degenerate


def test_one_chunk_and_none_that_is_connected() -> None:
    alone = optimize([7], [], {}, metric=True)
    assert alone.components == {7: 7}
    assert np.array_equal(alone.covariances[7], np.zeros((7, 7)))
    added = extend(9, [7, 9], [], alone, metric=True)
    assert added.components == {7: 7, 9: 9}


def test_components_are_uncertain_each_from_its_own_first_chunk() -> None:
    _, edges = graph(9, count=8, loops=0)
    result = optimize(range(8), [e for e in edges if e.u != 3], {}, metric=False)
    assert [result.components[k] for k in range(8)] == [0] * 4 + [4] * 4
    assert np.array_equal(result.covariances[4], np.zeros((7, 7)))
    assert np.all(np.linalg.eigvalsh(result.covariances[7]) > 0)


def test_a_loop_joins_components_as_chunks_come() -> None:
    truth, edges = graph(10, count=8, loops=0)
    placed = optimize(range(7), [e for e in edges if e.u not in (3, 6)], {0: truth[0]}, metric=False)
    loop = measured(truth, 1, 7, "loop", np.random.default_rng(0))
    result = extend(7, range(8), [*placed.edges, edges[6], loop], placed, metric=False)
    assert set(result.components.values()) == {0}


def test_an_edge_without_confidence_holds_nothing_back() -> None:
    truth, edges = graph(11, count=12, loops=4)
    silent = replace(edges[5], confidence=0.0, covariance=None)
    result = solved(truth, [*edges[:5], silent, *edges[6:]])
    assert all(np.isfinite(S.as_matrix()).all() for S in result.S_graph_chunk.values())


def test_a_loop_that_says_nothing_is_dropped_unless_it_is_all_there_is() -> None:
    truth, edges = graph(13, count=12, loops=4)
    assert edges[-1].covariance is not None
    vague = replace(edges[-1], covariance=edges[-1].covariance * 1e8)
    result = solved(truth, [*edges[:-1], vague])
    assert not result.edges[-1].accepted
    assert "too uncertain" in result.edges[-1].reason
    needed = replace(vague, u=0, v=12)
    alone = optimize(range(13), [*edges[:-1], needed], {0: truth[0]}, metric=False)
    assert set(alone.components.values()) == {0}


def test_an_edge_that_is_not_finite_is_refused_by_name() -> None:
    truth, edges = graph(12, count=5, loops=0)
    for broken in (
        replace(edges[2], S_v_u=Sim3(np.ones(()), np.eye(3), np.array([np.nan, 0, 0]))),
        replace(edges[2], covariance=np.full((7, 7), np.inf)),
    ):
        with pytest.raises(DegenerateError, match="chunks 2 and 3"):
            solved(truth, [*edges[:2], broken, *edges[3:]])


def test_loops_lie_as_far_from_their_chain_as_its_uncertainty_says() -> None:
    """Squared Mahalanobis distances over many draws of noise have the mean of a chi-square: the freedoms."""
    rng = np.random.default_rng(3)
    truth = stack([Sim3.exp(0.4 * rng.normal(size=7)) for _ in range(6)])
    u, v = np.array([0, 1, 2, 1, 4, 3]), np.array([1, 2, 3, 4, 5, 5])
    sigma = np.array([0.03, 0.01, 0.01, 0.01, 0.01, 0.005])
    tree = Tree(np.array([0, 0, 1, 2, 1, 4]), np.array([-1, 0, 1, 2, 3, 4]), np.arange(6))
    loop = np.arange(6) == 5
    squares = []
    for _ in range(300):
        measured = [
            take(truth, v[k]).inverse() @ take(truth, u[k]) @ Sim3.exp(sigma[k] * rng.normal(size=7)) for k in range(6)
        ]
        poses = [take(truth, np.array(0))]
        for row in range(1, 6):
            poses.append(poses[tree.parent[row]] @ measured[tree.edge[row]].inverse())
        information = np.eye(7) / sigma[:, None, None] ** 2
        problem = GraphProblem.build(u, v, stack(measured), information, np.arange(6) == 0)
        squares.append(chain_squares(problem, stack(poses), tree, loop)[0])
    assert np.mean(squares) == pytest.approx(7.0, abs=0.7)

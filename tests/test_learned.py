"""The learned discoverer: its pieces, its network in two forms, its weights, and the worlds it is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from list3r.frames.base import SourceInfo
from list3r.instances.geometric.cloud import Cloud, build_cloud, pack
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.planes import find_planes
from list3r.instances.geometric.views import chunk_views, forget_views, working_unit
from list3r.instances.learned import discovery
from list3r.instances.learned import graph as graphs
from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import CloudCut, spread_labels
from list3r.instances.learned.discovery import LearnedDiscoverer, _walls_apart
from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES, PieceGraph, Surroundings, chunk_surface
from list3r.instances.learned.kernels import seen_across
from list3r.instances.learned.network import Classification, classify
from list3r.instances.learned.pieces import cut_pieces
from list3r.instances.learned.verdicts import SegmentVerdicts, classify_segments, names_of, segment_features
from list3r.instances.learned.weights import COMPUTED, FORMAT, SHIPPED, load_weights
from list3r.instances.registry import make_discoverer
from list3r.instances.settings import InstanceSettings, SegmentSettings
from list3r.memory.core.errors import OptionError
from list3r.pipeline.choice import settings_asked
from list3r.pipeline.request import BuildRequest
from list3r.reconstruction.base import DepthNoise
from tests.test_instances_library import SCENE, render, walk


def random_graph(seed: int, pieces: int = 30, borders: int = 90) -> PieceGraph:
    rng = np.random.default_rng(seed)
    codes = rng.choice(pieces * pieces, 3 * borders, replace=False)
    a, b = codes // pieces, codes % pieces
    left, right = a[a < b][:borders], b[a < b][:borders]
    nodes = rng.normal(size=(pieces, NODE_FEATURES)).astype(np.float32)
    edges = rng.normal(size=(len(left), EDGE_FEATURES)).astype(np.float32)
    moments = np.abs(rng.normal(1.0, 0.2, size=(pieces, 10))).astype(np.float32)
    return PieceGraph(nodes, left, right, edges, rng.uniform(1, 9, len(left)).astype(np.float32), moments)


def test_a_view_tells_of_two_pieces_over_the_gap_that_computed_depth_has_at_outlines() -> None:
    image = np.array([[0, 0, 0, -1, -1, 1, 1, 1]], np.int32)
    depth = np.where(image > 0, 1.0, 2.0).astype(np.float32)
    colour = np.repeat(depth[..., None], 3, axis=2)
    for most, times in ((1, 1), (2, 3)):
        sums = np.zeros((1, 5))
        seen_across(image, (depth, np.full_like(depth, 0.1), colour), (0, 3, most), np.array([1]), 2, sums)
        assert sums[0].tolist() == pytest.approx([times, 0, times, times, times * np.sqrt(2.0)])


def one_by_one(count: int, graph: PieceGraph, score: np.ndarray, threshold: float) -> np.ndarray:
    """Average linkage by its definition: join the most alike pair of clusters until none is above the threshold."""
    own = np.arange(count)
    while True:
        a, b = own[graph.left], own[graph.right]
        pairs = {(min(p), max(p)) for p in zip(a.tolist(), b.tolist(), strict=True) if p[0] != p[1]}
        best, who = threshold, None
        for low, high in sorted(pairs):
            mine = ((a == low) & (b == high)) | ((a == high) & (b == low))
            mean = float((score * graph.weight)[mine].sum() / graph.weight[mine].sum())
            if mean > best:
                best, who = mean, (low, high)
        if who is None:
            return own
        own[own == who[1]] = who[0]


@pytest.mark.parametrize("seed", range(4))
def test_agglomeration_is_average_linkage(seed: int) -> None:
    graph = random_graph(seed)
    score = np.random.default_rng(seed).normal(0.5, 2.0, len(graph.left)).astype(np.float32)
    own = agglomerate(30, graph.left, graph.right, score, graph.weight, 0.3)
    expected = one_by_one(30, graph, np.clip(score.astype(np.float64), -6, 6), 0.3)
    assert np.array_equal(own[:, None] == own, expected[:, None] == expected)


def test_a_border_seen_twice_from_its_other_side_is_itself() -> None:
    graph = random_graph(3)
    turned = replace(graph, edges=graph.reversed_edges())
    assert np.array_equal(turned.reversed_edges(), graph.edges)
    assert not np.array_equal(graph.reversed_edges(), graph.edges)


def test_the_network_says_the_same_in_numpy_and_torch() -> None:
    torch = pytest.importorskip("torch")
    model = pytest.importorskip("training.model")
    torch.manual_seed(5)
    network = model.PieceNetwork(NODE_FEATURES, EDGE_FEATURES, 7).eval()
    graph = random_graph(8)
    arrays = {f"fine.{k}": v.detach().numpy() for k, v in network.state_dict().items()}
    told = classify(arrays, "fine", graph)
    given = (graph.nodes, graph.left, graph.right, graph.edges, graph.reversed_edges())
    with torch.no_grad():
        affinity, structure, names, hidden = network(*(torch.from_numpy(a) for a in given))
    assert np.allclose(told.affinity, affinity.numpy(), atol=1e-4)
    assert np.allclose(told.structure, structure.numpy(), atol=1e-4)
    assert np.allclose(told.names, torch.log_softmax(names, 1).numpy(), atol=1e-4)
    assert np.allclose(told.hidden, hidden.numpy(), atol=1e-4)


def test_weights_come_back_and_damage_is_said(tmp_path: Path) -> None:
    arrays = {"a.weight": np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4), "a.bias": np.ones(3, np.float32)}
    file = tmp_path / "w.npz"
    FORMAT.write(file, arrays)
    back = load_weights(file)
    assert np.allclose(back["a.weight"], arrays["a.weight"], atol=1e-3) and back["a.weight"].dtype == np.float32

    with np.load(file) as data:
        kept = {name: data[name] for name in data.files}
    np.savez(tmp_path / "old.npz", **{**kept, "version": np.int64(0)})
    np.savez(tmp_path / "hit.npz", **{**kept, "a.bias": np.zeros(3, np.float32)})
    (tmp_path / "cut.npz").write_bytes(file.read_bytes()[:100])
    for name, word in (("none", "missing"), ("old", "version 0"), ("hit", "damaged"), ("cut", "cannot be read")):
        with pytest.raises(OptionError, match=word) as said:
            load_weights(tmp_path / f"{name}.npz")
        assert "\n" not in str(said.value) and "make it again" in str(said.value)


def test_shipped_weights_are_small_and_whole() -> None:
    assert SHIPPED.stat().st_size + COMPUTED.stat().st_size < 4_000_000
    for weights in (load_weights(), load_weights(sensed=False)):
        assert weights["fine.node_mean"].shape == (NODE_FEATURES,)
        assert weights["fine.edge_mean"].shape == (EDGE_FEATURES,)


def test_verdicts_on_things_are_probabilities_whatever_the_order_of_things() -> None:
    weights = load_weights()
    graph = replace(random_graph(4), nodes=random_graph(4).nodes[:, :NODE_FEATURES])
    count, names = len(graph.nodes), names_of(weights)
    rng = np.random.default_rng(1)
    log_names = np.log(rng.dirichlet(np.ones(len(names)), count)).astype(np.float32)
    hidden = rng.normal(size=(count, len(weights["coarse.node_head.weight"][0]))).astype(np.float32)
    told = Classification(rng.normal(size=len(graph.left)), rng.normal(size=count), log_names, hidden)
    own = rng.integers(5, size=count)
    said = classify_segments(weights, own, graph, told)
    assert (
        said.names.shape == (5, len(names)) and (said.names >= 0).all() and (said.names.sum(axis=1) <= 1 + 1e-5).all()
    )
    assert ((said.whole > 0) & (said.whole < 1)).all() and ((said.structure >= 0) & (said.structure <= 1)).all()
    turned = classify_segments(weights, 4 - own, graph, told)
    assert np.allclose(turned.whole[::-1], said.whole, atol=1e-5)
    assert np.allclose(turned.names[::-1], said.names, atol=1e-4)
    assert segment_features(own, graph, told)[1].shape[1] == len(weights["things.mean"])


def test_it_is_asked_for_by_name() -> None:
    found = make_discoverer("learned", "geometric", (), "cpu", InstanceSettings())
    assert isinstance(found, LearnedDiscoverer)


@pytest.mark.parametrize("which", ["SHIPPED", "COMPUTED"])
def test_it_is_the_default_and_damage_to_its_weights_is_said(
    which: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    depth = SourceInfo("tum", "walk", 9, 30.0, None, True, False, "x")
    assert settings_asked(BuildRequest(), depth, "any")[0].discovery == "learned"
    assert settings_asked(BuildRequest(), replace(depth, has_depth=False), "any")[0].discovery == "learned"
    assert settings_asked(BuildRequest(discovery="eomt"), depth, "any")[0].discovery == "eomt"
    load_weights.cache_clear()
    monkeypatch.setattr(f"list3r.instances.learned.weights.{which}", tmp_path / "weights.npz")
    with pytest.raises(OptionError, match=r"weights\.npz") as said:
        settings_asked(BuildRequest(), depth, "any")
    assert "\n" not in str(said.value)
    assert settings_asked(BuildRequest(discovery="eomt"), depth, "any")[0].discovery == "eomt"
    load_weights.cache_clear()


def test_points_of_none_go_to_what_a_way_without_a_gap_leads_to() -> None:
    x = np.array([0.0, 0.03, 0.06, 0.09, 0.5, 0.53, 0.8])
    labels = np.array([7, -1, -1, -1, 3, -1, -1], np.int32)
    spread = spread_labels(np.column_stack([x, 0 * x, 0 * x]), labels, 0.05)
    assert spread.tolist() == [7, 7, 7, 7, 3, 3, -1]
    assert labels.tolist() == [7, -1, -1, -1, 3, -1, -1]


def test_it_finds_what_stands_on_a_table() -> None:
    frames, reconstruction = walk(SCENE)
    discoverer = LearnedDiscoverer(InstanceSettings())
    anchor = chunk_views(frames, reconstruction, discoverer.settings).anchors[0]
    proposals = discoverer(frames, reconstruction, anchor)
    forget_views()
    pose = frames[anchor].T_source_cam
    assert pose is not None and proposals.identity is not None and proposals.structure is not None
    blocks = render(SCENE, pose)[1]
    floor, wall, table, mug, tin = (most_of(proposals.labels[blocks == k]) for k in (0, 1, 2, 5, 6))
    assert proposals.structure[floor - 1] and proposals.structure[wall - 1]
    assert len({table, mug, tin, floor}) == 4
    assert not proposals.structure[[table - 1, mug - 1, tin - 1]].any()


def test_pieces_and_their_graph_are_the_same_however_much_is_worked_out_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames, reconstruction = walk(SCENE)
    views = chunk_views(frames, reconstruction, InstanceSettings())
    shown = [views.view(p) for p in views.anchors]
    around = Surroundings(np.array([0.0, 0.0, 1.0]), 1.0, 1.0, computed=False)
    surface = chunk_surface(build_cloud(shown, 0.02), shown, around)
    forget_views()
    once = cut_pieces(surface)
    monkeypatch.setattr(graphs, "MOST_IN_TABLE", 0)
    again = cut_pieces(surface)
    assert np.array_equal(once.labels, again.labels)
    for a, b in zip(astuple(once.graph), astuple(again.graph), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("changes", "voxel"),
    [({}, 0.016), ({"depth_noise": DepthNoise(0.0, 0.001, 0.02)}, 0.01), ({"scale_kind": "relative"}, 0.01)],
)
def test_voxels_are_larger_where_a_sensor_measured_depth(
    changes: dict[str, Any], voxel: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, reconstruction = walk(SCENE)
    seen = replace(reconstruction, **changes)
    anchor = chunk_views(frames, seen, InstanceSettings()).anchors[0]
    used: list[float] = []

    def noted(views: Sequence[View], size: float) -> Cloud:
        used.append(size)
        return build_cloud(views, size)

    monkeypatch.setattr(discovery, "build_cloud", noted)
    LearnedDiscoverer(InstanceSettings())(frames, seen, anchor)
    forget_views()
    assert used[0] == pytest.approx(voxel * working_unit(seen))
    for name in ("voxel_m", "computed_voxel_m"):
        with pytest.raises(OptionError, match="must be positive"):
            InstanceSettings(segment=SegmentSettings(**{name: 0.0}))


def most_of(labels: np.ndarray) -> int:
    """The candidate that most pixels have."""
    return int(np.bincount(labels[labels > 0]).argmax())


def test_walls_round_a_corner_are_two() -> None:
    grid = np.stack(np.meshgrid(np.arange(0, 1.5, 0.01), np.arange(0, 1.0, 0.01)), axis=-1).reshape(-1, 2)
    ones = np.zeros(len(grid)) + 0.005
    points = np.concatenate([np.column_stack([grid[:, 0], ones, grid[:, 1]]), np.column_stack([ones, grid])])
    normals = np.repeat(np.array([[0.0, 1, 0], [1, 0, 0]]), len(grid), axis=0)
    cloud = cloud_of(points.astype(np.float32), normals.astype(np.float32))
    count = len(cloud.keys)
    one = np.ones(1, np.float32)
    cut = CloudCut(np.zeros(count, np.int32), SegmentVerdicts(one, one, one[:, None]))
    parted = _walls_apart(cloud, cut, find_planes(cloud, 0.03, 1.0))
    assert len(parted.verdicts.structure) == len(parted.verdicts.whole) == 2
    first = cloud.points[:, 1] < cloud.points[:, 0]
    far = np.abs(cloud.points[:, 0] - cloud.points[:, 1]) > 0.05
    assert len(np.unique(parted.labels[first & far])) == len(np.unique(parted.labels[~first & far])) == 1


def test_both_sides_of_a_thin_wall_are_one() -> None:
    grid = np.stack(np.meshgrid(np.arange(0, 1.5, 0.01), np.arange(0, 1.0, 0.01)), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid[:, 0], np.zeros(len(grid)) + 0.005, grid[:, 1]]).astype(np.float32)
    cloud = cloud_of(points, np.tile(np.array([0, 1, 0], np.float32), (len(grid), 1)))
    one = np.ones(1, np.float32)
    cut = CloudCut(np.zeros(len(cloud.keys), np.int32), SegmentVerdicts(one, one, one[:, None]))
    (plane,) = find_planes(cloud, 0.03, 1.0)
    parted = _walls_apart(cloud, cut, [plane, replace(plane, equation=-plane.equation)])
    assert len(parted.verdicts.structure) == 1 and set(parted.labels.tolist()) == {0}


def cloud_of(points: np.ndarray, normals: np.ndarray) -> Cloud:
    """A cloud of 1 cm with a point in each voxel."""
    keys, row = np.unique(pack(np.floor(points / 0.01).astype(np.int64)), return_index=True)
    fine = np.full(len(keys), 0.001, np.float32)
    rgb = np.full((len(keys), 3), 128, np.float32)
    return Cloud(keys, points[row], normals[row], rgb, fine, fine, np.ones_like(fine), 0.01, ())

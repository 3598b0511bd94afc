"""Surfaces fused from stored depth: where they lie, whose they are, how they are kept and what is made of them."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from list3r.queries.views.dense import component_surfaces, fused_surfaces, instance_surface, must_fuse
from list3r.queries.views.depth_frames import REST
from list3r.queries.views.fused import FusionSettings, Surface, fewer, fused
from tests.session_scenes import ROOM, add_session, cameras, metric_store, place_together

pytest.importorskip("open3d")
pytest.importorskip("fast_simplification")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes on a table, filmed by 14 frames without pictures."""
    path = tmp_path_factory.mktemp("surfaces") / "room.l3r"
    with metric_store(path) as store:
        with store.transaction():
            add_session(store, ROOM, cameras((0.0, 0.0, 0.7), 0.4))
            place_together(store)
            consolidate(store)
    return path


@pytest.fixture
def store(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    monkeypatch.setenv("LIST3R_CACHE", str(tmp_path / "cache"))
    with Store.open(path) as store:
        yield store


def from_boxes(points: np.ndarray) -> np.ndarray:
    """Distance of points to the nearest side of a box of the room. Shape (N,)."""
    best = np.full(len(points), np.inf)
    for box in ROOM.values():
        outside = np.abs(points - box.center) - np.array(box.size) / 2
        signed = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
        best = np.minimum(best, np.abs(signed))
    return best


def borders(surface: Surface) -> int:
    edges = np.sort(np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]]), 1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


def area(surface: Surface) -> float:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_surfaces_lie_where_things_are_and_look_at_the_cameras(store: Store) -> None:
    whole, _ = fused(store, component(store))
    points, _, _ = whole.sampled(20_000)
    away = from_boxes(points)
    assert np.mean(away < 0.01) > 0.9 and away.mean() < 0.002
    a, b, c = (whole.vertices[whole.faces[:, k]] for k in range(3))
    toward = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.array([1.0, 1.0, 3.0]) - a)
    assert np.mean(toward > 0) > 0.9


def test_a_thing_has_its_faces_and_its_colour_without_pictures(store: Store) -> None:
    (red,) = [i for i in store.instances.all() if "red" in i.description]
    surface = instance_surface(store, red.id)
    assert surface is not None and len(surface.faces) > 20
    box = ROOM["red"]
    outside = np.abs(surface.vertices - box.center) - np.array(box.size) / 2
    assert outside.max() < 0.05 and np.quantile(outside.max(axis=1), 0.8) < 0.02
    np.testing.assert_allclose(np.median(surface.rgb, axis=0), box.rgb, atol=40)
    parts = fused_surfaces(store, red.component)
    assert sum(area(p) for p in parts.values()) == pytest.approx(area(fused(store, red.component)[0]))
    assert area(parts[REST]) > area(surface)


def component(store: Store) -> int:
    return store.chunks.all()[0].component


def test_a_scene_that_is_fused_part_by_part_has_no_seams(store: Store) -> None:
    one, _ = fused(store, component(store), FusionSettings(kept_share=1.0))
    some, owner = fused(store, component(store), FusionSettings(kept_share=1.0, most_blocks=300))
    assert area(some) == pytest.approx(area(one), rel=1e-3)
    assert borders(some) == pytest.approx(borders(one), rel=0.02) and len(owner) == len(some.faces)
    few, _ = fused(store, component(store))
    assert len(few.faces) == pytest.approx(len(one.faces) / 4, rel=0.05) and area(few) == pytest.approx(
        area(one), rel=0.05
    )


def test_what_is_kept_is_read_again_and_made_anew_where_it_is_damaged(store: Store, path: Path, tmp_path: Path) -> None:
    assert must_fuse(store)
    made = fused_surfaces(store, component(store))
    assert not must_fuse(store)
    (kept,) = (tmp_path / "cache/surfaces").iterdir()
    assert list(path.parent.glob("*.npz")) == []
    written = kept.stat().st_ino
    for damage in (None, b"no archive", kept.read_bytes()[:-200]):
        if damage is not None:
            kept.write_bytes(damage)
        with Store.open(path) as other:
            again = fused_surfaces(other, component(other))
        assert again.keys() == made.keys()
        assert all(np.array_equal(again[n].faces, made[n].faces) for n in made)
        assert (kept.stat().st_ino == written) == (damage is None)
        written = kept.stat().st_ino


def test_an_edit_makes_other_surfaces(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIST3R_CACHE", str(tmp_path / "cache"))
    copy = tmp_path / "copy.l3r"
    copy.write_bytes(path.read_bytes())
    with list3r.open(copy, writable=True) as memory:
        (blue,) = [i for i in memory.instances() if "blue" in i.description]
        before = memory.surfaces()
        memory.delete(blue.id)
        after = memory.surfaces()
        assert blue.id in before and blue.id not in after
        here = np.abs(after[REST].vertices - ROOM["blue"].center).max(axis=1) < 0.05
        assert not here.any(), "what was deleted belongs to nobody"


def test_without_the_packages_there_are_points(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    found = component_surfaces(store, component(store))
    assert found and all(not len(s.faces) and len(s.vertices) for s in found.values())
    assert fused_surfaces(store, component(store)) == {}


def test_fewer_triangles_keep_the_edge(store: Store) -> None:
    table = max((s for n, s in fused_surfaces(store, component(store)).items() if n != REST), key=area)
    half = fewer(table, 0.5)
    assert len(half.faces) < 0.7 * len(table.faces) and borders(half) == borders(table)
    assert area(half) == pytest.approx(area(table), rel=0.1)


def test_glb_and_usd_hold_what_was_seen(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIST3R_CACHE", str(tmp_path / "cache"))
    with list3r.open(path) as memory:
        (glb,) = memory.export("glb", tmp_path / "room.glb")
        known = memory.surfaces()
        memory.export("usd", tmp_path / "room.usdc", mesh=True)
    data = glb.read_bytes()
    tree = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    faces = {}
    for node in tree["nodes"]:
        if node["name"].endswith("_mesh"):
            (part,) = tree["meshes"][node["mesh"]]["primitives"]
            faces[node["name"]] = tree["accessors"][part["indices"]]["count"] // 3
            assert "KHR_materials_unlit" in tree["materials"][part["material"]]["extensions"]
    names = {n: f"instance_{n}_mesh" if n else "rest_mesh" for n in known}
    assert faces == {names[n]: len(s.faces) for n, s in known.items() if len(s.faces)}
    pxr = pytest.importorskip("pxr.Usd")
    stage = pxr.Stage.Open(str(tmp_path / "room.usdc"))
    kinds = [p.GetAttribute("list3r:surface").Get() for p in stage.Traverse() if p.GetName() == "mesh"]
    assert kinds and set(kinds) == {"seen"}

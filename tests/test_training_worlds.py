"""The worlds that discovery learns from: whole meshes, things at rest, left-out families, truth of every pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("open3d")

from list3r.memory.core.errors import SourceError
from training.worlds.catalogue import BUILT_IN, FAMILIES, HELD_OUT, KINDS, ODD, kinds_at
from training.worlds.draft import Draft, Zone
from training.worlds.film import FilmSettings, make_film
from training.worlds.furnish import make_world
from training.worlds.materials import Palette
from training.worlds.settle import drop, new_bed, profile
from training.worlds.tabletop import book, mug


@pytest.mark.parametrize("name", sorted(KINDS))
def test_every_kind_is_a_whole_mesh_of_a_likely_size(name: str) -> None:
    rng = np.random.default_rng(len(name))
    draft = Draft(rng, Palette(rng, held_out=True))
    KINDS[name].build(draft)
    mesh = draft.mesh()
    low, high = draft.bounds()
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.triangles.min() and mesh.triangles.max() < len(mesh.vertices)
    assert 0.005 < np.max(high - low) < 3.5


@pytest.mark.parametrize("place", sorted(ODD))
def test_oddments_are_whole_and_of_their_place(place: str) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        draft = Draft(rng, Palette(rng, held_out=False))
        ODD[place].build(draft)
        mesh, (low, high) = draft.mesh(), draft.bounds()
        assert np.isfinite(mesh.vertices).all() and mesh.triangles.max() < len(mesh.vertices)
        assert 0.01 < np.max(high - low) <= 2.01
        if place in ("hang", "panel"):
            assert low[1] == pytest.approx(0.0, abs=1e-9)
        assert (high if place == "ceiling" else low)[2] == pytest.approx(0.0, abs=1e-9)


def test_only_odd_rooms_contain_oddments() -> None:
    assert "oddment" not in {t.kind for t in make_world(6).things}
    odd = make_world(6, odd=0.5)
    assert {t.label for t in odd.things if t.kind == "oddment"} == {""}


def test_a_gazebo_world_of_others_is_filmed_with_its_truth(tmp_path: Path) -> None:
    from training.worlds.gazebo import film_house

    (tmp_path / "worlds").mkdir()
    (tmp_path / "models" / "crate" / "meshes").mkdir(parents=True)
    (tmp_path / "models" / "crate" / "meshes" / "crate.dae").write_text(CRATE)
    (tmp_path / "models" / "crate" / "model.sdf").write_text(
        "<sdf version='1.6'>" + model("crate", mesh("crate/meshes/crate.dae", "1 1 1")) + "</sdf>"
    )
    slabs = [("Floor", "6 6 0.1", "0 0 -0.05"), ("Table", "0.8 0.6 0.7", "1.5 0 0.35")]
    slabs += [("Wall", "6 0.1 3", f"0 {y} 1.5") for y in (-3, 3)] + [("Wall", "0.1 6 3", f"{x} 0 1.5") for x in (-3, 3)]
    boxes = "".join(model(name, f"<box><size>{size}</size></box>", f"{at} 0 0 0") for name, size, at in slabs)
    crate = "<model name='crate_1'><include><uri>model://crate</uri></include><pose>1.5 0 0.7 0 0 0</pose></model>"
    file = tmp_path / "worlds" / "room.world"
    file.write_text(f"<sdf version='1.6'><world name='w'>{boxes}{crate}</world></sdf>")
    film = film_house(file, 3, "structured", frames=4)
    kinds = {t.id: t.kind for t in film.things}
    assert {t.kind for t in film.things if t.structure} == {"Floor", "Wall"}
    seen = {kinds[k] for k in np.unique(film.ids).tolist() if k}
    assert {"Floor", "Wall"} < seen and seen & {"Table", "crate"}
    where = next(k for k, kind in kinds.items() if kind == "crate")
    k, v, u = np.argwhere(film.ids == where)[0]
    ray = np.array([(u - film.camera.cx) / film.camera.fx, (v - film.camera.cy) / film.camera.fy, 1.0])
    point = film.T_world_cam[k, :3, :3] @ (ray * film.true_depth[k, v, u]) + film.T_world_cam[k, :3, 3]
    assert (np.abs(point - [1.5, 0.0, 0.85]) < [0.17, 0.12, 0.17]).all()


def test_models_within_models_and_the_ground_are_read(tmp_path: Path) -> None:
    from training.worlds.gazebo import film_house, house_extents

    (tmp_path / "worlds").mkdir()
    file = tmp_path / "worlds" / "office.world"
    table = model("Table", "<box><size>0.8 0.6 0.7</size></box>", "1 0 0.35 0 0 0")
    wall = model("Wall", "<box><size>0.1 6 3</size></box>", "2 0 1.5 0 0 0")
    office = f"<model name='office'><pose>0.5 0 0 0 0 1.5707963</pose>{table}{wall}</model>"
    ground = model("ground_plane", "<plane><normal>0 0 1</normal></plane>")
    file.write_text(f"<sdf version='1.6'><world name='w'>{ground}{office}</world></sdf>")
    (extent,) = house_extents(file).values()
    assert np.allclose(extent, [[0.2, 0.6, 0.0], [0.8, 1.4, 0.7]], atol=1e-6)
    film = film_house(file, 1, "structured", frames=3)
    kinds = {t.id: (t.kind, t.structure) for t in film.things}
    assert {kinds[k] for k in np.unique(film.ids).tolist() if k} >= {("ground_plane", True), ("Table", False)}


def test_a_place_without_a_walk_says_so(tmp_path: Path) -> None:
    from training.worlds.gazebo import film_house

    file = tmp_path / "empty.world"
    ground = model("ground_plane", "<plane><normal>0 0 1</normal></plane>")
    file.write_text(f"<sdf version='1.6'><world name='w'>{ground}</world></sdf>")
    with pytest.raises(SourceError, match=r"no walk with seed 2 through empty\.world"):
        film_house(file, 2, "structured")


def model(name: str, shape: str, pose: str = "0 0 0 0 0 0") -> str:
    """A model of SDF with one link that shows one shape."""
    look = "<material><diffuse>0.8 0.3 0.2 1</diffuse></material>"
    link = f"<link name='link'><visual name='v'><geometry>{shape}</geometry>{look}</visual></link>"
    return f"<model name='{name}'><pose>{pose}</pose>{link}</model>"


def mesh(uri: str, scale: str) -> str:
    return f"<mesh><uri>model://{uri}</uri><scale>{scale}</scale></mesh>"


CRATE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.01"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="24">-15 -10 0 15 -10 0 15 10 0 -15 10 0 -15 -10 30
15 -10 30 15 10 30 -15 10 30</float_array><technique_common><accessor source="#pa" count="8" stride="3"/>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="6"><input semantic="VERTEX" source="#v" offset="0"/><vcount>4 4 4 4 4 4</vcount>
<p>0 1 2 3 4 5 6 7 0 1 5 4 1 2 6 5 2 3 7 6 3 0 4 7</p></polylist>
</mesh></geometry></library_geometries>
<library_nodes><node id="part"><instance_geometry url="#g"/></node></library_nodes>
<library_visual_scenes><visual_scene id="s"><node><matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix>
<instance_node url="#part"/></node></visual_scene></library_visual_scenes></COLLADA>"""


def test_left_out_families_are_never_trained_on() -> None:
    assert set(HELD_OUT) <= set(FAMILIES) and len(FAMILIES) >= 40
    places = {k.place for k in KINDS.values()}
    shown = {k.family for place in places for k in kinds_at(place, held_out=False)}
    assert not shown & set(HELD_OUT)
    families = {t.family for seed in (3, 4) for t in make_world(seed).things}
    assert not families & set(HELD_OUT)


def test_what_is_dropped_rests_on_what_is_below() -> None:
    rng = np.random.default_rng(2)
    palette = Palette(rng, held_out=False)
    bed = new_bed(Zone((-0.5, -0.5), (0.5, 0.5), 0.7, 0.5))
    below, above, beside = Draft(rng, palette), Draft(rng, palette), Draft(rng, palette)
    book(below)
    book(above)
    mug(beside)
    first = drop(bed, profile(below, np.eye(3)), np.eye(3), (0.0, 0.0), stacks=True)
    assert first is not None and first[2, 3] == pytest.approx(0.701, abs=0.002)
    thick = below.bounds()[1][2]
    second = drop(bed, profile(above, np.eye(3)), np.eye(3), (0.0, 0.0), stacks=True)
    assert second is not None and second[2, 3] == pytest.approx(first[2, 3] + thick, abs=0.003)
    assert drop(bed, profile(beside, np.eye(3)), np.eye(3), (0.02, 0.02), stacks=False) is None
    assert drop(bed, profile(beside, np.eye(3)), np.eye(3), (0.6, 0.0), stacks=False) is None


def test_a_film_is_a_function_of_its_seed_and_its_truth_fits() -> None:
    settings = FilmSettings(seed=7, frames=3, sensor="structured")
    film, again = make_film(settings), make_film(settings)
    assert np.array_equal(film.color, again.color) and np.array_equal(film.depth, again.depth)
    assert np.array_equal(film.ids, again.ids)
    known = {t.id for t in film.things}
    assert set(np.unique(film.ids).tolist()) - {0} <= known
    assert (film.depth > 0).mean() > 0.3 and any(t.structure for t in film.things if t.id in film.ids)


def test_what_is_built_in_stands_in_the_room_and_structure_is_none_of_it() -> None:
    worlds = [make_world(seed, fitted=True) for seed in (2, 5)]
    built_in = {k.name for k in KINDS.values() if k.place in BUILT_IN}
    assert all({t.kind for t in world.things} & built_in for world in worlds)
    for world in worlds:
        assert sum(t.structure for t in world.things) > 6
        for thing in world.things:
            points = thing.vertices()
            assert thing.structure == (thing.family == "structure")
            if not thing.structure:
                assert points[:, :2].min() > -0.05 and (points[:, :2] < np.array(world.size[:2]) + 0.05).all()
    assert make_world(2).things[6:] != worlds[0].things[6:]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [12, 13])
def test_what_closes_an_opening_lies_behind_the_face_of_its_wall_and_leaves_no_hole(seed: int) -> None:
    world = make_world(seed, recessed=True)
    behind = []
    for thing in world.things:
        floor = thing.vertices()[:, :2]
        beyond = max(float(-floor.min()), float((floor - world.size[:2]).max()))
        behind += [thing.label] if beyond > 0.1 else []
        assert beyond < 0.6
    assert "window" in behind  # those that are hung before a wall reach 0.06 m behind its face at most
    assert [t.id for t in world.things] == [*range(1, len(world.things) + 1)]
    film = make_film(FilmSettings(seed, recessed=True, frames=4))
    assert (film.ids > 0).mean() > 0.999


def test_a_labelled_scan_of_others_is_filmed_with_its_truth(tmp_path: Path) -> None:
    from training.worlds.gazebo import film_house

    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.4, 0.4, 81)]), -1).reshape(-1, 2)
    top = np.column_stack([grid[:, 0] + 1.5, grid[:, 1], np.full(len(grid), 0.7), np.full(len(grid), 5)])
    wall = np.stack(np.meshgrid(np.linspace(-3, 3, 301), np.linspace(0, 2.5, 126)), -1).reshape(-1, 2)
    walls = [np.column_stack([w, wall[:, 1], 0 * wall[:, 1]]) for x in (-3.0, 3.0) for w in _sides(wall[:, 0], x)]
    rows = np.concatenate([top, *walls])
    head = f"# .PCD v0.7\nFIELDS x y z label\nPOINTS {len(rows)}\nDATA ascii\n"
    file = tmp_path / "room.pcd"
    file.write_text(head + "\n".join(" ".join(f"{v:.4f}" for v in r[:3]) + f" {int(r[3])}" for r in rows))
    film = film_house(file, 1, "structured", frames=4)
    kinds = {t.id: t.kind for t in film.things}
    assert {kinds[k] for k in np.unique(film.ids).tolist() if k} >= {"floor", "unlabelled"}
    assert {t.kind for t in film.things if not t.structure} == {"thing 5"}
    other = tmp_path / "other.pcd"
    other.write_text("FIELDS x y z rgb\nDATA ascii\n0 0 0 0\n")
    with pytest.raises(SourceError, match="no point cloud with labels"):
        film_house(other, 1, "structured", frames=4)


def _sides(along: np.ndarray, across: float) -> list[np.ndarray]:
    fixed = np.full(len(along), across)
    return [np.column_stack([along, fixed]), np.column_stack([fixed, along])]


@pytest.mark.slow
def test_swept_depth_lies_on_what_was_filmed_and_is_no_copy_of_it() -> None:
    pytest.importorskip("torch")
    from training.samples import sample_of
    from training.swept import swept

    film = make_film(FilmSettings(7003, frames=12, every=1, sensor="computed"))
    found = swept(film, 7003)
    assert found is not None
    assert found.depth_noise is not None
    known = (found.depth > 0) & (film.true_depth > 0)
    off = np.abs(found.depth - film.true_depth)[known] / film.true_depth[known]
    assert known.mean() > 0.2
    assert 1e-4 < float(np.median(off)) < 0.02
    sample = sample_of(film, 7003, 1, found)
    assert sample.computed
    assert any((view.depth > 0).any() for view in sample.views)

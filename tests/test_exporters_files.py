"""PLY, GLB, TUM and CSV, read back by other hands than ours."""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import list3r
from list3r.exporters.csv_tables import write_csv
from list3r.exporters.glb import T_GLTF_WORLD, GlbSettings, write_glb
from list3r.exporters.palette import instance_color
from list3r.exporters.ply import PlySettings, write_ply
from list3r.exporters.tables import records_of
from list3r.exporters.tum import write_tum
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.store.store import Store
from tests.browser import PROGRAM, Browser
from tests.test_exporters import write_split_memory


@pytest.fixture
def room(make_memory: Callable[..., Path]) -> Store:
    """The small room, open."""
    return Store.open(make_memory())


def test_ply_points_know_their_instance(room: Store, tmp_path: Path) -> None:
    write_ply(room, tmp_path / "out.ply")
    cloud = trimesh.load(tmp_path / "out.ply")
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert len(cloud.vertices) == 6 * 400
    for id in range(1, 7):
        own = raw["instance"].ravel() == id
        assert np.allclose(np.asarray(cloud.vertices)[own], room.surfaces.of(id).points, atol=1e-6)
    mug = np.flatnonzero(raw["instance"].ravel() == 3)[0]
    assert tuple(cloud.colors[mug][:3]) == instance_color(3)


def test_ply_settings(room: Store, tmp_path: Path) -> None:
    write_ply(room, tmp_path / "out.ply", PlySettings(color="rgb", structure=False, points_per_instance=50))
    cloud = trimesh.load(tmp_path / "out.ply")
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert dict(zip(*np.unique(raw["instance"], return_counts=True), strict=True)) == {2: 50, 3: 50, 4: 50, 5: 50}
    assert tuple(cloud.colors[raw["instance"].ravel() == 5][0][:3]) == (90, 60, 30)
    with pytest.raises(OptionError, match="instance, rgb"):
        PlySettings(color="height")


def test_ply_says_its_unit_and_component(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        main, other = write_ply(store, tmp_path / "out.ply")
    assert b"lengths in unit, scale relative, gravity unknown, component 2" in main.read_bytes()
    assert b"not placed against the main one" in other.read_bytes()


def test_tum_is_the_trajectory_of_the_store(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    room = Store.open(make_memory(), writable=True)
    with room.transaction():  # turned, so that no two numbers of a quaternion are alike
        room.chunks.place({1: Sim3.exp([0.3, -0.2, 0.1, 0.4, -0.3, 0.8, 0.0])}, {1: 1})
    write_tum(room, tmp_path / "out.txt")
    rows = np.loadtxt(tmp_path / "out.txt")
    poses = room.trajectory.poses()
    assert rows.shape == (20, 8)
    assert np.allclose(rows[:, 0], [f.time_s for f, _ in poses], atol=1e-6)
    assert np.allclose(rows[:, 1:4], [S.translation for _, S in poses])
    assert np.allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), [S.rotation for _, S in poses], atol=1e-8)


def test_tum_gives_rigid_poses_of_posed_frames_by_component(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        written = write_tum(store, tmp_path / "out.txt")
        poses = store.trajectory.poses()
    rows = [np.loadtxt(p) for p in written]
    assert [len(r) for r in rows] == [19, 7]
    assert np.all(np.diff(rows[0][:, 0]) > 0)
    assert np.allclose(np.linalg.norm(rows[0][:, 4:], axis=1), 1.0, atol=1e-8)
    assert np.allclose(rows[0][:, 1:4], [S.translation for f, S in poses if f.chunk_id == 2], atol=1e-8)


def test_tum_is_read_by_evo(room: Store, tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    write_tum(room, tmp_path / "out.txt")
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "out.txt"))
    assert trajectory.num_poses == 20
    assert np.allclose(trajectory.poses_se3[3][:3, :3], room.trajectory.poses()[3][1].rotation, atol=1e-8)


def read_gltf(path: Path) -> dict[str, object]:
    """The JSON part of a binary glTF file."""
    content = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    return dict(json.loads(content[20 : 20 + size]))


def test_glb_holds_named_points_and_boxes_y_up(room: Store, tmp_path: Path) -> None:
    write_glb(room, tmp_path / "out.glb", GlbSettings(points_per_instance=100))
    scene = trimesh.load(tmp_path / "out.glb")
    assert {f"instance_{k}_points" for k in range(1, 7)} <= set(scene.graph.nodes_geometry)
    assert "instance_3_box" in scene.graph.nodes_geometry
    assert "instance_1_box" not in scene.graph.nodes_geometry
    T_scene_node, name = scene.graph.get("instance_3_points")
    points = trimesh.transform_points(scene.geometry[name].vertices, T_scene_node)
    assert len(points) == 100
    world = points @ T_GLTF_WORLD[:3, :3]
    assert np.all(world >= room.instances.get(3).aabb[0] - 1e-4)
    assert np.all(world <= room.instances.get(3).aabb[1] + 1e-4)
    assert points[:, 1].min() > 0.7


def test_glb_boxes_are_twelve_edges_with_facts(room: Store, tmp_path: Path) -> None:
    write_glb(room, tmp_path / "out.glb")
    gltf = read_gltf(tmp_path / "out.glb")
    meshes = {m["name"]: m for m in gltf["meshes"]}  # type: ignore[attr-defined]
    accessors = gltf["accessors"]
    box = meshes["instance_5_box"]
    assert box["extras"]["id"] == 5
    assert box["extras"]["description"] == "chair"
    (primitive,) = box["primitives"]
    position = accessors[primitive["attributes"]["POSITION"]]  # type: ignore[index]
    assert (primitive["mode"], position["count"]) == (1, 24)
    assert np.allclose(position["max"], room.instances.get(5).aabb[1])


def test_glb_says_what_its_buffers_hold(room: Store, tmp_path: Path) -> None:
    write_glb(room, tmp_path / "out.glb")
    gltf = read_gltf(tmp_path / "out.glb")
    parts = [p for m in gltf["meshes"] for p in m["primitives"]]  # type: ignore[attr-defined]
    used = {gltf["accessors"][n]["bufferView"] for p in parts for n in p["attributes"].values()}  # type: ignore[index]
    assert {gltf["bufferViews"][n].get("target") for n in used} == {34962}  # type: ignore[index]


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
def test_a_viewer_of_others_shows_the_glb(room: Store, tmp_path: Path) -> None:
    """The loader of three.js, in the page of viser, in a browser: boxes and points where the memory has them."""
    viser = pytest.importorskip("viser")
    write_glb(room, tmp_path / "out.glb", GlbSettings(color="instance"))
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    browser = Browser(tmp_path / "profile")
    try:
        turned = Rotation.from_matrix(T_GLTF_WORLD[:3, :3].T).as_quat(scalar_first=True)
        server.scene.add_glb("/out", (tmp_path / "out.glb").read_bytes(), wxyz=tuple(turned))
        chair = room.instances.get(5).center
        server.initial_camera.look_at = tuple(chair)
        server.initial_camera.position = tuple(chair + np.array([0.0, -2.0, 1.0]))
        browser.open(f"http://127.0.0.1:{server.get_port()}")
        browser.says("Connected")
        ink = np.array(instance_color(5), float)
        browser.wait(lambda: (np.abs(browser.picture()[:, :900] - ink).max(axis=2) < 40).sum() > 100)
        assert browser.errors == []
    finally:
        browser.close()
        server.stop()


def expected_cell(value: object) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def test_csv_holds_the_tables_of_the_api(room: Store, tmp_path: Path) -> None:
    written = write_csv(room, tmp_path / "room.csv")
    assert [p.name for p in written] == ["room.csv", "room.relations.csv"]
    for path, table in zip(written, ("instances", "relations"), strict=True):
        with path.open(newline="", encoding="utf-8") as file:
            read = list(csv.DictReader(file))
        expected = records_of(room, table)  # type: ignore[arg-type]
        assert [list(row) for row in read] == [list(row) for row in expected]
        for row, known in zip(read, expected, strict=True):
            for name, value in known.items():
                if isinstance(value, float):
                    assert float(row[name]) == value
                else:
                    assert row[name] == expected_cell(value)


def test_csv_keeps_labels_with_commas_and_quotes(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    label = 'a "blue", round mug'
    with list3r.open(make_memory(), writable=True) as memory:
        memory.label(3, label)
    with (
        list3r.open(tmp_path / "room.l3r") as memory,
        write_csv(memory.store, tmp_path / "room.csv")[0].open(newline="") as file,
    ):
        assert next(row for row in csv.DictReader(file) if row["id"] == "3")["label"] == label


@pytest.mark.parametrize("label", ["=HYPERLINK(A1)", "+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "＝1"])
def test_csv_holds_no_formula(label: str, make_memory: Callable[..., Path], tmp_path: Path) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        store.instances.put([replace(store.instances.get(3), label=label, description=label)])
    with Store.open(path) as store, write_csv(store, tmp_path / "m.csv")[0].open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
        columns = dict(zip(rows[0], zip(*rows[1:], strict=True), strict=True))
        assert columns["label"][2] == columns["description"][2] == f"'{label}"
        assert columns["description"][1] == "table"
        lowest = columns["min_x"] + columns["min_y"]
        assert min(map(float, lowest)) < 0 and not [v for v in lowest if v.startswith("'")]
        assert records_of(store)[2]["label"] == label


def test_csv_of_an_empty_memory_names_the_columns(tmp_path: Path) -> None:
    with Store.create(tmp_path / "empty.l3r") as store:
        texts = [p.read_text() for p in write_csv(store, tmp_path / "out.csv")]
    assert texts[0].startswith("id,label,") and texts[1] == "subject,predicate,object,confidence,margin\n"

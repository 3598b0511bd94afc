"""import: maps of other programs answer questions here, with the names that they had there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import list3r
from list3r.importers.base import imported_as
from list3r.importers.hydra import symbol
from list3r.importers.importing import IMPORTED, import_map, upright
from list3r.importers.ply import read_vertices
from list3r.importers.registry import read_map
from list3r.importers.up_axis import up_axis_notes
from list3r.memory.core.errors import List3rError, MemoryFileError, OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.viewer.world import read_world
from tests.recordings import put

TABLE, CUP = ((1.0, 2.0, 0.36), (1.2, 0.8, 0.72)), ((1.1, 2.1, 0.77), (0.08, 0.08, 0.1))
"""Centre and size of two boxes, the second on the first, metres, z up."""


def conceptgraphs(root: Path) -> Path:
    def obj(number: int, tag: str, box: Any) -> dict[str, Any]:
        return {"id": number, "object_tag": tag, "object_caption": "", "bbox_center": box[0], "bbox_extent": box[1]}

    put(root / "obj_json_run.json", json.dumps({"object_1": obj(7, "table", TABLE), "object_2": obj(9, "cup", CUP)}))
    return root


def points(box: Any, up: str = "z") -> np.ndarray:
    rng = np.random.default_rng(3)
    p = rng.uniform(-0.5, 0.5, (1500, 3))
    axis = rng.integers(0, 3, len(p))
    p[np.arange(len(p)), axis] = rng.choice([-0.5, 0.5], len(p))
    return (np.array(box[0]) + p * np.array(box[1])) @ upright(up)


def ply(rows: dict[str, np.ndarray], binary: bool = True) -> bytes:
    kinds = {"x": "double", "y": "double", "z": "double", "instance": "int"}
    count = len(next(iter(rows.values())))
    lines = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", f"element vertex {count}"]
    lines += [f"property {kinds.get(k, 'uchar')} {k}" for k in rows]
    head = ("\n".join([*lines, "end_header"]) + "\n").encode()
    if not binary:
        return head + "\n".join(" ".join(f"{v:.9g}" for v in row) for row in zip(*rows.values(), strict=True)).encode()
    types = {"double": "<f8", "int": "<i4", "uchar": "u1"}
    table = np.zeros(count, [(k, types[kinds.get(k, "uchar")]) for k in rows])
    for k, v in rows.items():
        table[k] = v
    return head + table.tobytes()


def cloud(box: Any, up: str = "z", **more: np.ndarray) -> dict[str, np.ndarray]:
    p = points(box, up)
    colors = {k: np.full(len(p), v) for k, v in (("red", 200), ("green", 30), ("blue", 30))}
    return {"x": p[:, 0], "y": p[:, 1], "z": p[:, 2], **colors, **more}


def hovsg(root: Path) -> Path:
    for number, (name, box) in enumerate((("table", TABLE), ("cup", CUP))):
        said = {"object_id": f"0_0_{number}", "name": name, "embedding": [1.0, float(number)], "room_id": "0_0"}
        put(root / f"objects/0_0_{number}.json", json.dumps(said | {"vertices": []}))
        put(root / f"objects/0_0_{number}.ply", ply(cloud(box, "y")))
    return root


def hydra(root: Path, *, old: bool = False) -> Path:
    nodes: list[dict[str, Any]] = [{"id": 1, "layer": 3, "attributes": {"type": "PlaceNodeAttributes"}}]
    for number, (name, (center, size)) in enumerate((("table", TABLE), ("cup", CUP))):
        low, high = (np.array(center) + s * np.array(size) / 2 for s in (-1, 1))
        extent = {"min": low.tolist(), "max": high.tolist()} if old else {"dimensions": size}
        box = {"type": "AABB", "world_P_center": center, "world_R_center": {"w": 1, "x": 0, "y": 0, "z": 0}, **extent}
        said = {"type": "ObjectNodeAttributes", "name": name, "bounding_box": box, "semantic_label": 3}
        nodes.append({"id": (ord("O") << 56) + number, "layer": 2, "attributes": said})
    put(root / "dsg.json", json.dumps({"nodes": nodes, "edges": [], "layer_ids": [2, 3], "mesh_layer_id": 1}))
    return root / "dsg.json"


NAMES = {"conceptgraphs": ("7", "9"), "hovsg": ("0_0_0", "0_0_1"), "hydra": ("O(0)", "O(1)")}


@pytest.mark.parametrize(("kind", "up"), [("conceptgraphs", "z"), ("hovsg", "y"), ("hydra", "z")])
def test_an_imported_map_answers(kind: str, up: str, tmp_path: Path) -> None:
    source = {"conceptgraphs": conceptgraphs, "hovsg": hovsg, "hydra": hydra}[kind](tmp_path / "map")
    report = import_map(source, tmp_path / "m.l3r", up=up)
    table, cup = (report.ids[name] for name in NAMES[kind])
    with list3r.open(tmp_path / "m.l3r") as scene:
        nearest = scene.nearest(CUP[0], k=1)
        assert nearest[0].instance.id == cup
        assert {(r.subject, r.predicate, r.object) for r in scene.relations(subject=cup, predicate="on")} == {
            (cup, "on", table)
        }
        assert [m.instance.id for m in scene.find("cup on table")] == [cup]
        assert np.allclose(scene.instance(table).center, TABLE[0], atol=0.03)
        scene.export("json", tmp_path / "m.json")
        assert {i.id for i in scene} == {table, cup} <= set(read_world(scene, []).cloud.owner.tolist())
    with Store.open(tmp_path / "m.l3r") as store:
        told = store.facts[IMPORTED]
        assert told is not None and told["format"] == kind and told["names"] == list(NAMES[kind])


def test_a_cloud_with_numbers_is_a_map_of_things(tmp_path: Path) -> None:
    a, b = (cloud(box, instance=np.full(1500, n)) for n, box in ((4, TABLE), (6, CUP)))
    both = {k: np.concatenate([a[k], b[k]]) for k in a}
    for binary in (True, False):
        put(tmp_path / "cloud.ply", ply(both, binary))
        found = read_map(tmp_path / "cloud.ply")
        assert [t.name for t in found.objects] == ["4", "6"]
        assert np.allclose(np.ptp(found.objects[0].points, axis=0), TABLE[1], atol=0.01)
        rgb = found.objects[0].rgb
        assert rgb is not None and rgb[0].tolist() == [200, 30, 30]


def test_points_of_colmap_belong_to_what_their_pictures_say(tmp_path: Path) -> None:
    import cv2

    mask = np.zeros((100, 200), np.uint16)
    mask[:, 100:] = 5
    seen, rows = [], []
    for k in range(1, 25):
        x = 20 if k <= 12 else 150
        seen.append(f"{x} {4 * k} {k}")
        rows.append(f"{k} {0.01 * k} {0.02 * (k % 5)} 1.0 10 20 30 0.5 1 {k - 1} 2 {k - 1}")
    model = tmp_path / "sparse/0"
    put(model / "cameras.txt", "1 PINHOLE 200 100 100 100 100 50\n")
    put(model / "images.txt", "".join(f"{n} 1 0 0 0 {n} 0 0 1 {n}.jpg\n{' '.join(seen)}\n" for n in (1, 2)))
    put(model / "points3D.txt", "\n".join(rows) + "\n")
    for n in (1, 2):
        put(tmp_path / f"masks/{n}.png", bytes(cv2.imencode(".png", mask)[1]))
    found = read_map(tmp_path)
    assert not found.metric and [t.name for t in found.objects] == ["5"]
    assert len(found.objects[0].points) == 12 and found.objects[0].points[:, 0].min() == pytest.approx(0.13)


def test_older_boxes_and_names_of_spark_dsg_are_read(tmp_path: Path) -> None:
    old, new = read_map(hydra(tmp_path / "a", old=True)), read_map(hydra(tmp_path / "b"))
    assert np.allclose(old.objects[0].points, new.objects[0].points)
    assert any("not objects" in note for note in new.notes)
    assert (symbol((ord("p") << 56) + 12), symbol(5), symbol("x")) == ("p(12)", "5", "x")


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        ("map.pkl.gz", b"\x80\x04", "runs code"),
        ("obj_json_a.json", b'{"object_1": {"bbox_center": [0, 0, null], "bbox_extent": [1, 1, 1]}}', "three numbers"),
        ("obj_json_b.json", b"[]", "no objects"),
        (
            "cloud.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n",
            "ends",
        ),
        ("cloud.ply", b"PLY", "not a PLY"),
        ("dsg.json", b'{"nodes": [], "layer_ids": []}', "holds no objects"),
        ("other.json", b'{"a": 1}', "not a map of"),
    ],
)
def test_what_is_no_map_is_refused_and_leaves_nothing(name: str, data: bytes, why: str, tmp_path: Path) -> None:
    put(tmp_path / name, data)
    with pytest.raises(SourceError, match=why):
        import_map(tmp_path / name, tmp_path / "m.l3r")
    assert not list(tmp_path.glob("m.l3r*"))


def test_a_cloud_without_things_and_a_memory_that_exists_are_refused(tmp_path: Path) -> None:
    put(tmp_path / "plain.ply", ply(cloud(TABLE)))
    with pytest.raises(SourceError, match="eval cloud"):
        read_map(tmp_path / "plain.ply")
    assert set(read_vertices(tmp_path / "plain.ply")) == {"x", "y", "z", "red", "green", "blue"}
    put(tmp_path / "m.l3r", b"mine")
    with pytest.raises(MemoryFileError):
        import_map(conceptgraphs(tmp_path / "map"), tmp_path / "m.l3r")
    with pytest.raises(OptionError, match="--up"):
        import_map(tmp_path / "map", tmp_path / "n.l3r", up="w")
    with pytest.raises(List3rError, match="does not exist"):
        import_map(tmp_path / "none", tmp_path / "n.l3r")


@pytest.mark.parametrize("axis", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_that_points_up_becomes_z(axis: str) -> None:
    R = upright(axis)
    unit = np.zeros(3)
    unit["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    assert np.allclose(R @ unit, [0, 0, 1]) and np.linalg.det(R) == pytest.approx(1.0)


def test_a_map_whose_things_stand_along_another_axis_is_told() -> None:
    boxes = [(np.array([0.5 * k, 1.0, 0.35]), np.array([0.4, 0.8, 0.7])) for k in range(5)]
    boxes += [(np.array([0.5 * k, 1.0, 0.75]), np.array([0.1, 0.1, 0.1])) for k in range(5)]
    for axis in ("z", "y", "-x"):
        objects = [(points(box) @ upright(axis)).astype(np.float32) for box in boxes]
        assert up_axis_notes(objects, axis) == ()
        (told,) = up_axis_notes(objects, "z" if axis != "z" else "y")
        assert f"--up {axis}" in told


def test_an_instance_tells_what_its_map_calls_it(tmp_path: Path) -> None:
    report = import_map(hovsg(tmp_path / "map"), tmp_path / "m.l3r", up="y")
    with Store.open(tmp_path / "m.l3r") as store:
        origin = imported_as(store, report.ids["0_0_1"])
    assert origin is not None and (origin["format"], origin["names"]) == ("hovsg", ["0_0_1"])

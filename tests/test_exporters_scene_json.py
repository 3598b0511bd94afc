"""The scene JSON: the published schema, the fixed fields, the numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from list3r.exporters.scene_json import scene_dict, scene_schema, write_scene_json
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import OrientedBox, rotation_from_quat_wxyz
from list3r.memory.store.store import Store
from tests.conftest import SMALL_ROOM, instance
from tests.test_exporters import TILTED, write_split_memory


def strict(schema: Any) -> Any:
    """The schema with every unnamed field forbidden, so that a field that is written but not documented is found."""
    if isinstance(schema, list):
        return [strict(v) for v in schema]
    if not isinstance(schema, dict):
        return schema
    inside = {k: v if k in ("if", "then", "else", "allOf") else strict(v) for k, v in schema.items()}
    if "properties" in schema:
        inside.setdefault("additionalProperties", False)
    return inside


@pytest.fixture(params=["room", "split", "empty"])
def scene(request: pytest.FixtureRequest, make_memory: Callable[..., Path], tmp_path: Path) -> dict[str, Any]:
    """Scenes of a whole, a split and an empty memory."""
    path = tmp_path / "memory.l3r"
    if request.param == "room":
        path = make_memory()
    elif request.param == "split":
        write_split_memory(path)
    else:
        Store.create(path).close()
    with Store.open(path) as store:
        return scene_dict(store)


def test_scenes_keep_the_schema_and_it_names_every_field(scene: dict[str, Any]) -> None:
    schema = scene_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(scene)
    jsonschema.Draft202012Validator(strict(schema)).validate(scene)


def test_no_number_is_nan_and_lengths_are_rounded(scene: dict[str, Any]) -> None:
    text = json.dumps(scene, allow_nan=False)
    numbers = [float(v) for v in json.loads(text, parse_float=str, parse_int=str, object_hook=_flatten) if v]
    assert all(math.isfinite(v) for v in numbers)
    if scene["frame"]["units"] == "m":
        for entry in scene["instances"]:
            assert entry["center"] == [round(v, 4) for v in entry["center"]]


def _flatten(item: dict[str, Any]) -> list[str]:
    found: list[str] = []
    for value in item.values():
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, list):
                found += part
            elif isinstance(part, str):
                try:
                    float(part)
                except ValueError:
                    continue
                found.append(part)
    return found


def test_the_schema_is_published_in_the_docs() -> None:
    published = Path(__file__).resolve().parents[1] / "docs" / "scene.schema.json"
    assert json.loads(published.read_text(encoding="utf-8")) == scene_schema()


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.update(version=2),
        lambda s: s.pop("relations"),
        lambda s: s["frame"].update(units="unit"),
        lambda s: s["frame"].update(gravity="unknown"),
        lambda s: s["instances"][0].update(state="gone"),
        lambda s: s["instances"][0].update(confidence=1.5),
        lambda s: s["instances"][0]["box"].pop("quat_wxyz"),
        lambda s: s["instances"][0].update(center=[0, 0]),
        lambda s: s["relations"][0].pop("margin"),
    ],
)
def test_the_schema_refuses(change: Callable[[dict[str, Any]], object], make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        scene = scene_dict(store)
    change(scene)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(scene_schema()).validate(scene)


def test_the_room_comes_out_as_it_is(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with Store.open(make_memory()) as store:
        write_scene_json(store, tmp_path / "scene.json")
    scene = json.loads((tmp_path / "scene.json").read_text(encoding="utf-8"))
    assert scene["frame"] == {
        "up": [0, 0, 1],
        "units": "m",
        "metric": "metric",
        "metric_source": "sensor depth",
        "gravity": "estimated",
    }
    assert [i["description"] for i in scene["instances"]] == [row[0] for row in SMALL_ROOM]
    for entry, (_, center, size, rgb, structure) in zip(scene["instances"], SMALL_ROOM, strict=True):
        assert entry["box"] == {"center": list(center), "size": list(size), "quat_wxyz": [1, 0, 0, 0]}
        assert entry["color"]["rgb"] == list(rgb)
        assert (entry["structure"], entry["structure_kind"]) == (structure is not None, structure)
    mug = scene["instances"][2]
    assert mug["aabb"] == {"min": [1.76, 0.06, 0.72], "max": [1.84, 0.14, 0.82]}
    assert mug["best_view"] == {"session": 1, "frame": 3, "box_xyxy": [10, 20, 30, 30]}
    assert {"subject": 3, "predicate": "on", "object": 2, "confidence": 0.95, "margin": 0.02} in scene["relations"]
    assert scene["sessions"][0]["fps"] == 30
    assert scene["sessions"][0]["frames"] == {"posed": 20, "lost": 0, "bad": 0}


def test_what_is_not_known_is_null(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        scene = scene_dict(store)
    assert scene["frame"]["up"] is None
    assert scene["frame"]["units"] == "unit"
    assert [(c["id"], c["main"], c["posed_frames"]) for c in scene["components"]] == [(2, True, 19), (1, False, 7)]
    assert [i["component"] for i in scene["instances"]] == [1, 2, 2]


def test_a_box_can_be_rebuilt(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        entry = scene_dict(store)["instances"][1]
        corners = store.instances.get(2).box.corners()
    rotation = rotation_from_quat_wxyz(np.array(entry["box"]["quat_wxyz"]))
    rebuilt = OrientedBox(np.array(entry["box"]["center"]), np.array(entry["box"]["size"]), rotation)
    assert np.allclose(rebuilt.corners(), corners, atol=1e-4)
    assert np.allclose(rotation, TILTED.rotation, atol=1e-5)


def test_geometry_that_is_not_finite_is_not_written(make_memory: Callable[..., Path]) -> None:
    path = make_memory()
    for odd in (np.inf, np.nan):
        far = instance(7, (odd, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 2, 3), component=1)
        with Store.open(path, writable=True) as store, pytest.raises(MemoryFileError), store.transaction():
            store.instances.put([far])

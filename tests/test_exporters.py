"""All formats: what they share at the border, and what empty, split or scaleless memories give."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.api import SceneMemory
from list3r.exporters.palette import instance_color, linear_from_srgb, srgb_from_linear
from list3r.exporters.registry import FORMATS, find_format
from list3r.exporters.registry import export as export_memory
from list3r.memory.core.errors import ExportError, MemoryFileError, OptionError
from list3r.memory.core.geometry import OrientedBox, Sim3
from list3r.memory.core.records import Instance, Observation, Relation
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, instance, local_instance


def installed(package: str) -> bool:
    """Tell whether a package that only some installs have is here; nothing is, too."""
    return not package or importlib.util.find_spec(package) is not None


FILES = [
    pytest.param(name, marks=pytest.mark.skipif(not installed(form.package), reason=f"{form.package} is not installed"))
    for name, form in FORMATS.items()
    if not form.folder
]
"""Formats that are a file."""

TILTED = Sim3.exp([0.5, -0.2, 0.1, 0.1, 0.2, 0.7, 0.4])
"""A S_world_chunk with a scale that is not 1."""


def tilted_instance(id: int, rotation: np.ndarray, component: int, **more: object) -> Instance:
    """A thing whose box is turned."""
    made = instance(id, (1.0, 2.0, 0.5), (0.6, 0.4, 0.2), (200, 80, 40), component=component, **more)
    box = OrientedBox(made.center, made.box.size, rotation)
    corners = box.corners()
    return replace(made, box=box, aabb=np.stack([corners.min(axis=0), corners.max(axis=0)]))


def write_split_memory(path: Path) -> Path:
    """Relative, no gravity; two components, the second has more frames; a thing without points, a lost frame each."""
    with Store.create(path) as store, store.transaction():
        session = store.sessions.add("walk", "abc", {}, 40)
        for index, count in ((0, 8), (1, 20)):
            points = box_points((1.0, 2.0, 0.5), (0.6, 0.4, 0.2), 300, index)
            local = local_instance(0, points, (200, 80, 40), np.arange(20 * index, 20 * index + 5))
            result = chunk_result(index, 20 * index, count, (local,))
            posed = np.ones(count, bool)
            posed[3] = False
            chunk = store.chunks.add(session, replace(result, posed=posed, scale_kind="relative"))
            store.chunks.place({chunk: TILTED if index else Sim3.identity()}, {chunk: chunk})
        store.facts.scale_kind = "relative"
        store.facts.gravity = "unknown"
        store.instances.put(
            [
                tilted_instance(1, TILTED.rotation, 1),
                tilted_instance(2, TILTED.rotation, 2, label="écran plat"),
                tilted_instance(3, np.eye(3), 2, description="no points"),
            ]
        )
        store.observations.set([Observation(1, 1, 0), Observation(2, 2, 0)])
        store.relations.replace(None, [Relation(3, "next to!", 2, 0.5, 0.1), Relation(3, "near", 2, 0.5, 0.2)])
    return path


@pytest.fixture
def split_memory(tmp_path: Path) -> Path:
    """See `write_split_memory`."""
    return write_split_memory(tmp_path / "split.l3r")


def usual_path(folder: Path, name: str) -> Path:
    """A file name that fits a format."""
    return folder / f"out{FORMATS[name].suffixes[0]}"


def export(store: Store, name: str, path: Path) -> tuple[Path, ...]:
    """Write an open memory in a format."""
    return export_memory(SceneMemory(store), name, path)


BESIDE = {
    "csv": ("relations",),
    "parquet": ("relations", "frames"),
    "graphml": ("merges",),
    "node-link": ("merges",),
}
"""The further files that a memory of one component gives."""
WHOLE = ("json", "usd", "rerun", "report", "web", *BESIDE)
"""Formats that hold all components, each in a frame or table of its own."""


def beside(name: str, path: Path) -> list[Path]:
    """Their paths."""
    return [path.with_name(f"{path.stem}.{part}{path.suffix}") for part in BESIDE.get(name, ())]


@pytest.mark.parametrize("name", FILES)
def test_every_format_writes_what_it_says(name: str, make_memory: Callable[..., Path], tmp_path: Path) -> None:
    path = usual_path(tmp_path, name)
    before = {p.name for p in tmp_path.iterdir()}
    with Store.open(make_memory()) as store:
        written = export(store, name, path)
    assert written == (path, *beside(name, path))
    assert all(p.stat().st_size > 0 for p in written)
    assert {p.name for p in tmp_path.iterdir()} == before | {"room.l3r", *(p.name for p in written)}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_same_memory_same_bytes(name: str, make_memory: Callable[..., Path], tmp_path: Path) -> None:
    if name == "rerun":
        pytest.skip("recordings number their parts at random")
    with Store.open(make_memory()) as store:
        contents = []
        for folder in ("a", "b"):
            (tmp_path / folder).mkdir()
            written = export(store, name, usual_path(tmp_path / folder, name))
            contents.append([p.read_bytes() for p in written])
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", FILES)
def test_components_are_never_laid_over_each_other(name: str, split_memory: Path, tmp_path: Path) -> None:
    path = usual_path(tmp_path, name)
    with Store.open(split_memory) as store:
        written = export(store, name, path)
    assert written[0] == path
    assert all(p.is_file() for p in written)
    if name in WHOLE:
        assert len(written) == 1 + len(BESIDE.get(name, ()))
    else:
        assert len(written) == 2 and "component_1" in written[1].name


def test_unknown_format_names_those_there_are() -> None:
    with pytest.raises(OptionError, match=", ".join(FORMATS)):
        find_format("obj")


def test_a_suffix_that_lies_is_refused(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with (
        Store.open(make_memory()) as store,
        pytest.raises(OptionError, match=r"\.usdc or \.usd or \.usda or \.usdz file"),
    ):
        export(store, "usd", tmp_path / "scene.glb")


def test_what_must_not_be_replaced_is_kept(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    memory = make_memory()
    content = memory.read_bytes()
    with Store.open(memory) as store:
        with pytest.raises(ExportError, match="is a memory file"):
            export(store, "json", memory)
        with pytest.raises(ExportError, match="is a folder"):
            export(store, "json", tmp_path)
        with pytest.raises(ExportError, match="not a regular file"):
            export(store, "json", os.devnull)
    assert memory.read_bytes() == content


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission_is_one_line(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    with Store.open(make_memory()) as store, pytest.raises(ExportError, match="not writable"):
        export(store, "json", tmp_path / "locked" / "out.json")


def test_a_failure_inside_leaves_nothing(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    path = tmp_path / "out.ply"
    with Store.open(make_memory()) as store:
        store.close()
        with pytest.raises(MemoryFileError):
            export(store, "ply", path)
    assert [p.name for p in tmp_path.iterdir()] == ["room.l3r"]


def test_colours_of_ids_are_stable_and_distinct() -> None:
    colors = np.array([instance_color(k) for k in range(1, 25)], float)
    distance = np.linalg.norm(colors[:, None] - colors[None], axis=2) + 1e3 * np.eye(24)
    assert instance_color(12) == instance_color(12)
    assert distance.min() > 12
    assert colors.min() >= 0
    assert colors.max() <= 255


def test_srgb_round_trip() -> None:
    values = np.arange(256)
    assert np.allclose(255 * srgb_from_linear(linear_from_srgb(values)), values, atol=1e-9)
    assert linear_from_srgb(188) == pytest.approx(0.5029, abs=1e-4)

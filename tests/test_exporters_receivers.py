"""Graphs, tables, camera models, recordings and the page, read back by the programs that they are for."""

from __future__ import annotations

import base64
import html.parser
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import networkx
import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.exporters.cameras.pictures import jpeg_size
from list3r.exporters.tables import records_of
from list3r.exporters.web.page import WebSettings, write_web
from list3r.frames.source import open_source
from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import ExportError, OptionError
from list3r.memory.store.store import Store
from tests.browser import PROGRAM, Browser
from tests.conftest import small_picture, write_small_room
from tests.test_exporters import write_split_memory

NASTY = "</script><b onclick=alert(1)>Übel &amp; \x07\u202eliubÜ"
MUG, TABLE = 3, 2


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small room with a picture, and a mug of a name that would like to be markup."""
    path = tmp_path_factory.mktemp("receivers") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store, small_picture(), depth=0.0)
        store.instances.set_labels({MUG: NASTY})
    return path


def test_graphml_says_what_the_store_says(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        first, merges = memory.export("graphml", tmp_path / "g.graphml")
        wanted = {(r.subject, r.predicate, r.object) for r in memory.relations()}
        graph = networkx.read_graphml(first, node_type=int, force_multigraph=True)
        assert sorted(graph) == [i.id for i in memory.instances(structure=None)]
        assert {(a, d["predicate"], b) for a, b, d in graph.edges(data=True)} == wanted
        assert graph.nodes[MUG]["center_x"] == pytest.approx(float(memory.instance(MUG).center[0]))
    assert "label" not in graph.nodes[TABLE] and "\\u202e" in graph.nodes[MUG]["label"]
    assert networkx.read_graphml(merges).number_of_nodes() == 6
    assert b"None" not in first.read_bytes()


def test_every_format_counts_what_the_store_counts(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr")
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[1] / "benchmarks")
    receivers = importlib.import_module("receivers")
    row = receivers.examined(room, tmp_path, nvidia=False)
    assert row["sound"] and row["instances"] == 6 and {"json", "csv", "graphml", "usd"} <= set(row["agree"])
    with list3r.open(room) as memory:
        wanted = receivers.stored(memory)
    found = receivers.read_usd(tmp_path / "points.usdc")
    assert receivers.agrees(wanted, found) and receivers.off(wanted, found) < 1e-6
    assert not receivers.agrees(wanted, replace(found, relations=found.relations[1:]))
    assert receivers.off(wanted, replace(found, corners={k: c + 0.01 for k, c in found.corners.items()})) > 0.009
    assert receivers.off(wanted, replace(found, corners={MUG: found.corners[MUG]})) == float("inf")


def test_node_link_is_read_by_networkx(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        first, merges = memory.export("node-link", tmp_path / "g.json")
    content = json.loads(first.read_text(encoding="utf-8"))
    graph = networkx.node_link_graph(content, edges="edges")
    assert graph.nodes[MUG]["label"] == NASTY and graph.number_of_edges() == 4
    assert all(v is not None for node in content["nodes"] for v in node.values())
    assert networkx.node_link_graph(json.loads(merges.read_text()), edges="edges").number_of_nodes() == 6


def test_parquet_tables_are_typed(room: Path, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    with list3r.open(room) as memory:
        paths = memory.export("parquet", tmp_path / "room.parquet")
        for path, name in zip(paths, ("instances", "relations", "frames"), strict=True):
            assert pq.read_table(path).to_pylist() == records_of(memory.store, name)


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio"])
def test_posed_pictures_are_read_back_as_a_source(kind: str, room: Path, tmp_path: Path) -> None:
    if kind == "colmap":
        pytest.importorskip("pycolmap")
    with list3r.open(room) as memory:
        memory.export(kind, tmp_path / kind)
        memory.export(kind, tmp_path / kind)
        (frame, S_world_cam) = memory.store.trajectory.poses()[0]
        chunk = memory.store.chunks.get(frame.chunk_id)
    source = open_source(tmp_path / kind)
    assert (source.info.kind, source.info.frame_count) == (kind, 1)
    (read,) = source.read(0, 1)
    np.testing.assert_allclose(read.T_source_cam[:3, :3], S_world_cam.rotation, atol=1e-6)
    np.testing.assert_allclose(read.T_source_cam[:3, 3], S_world_cam.translation, atol=1e-6)
    camera = source.info.camera
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), chunk.intrinsics, atol=1e-4)


def test_a_folder_of_others_is_refused_and_parts_stand_apart(room: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("x")
    with list3r.open(room) as memory:
        with pytest.raises(ExportError, match="holds other files"):
            memory.export("colmap", tmp_path / "mine")
        with pytest.raises(OptionError, match="color belongs to ply and glb, not to colmap"):
            memory.export("colmap", tmp_path / "c", color="rgb")
    with list3r.open(write_split_memory(tmp_path / "split.l3r")) as memory:
        written = {p.relative_to(tmp_path / "c").as_posix() for p in memory.export("colmap", tmp_path / "c")}
        assert {"sparse/0/images.txt", "sparse/1/images.txt"} <= written
        lines = (tmp_path / "c/sparse/0/images.txt").read_text().splitlines()
        assert sum(line.endswith(".jpg") for line in lines) == 19, "without pictures, all posed frames"
        written = {p.name for p in memory.export("nerfstudio", tmp_path / "n")}
        assert {"transforms.json", "transforms.component_1.json", "points.component_1.ply"} <= written


def test_the_head_of_a_jpeg_states_its_size() -> None:
    assert jpeg_size(small_picture()) == (48, 64)
    assert jpeg_size(b"\x89PNG....") is None and jpeg_size(b"") is None and jpeg_size(small_picture()[:40]) is None


def test_a_recording_has_points_boxes_and_the_camera(room: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with list3r.open(room) as memory:
        (path,) = memory.export("rerun", tmp_path / "room.rrd")
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(path)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    for part in ("/world/instances/3/points", "/world/instances/3/box", "/world/camera/session_1", "/world/relations"):
        assert part in told


# ---------------------------------------------------------------------------------------------- the page


class Links(html.parser.HTMLParser):
    """Addresses in a page, and its elements."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.elements: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "action")]


def test_the_page_loads_nothing_and_escapes_names(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        (path,) = memory.export("report", tmp_path / "report.html")
        text = path.read_text(encoding="utf-8")
        links = Links()
        links.feed(text)
        assert [a[:22] for a in links.addresses] == ["data:image/png;base64,"]
        assert links.elements.count("script") == 2 and "b" not in links.elements
        data = json.loads(text.split('id="data">')[1].split("</script>")[0])
        assert [i["id"] for i in data["instances"]] == [i.id for i in memory.instances(structure=None)]
        assert data["instances"][2]["label"] == NASTY and str(MUG) in data["crops"]


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
def test_the_page_can_be_searched(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        (path,) = memory.export("report", tmp_path / "report.html")
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(path.as_uri())
        browser.wait(lambda: browser.run("document.querySelectorAll('#list tbody tr').length") == 6)
        assert browser.run("document.querySelectorAll('b[onclick]').length") == 0
        browser.run("search.value = 'bel on table'; search.dispatchEvent(new Event('input'))")
        assert browser.run("[...document.querySelectorAll('#list tbody tr')].map(r => r.id).join()") == "3"
        browser.run("document.querySelector('#list tbody tr a').click()")
        assert browser.run("search.value") == "#2"
        assert browser.errors == []
    finally:
        browser.close()


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
def test_the_scene_can_be_searched_and_clicked_from_disk(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        (path,) = memory.export("web", tmp_path / "web.html")
        chair = memory.instance(5)
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(path.as_uri())
        browser.wait(lambda: browser.run("document.querySelectorAll('#list button').length") == 6)
        assert browser.run("document.querySelectorAll('b[onclick]').length") == 0
        browser.run("search.focus()")
        browser.call("Input.insertText", text="where is the seat?")
        browser.enter()
        browser.wait(lambda: browser.run("selected") == chair.id)  # by what a chair is a kind of
        browser.wait(lambda: np.allclose(browser.run("eye.at"), chair.center, atol=0.01))
        assert "chair" in browser.run("get('about').innerText")
        browser.run("search.value = 'elephant'; search.form.requestSubmit()")
        browser.says("Nothing found for \u201celephant\u201d")
        assert browser.run("selected") is None and browser.run("get('about').hidden")
        browser.run("search.value = ''; list(); [...rows.values()][0].click()")
        assert browser.run("selected") == browser.run("[...rows.keys()][0]")
        browser.run(f"select({chair.id}, true)")
        browser.wait(lambda: np.allclose(browser.run("eye.at"), chair.center, atol=0.01))
        time.sleep(1)
        browser.run("select(null)")
        width, height = browser.run("[canvas.clientWidth, canvas.clientHeight]")
        browser.click(width / 2, height / 2)
        browser.wait(lambda: browser.run("selected") is not None)  # its points are few: perhaps the floor behind
        light = browser.picture()[-20:, -20:].mean()  # of the list: a surface may fill the scene
        browser.run("get('dark').click()")
        browser.wait(lambda: abs(browser.picture()[-20:, -20:].mean() - light) > 100)
        assert browser.errors == []
    finally:
        browser.close()


def test_the_scene_page_loads_nothing_escapes_names_and_keeps_its_size(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        (path,) = memory.export("web", tmp_path / "web.html")
        text = path.read_text(encoding="utf-8")
        links = Links()
        links.feed(text)
        assert links.addresses == [] and links.elements.count("script") == 3 and "b" not in links.elements
        data = json.loads(text.split('id="data">')[1].split("</script>")[0])
        assert data["instances"][2]["name"] == shown(NASTY) and data["units"] == memory.units
        assert data["cloud"]["kept"] == data["cloud"]["known"] == sum(many for _, many, *_ in data["cloud"]["runs"])
        few = write_web(memory, tmp_path / "few.html", WebSettings(megabytes=0.001))[0].read_text(encoding="utf-8")
        cloud = json.loads(few.split('id="data">')[1].split("</script>")[0])["cloud"]
        assert cloud["kept"] < cloud["known"] == data["cloud"]["known"] and all(many for _, many, *_ in cloud["runs"])
        raw = base64.b64decode(text.split('id="points">')[1].split("</script>")[0])
        whole = data["cloud"]
        steps = np.frombuffer(raw, "<u2", 3 * whole["kept"], 12 * whole["faces"]).reshape(-1, 3)
        places = np.array(whole["low"]) + whole["span"] * steps / 65535
        starts = np.cumsum([0, *(many for _, many, *_ in whole["runs"])])
        known = memory.surfaces()
        for (n, many, *_), start in zip(whole["runs"], starts, strict=False):
            assert places[start : start + many] == pytest.approx(known[n].vertices, abs=whole["span"] / 60000)


def test_a_pipe_gets_one_whole_file(room: Path, tmp_path: Path, make_memory: Callable[..., Path]) -> None:
    command = [sys.executable, "-m", "list3r", "export", str(room), "--to", "json", "--out", "-"]
    piped = subprocess.run(command, capture_output=True, check=True, timeout=60)
    with list3r.open(room) as memory:
        (path,) = memory.export("json", tmp_path / "scene.json")
    assert piped.stdout == path.read_bytes() and piped.stderr == b""


@pytest.mark.parametrize("words", [["--to", "colmap"], ["--to", "json", "--json"]])
def test_what_cannot_be_piped_is_said(words: list[str], room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", str(room), *words, "--out", "-"]) == 2
    assert capsys.readouterr().err.count("\n") == 1

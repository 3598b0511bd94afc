"""The viewer: what it shows and picks, links, who may connect, and the page itself in a headless browser."""

from __future__ import annotations

import itertools
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import List3rError
from list3r.memory.core.records import Relation
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from tests.conftest import small_picture, write_small_room
from tests.session_scenes import ROOM, Box, add_session, cameras, place_together

pytest.importorskip("viser")
import msgspec
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from list3r.viewer.app import Viewer, ViewerSettings
from list3r.viewer.clouds import FINE, CloudSettings
from list3r.viewer.instance_text import described
from list3r.viewer.link import ViewState
from list3r.viewer.listing import filtered, legend, listed
from list3r.viewer.names import on_page, with_room
from list3r.viewer.panel import NOTHING_SELECTED
from list3r.viewer.side_by_side import SideBySide
from list3r.viewer.world import (
    COLOR_MODES,
    ShownCloud,
    close_by,
    color_of,
    colors,
    overview,
    pick,
    point_size,
    read_path,
    read_world,
)
from tests.browser import PROGRAM, Browser

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)


def write_room(path: Path) -> Path:
    with Store.create(path) as store, store.transaction():
        write_small_room(store, small_picture(), depth=0.0)
    return path


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("viewer") / "room.l3r")


@pytest.fixture(scope="module")
def two_sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table on which the red box is moved and the blue one taken away between two sessions."""
    path = tmp_path_factory.mktemp("viewer") / "two.l3r"
    moved = replace(ROOM["red"], center=(-0.2, 0.25, 0.81))
    later: dict[str, Box] = {k: v for k, v in ROOM.items() if k != "blue"} | {"red": moved}
    with Store.create(path) as store:
        for seen, start in ((ROOM, 0.4), (later, 1.0)):
            with store.transaction():
                add_session(store, seen, cameras((0.0, 0.0, 0.8), start))
                place_together(store)
                consolidate(store)
    return path


# ---------------------------------------------------------------------------------------------- what is shown


def test_the_panel_says_of_each_pair_what_tells_most(room: Path) -> None:
    said = [(MUG, "near", TABLE), (MUG, "next_to", TWIN), (MUG, "near", TWIN), (MUG, "on", TABLE), (TABLE, "near", MUG)]
    with list3r.open(room) as memory:
        relations = [Relation(a, predicate, b, 0.9, 0.1) for a, predicate, b in said]
        text = described(memory, read_world(memory, []), MUG, relations)
    assert [line for line in text.splitlines() if line.startswith("- ")] == ["- on 2 table", "- next to 4 mug"]


@given(st.lists(st.integers(1, 200), min_size=1, max_size=12), st.integers(1, 500))
def test_the_overview_keeps_its_bound_and_small_things(counts: list[int], most: int) -> None:
    had = np.array(counts)
    of_each = overview(had, most)
    assert of_each.sum() <= max(most, 0) + len(counts) and (of_each <= had).all()
    if sum(counts) <= most:
        assert (of_each == had).all()
    shares = of_each / had
    order = np.argsort(counts)
    assert (
        all(shares[a] >= shares[b] - 1 / counts[a] - 1 / counts[b] for a, b in itertools.pairwise(order))
        and of_each.all()
    )


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=8))
def test_a_part_of_a_cloud_has_the_points_asked_for(ranges: list[tuple[int, int]]) -> None:
    counts = np.full(len(ranges), 9)
    points = np.arange(27 * len(ranges), dtype=np.float32).reshape(-1, 3)
    cloud = ShownCloud(
        points,
        points.astype(np.uint8),
        points.astype(np.int8),
        5 + np.arange(len(ranges)),
        counts,
        np.ones(len(ranges)),
    )
    low, high = np.array(ranges).T
    part = cloud.part(low, high)
    wanted = [points[9 * k + a : 9 * k + b] for k, (a, b) in enumerate(ranges)]
    assert (part.points == np.concatenate(wanted)).all() and len(part.owner) == len(part.points)
    assert (cloud.of(5, 4).points == points[:4]).all() and (cloud.of(5, 4).owner == 5).all()


def test_what_is_near_comes_in_full(room: Path) -> None:
    with list3r.open(room) as memory:
        world = read_world(memory, [])
    hidden = world.cloud.counts - overview(world.cloud.counts, 600)
    chosen = close_by(world, hidden, np.array([2.0, 1.0, 0.5]), 500)
    assert chosen[world.cloud.ids == CHAIR] > 0 and chosen.sum() <= 500
    assert (chosen <= hidden).all()


def test_a_ray_meets_what_is_first(room: Path) -> None:
    with list3r.open(room) as memory:
        world = read_world(memory, [])
    above_mug = np.array([1.8, 0.1, 3.0])
    met = pick(world, world.cloud, above_mug, np.array([0.0, 0.0, -1.0]))
    assert met is not None and met[0] == MUG and met[1][2] == pytest.approx(0.82, abs=0.02)
    bare = pick(world, world.cloud.of(0, 0), above_mug, np.array([0.0, 0.0, -1.0]))
    assert bare is not None and bare[0] == MUG and bare[1][2] == pytest.approx(0.82)
    assert pick(world, world.cloud, above_mug, np.array([0.0, 0.0, 1.0])) is None


def test_colours_are_those_of_the_mode(two_sessions: Path) -> None:
    with list3r.open(two_sessions) as memory:
        told = memory.changes()
        world = read_world(memory, told)
        assert {c.event.kind for c in told} == {"moved", "removed"}
    moved = next(c.instance.id for c in told if c.event.kind == "moved")
    assert color_of(world, moved, "changes") != color_of(world, moved, "instance")
    own = colors(world, world.cloud, "own colour", None)
    assert (own == world.cloud.rgb).all()
    chosen = colors(world, world.cloud, "own colour", moved)
    assert ((chosen != own).any(axis=1) <= (world.cloud.owner == moved)).all() and (chosen != own).any()


def test_changes_have_a_legend(two_sessions: Path, room: Path) -> None:
    with list3r.open(two_sessions) as memory:
        text = legend(read_world(memory, memory.changes()))
    assert "0 added" in text and "1 moved" in text and "1 removed" in text
    with list3r.open(room) as memory:
        assert "Nothing is known to have changed" in legend(read_world(memory, []))


def test_points_are_as_large_as_they_lie_apart(room: Path) -> None:
    with list3r.open(room) as memory:
        cloud = read_world(memory, []).cloud
    few = cloud.part(np.zeros_like(cloud.counts), np.minimum(cloud.counts, 20))
    assert few.spacing == pytest.approx(cloud.spacing * np.sqrt(cloud.counts / few.counts))
    assert point_size(np.array([0.01, 0.02]), 1.0) == pytest.approx([0.015, 0.03], rel=0.1)


def test_the_list_has_all_words_of_a_filter_and_takes_names_as_text(room: Path) -> None:
    with list3r.open(room) as memory:
        world = read_world(memory, [])
    assert filtered(world, "") == [TABLE, MUG, TWIN, CHAIR, FLOOR, WALL]
    assert filtered(world, "Mug") == [MUG, TWIN] and filtered(world, "mug chair") == []
    world.instances[MUG] = replace(world.instances[MUG], label="<img src=x onerror=alert(1)>", description='"><b>')
    text = listed(world, [MUG], {}, "<i>")
    assert "<img" not in text and "<b>" not in text and "&lt;img src=x" in text and "&lt;i&gt;" in text


def test_the_path_is_that_of_the_camera(room: Path) -> None:
    with list3r.open(room) as memory:
        path = read_path(memory)
    assert len(path.frame) == 20 and np.allclose(np.diff(path.position[:, 1]), 0.01)


@given(st.lists(st.tuples(*[st.integers(-400, 400)] * 2, *[st.integers(10, 90)] * 2), min_size=1, max_size=30))
def test_names_that_are_shown_do_not_cover_each_other_and_hide_for_no_other_reason(rows: list[tuple[int, ...]]) -> None:
    told = np.array(rows, float)
    kept = with_room(told[:, :2], told[:, 2:])
    low, high = told[:, :2] - told[:, 2:] * [0.5, 1.0], told[:, :2] + told[:, 2:] * [0.5, 0.0]
    cover = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(axis=2)
    assert kept[0]
    for k in range(1, len(rows)):
        assert kept[k] != (cover[k, :k] & kept[:k]).any()


def test_a_name_stands_where_the_page_draws_the_thing() -> None:
    T_world_cam = np.eye(4)
    T_world_cam[:3, 3] = (1.0, 0.0, -2.0)
    at = on_page(np.array([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [1.0, 0.0, -3.0]]), T_world_cam, np.pi / 2, 800.0)
    assert at[:2] == pytest.approx(np.array([[0.0, 0.0], [0.0, 400.0]])) and np.isnan(at[2]).all()
    assert not with_room(at, np.full((3, 2), 10.0))[2]


# ---------------------------------------------------------------------------------------------- links

views = st.builds(
    ViewState, selected=st.none() | st.integers(0, 10**9),
    colors=st.sampled_from(COLOR_MODES), session=st.none() | st.integers(1, 99), labels=st.booleans(),
    dark=st.booleans(), path=st.booleans(),
)  # fmt: skip


@given(views)
def test_a_code_gives_back_its_view(view: ViewState) -> None:
    assert ViewState.decode(view.encode()) == view


@given(st.text(max_size=80))
def test_any_code_gives_some_view(code: str) -> None:
    assert isinstance(ViewState.decode(code), ViewState)


def test_what_makes_no_sense_in_a_code_is_as_usual() -> None:
    import base64

    deep = base64.urlsafe_b64encode(b"[" * 1400).decode()
    assert ViewState.decode(deep) == ViewState() == ViewState.decode("")
    far = base64.urlsafe_b64encode(b'{"session": -1, "selected": 99999999999999999999}').decode()
    assert ViewState.decode(far) == ViewState()
    code = base64.urlsafe_b64encode(b'{"colors": "loud", "selected": "x", "dark": true, "what": [1, 2]}').decode()
    assert ViewState.decode(code) == ViewState(dark=True)


# ---------------------------------------------------------------------------------------------- the server


@pytest.fixture
def viewer(room: Path) -> Iterator[Viewer]:
    with list3r.open(room) as memory:
        shown = Viewer(memory, ViewerSettings(0))
        yield shown
        shown.stop()


def test_pages_of_other_sites_are_not_answered(viewer: Viewer) -> None:
    address = viewer.address.replace("http", "ws")
    port = viewer.server.get_port()
    others = (
        f"http://127.0.0.1:{port - 1}",
        "http://127.0.0.1",
        f"http://localhost:{port}",
        f"https://127.0.0.1:{port}",
    )
    for origin in ("https://elsewhere.example", "http://127.0.0.1.elsewhere.example", "null", *others):
        with pytest.raises(InvalidStatus) as refused:
            connect(address, origin=origin)
        assert refused.value.response.status_code == 403
    with pytest.raises(InvalidStatus):
        connect(address)
    with pytest.raises(InvalidStatus):
        connect(address.replace("127.0.0.1", "localhost"), origin=Origin(f"http://localhost:{port}"))
    connect(address, origin=Origin(viewer.address)).close()


def test_another_name_of_the_host_is_told_the_right_one(viewer: Viewer) -> None:
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(viewer.address.replace("127.0.0.1", "localhost"))
    assert refused.value.code == 403
    assert f"answers at {viewer.address} only" in refused.value.read().decode()


def open_page(viewer: Viewer, code: str | None, **headers: str) -> None:
    """Open a page as a browser does, with a link where there is a code, until the viewer has taken it in."""
    link(viewer, code or "", **headers)
    before, said = set(viewer._pages), dict.fromkeys(("wxyz", "position", "look_at", "up_direction"), (0.0, 0.0, 1.0))
    camera = {"type": "ViewerCameraMessage", **said, "wxyz": (1.0, 0.0, 0.0, 0.0), "fov": 1.0, "near": 0.1, "far": 9.0}
    version = Subprotocol(f"viser-v{viser.__version__}")
    with connect(viewer.address.replace("http", "ws"), origin=Origin(viewer.address), subprotocols=[version]) as page:
        page.send(msgspec.msgpack.encode(camera | {"image_height": 90, "image_width": 90}))
        deadline = time.monotonic() + 60
        while not set(viewer._pages) - before:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def link(viewer: Viewer, code: str, **headers: str) -> None:
    asked = urllib.request.Request(f"{viewer.address}/?view={code}", headers={"Sec-Fetch-Dest": "document", **headers})
    with urllib.request.urlopen(asked) as answer:
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors http://127.0.0.1:*"


def test_a_link_to_what_is_not_there_is_told_and_breaks_nothing(two_sessions: Path) -> None:
    with list3r.open(two_sessions) as memory:
        viewer = Viewer(memory, ViewerSettings(0))
        try:
            open_page(viewer, ViewState(session=0, selected=12345, dark=True).encode())
            assert viewer.state == ViewState(dark=True)
            assert viewer.panel._message.content == (
                "This memory has no session 0, which the link names. There is no instance 12345, which the link names."
            )
            viewer.reload()
            open_page(viewer, ViewState(session=1).encode())
            assert viewer.state == ViewState(session=1) and viewer.panel._message.content == ""
            for session in (99, 0, -1):
                with pytest.raises(List3rError):
                    viewer.show(session=session)
                assert viewer.state == ViewState(session=1)
            viewer.show(labels=False)
            viewer.reload()
            assert viewer.state == ViewState(session=1, labels=False)
        finally:
            viewer.stop()


def test_of_many_links_the_last_one_is_shown_and_that_is_told(viewer: Viewer) -> None:
    for n in range(200):
        link(viewer, ViewState(selected=n).encode())
    open_page(viewer, ViewState(selected=MUG).encode())
    assert viewer.state.selected == MUG
    assert "Several links were opened at once" in viewer.panel._message.content
    viewer.select(None)
    open_page(viewer, None)
    assert viewer.state.selected is None


def test_a_picture_of_another_page_is_no_link(viewer: Viewer) -> None:
    for what in ("image", "script", "empty"):
        link(viewer, ViewState(selected=CHAIR).encode(), **{"Sec-Fetch-Dest": what})
    open_page(viewer, None)
    assert viewer.state.selected is None


def test_search_select_and_measure_without_a_page(viewer: Viewer) -> None:
    assert viewer.find("mug on table") == [MUG, TWIN] and viewer.state.selected == MUG
    assert viewer.find("elephant") == [] and viewer.state.selected is None
    assert viewer.panel._text.content == NOTHING_SELECTED
    assert "Nothing found for \u201celephant\u201d" in viewer.panel._message.content
    viewer.show(selected=12345)
    assert viewer.state.selected is None
    assert ViewState.decode(viewer.link(None).split("view=")[1]) == viewer.state


def test_several_memories_stand_side_by_side(viewer: Viewer, room: Path) -> None:
    with list3r.open(room) as memory:
        other = Viewer(memory, ViewerSettings(0))
        beside = SideBySide([("a <b>", viewer.address), ("other", other.address)])
        try:
            with urllib.request.urlopen(beside.address) as answer:
                text = answer.read().decode()
        finally:
            beside.stop()
            other.stop()
    assert viewer.address != other.address
    assert [f'src="{v.address}"' in text for v in (viewer, other)] == [True, True] and "a &lt;b&gt;" in text


def test_the_program_says_what_is_wrong(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", str(room), "--port", "0"]) == 2
    assert run(["view", str(room.with_name("absent.l3r"))]) == 2
    assert "absent.l3r" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------- the page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if PROGRAM is None:
        pytest.skip("there is no Chromium")
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


def test_a_page_searches_clicks_edits_and_comes_back(browser: Browser, tmp_path: Path) -> None:
    path = write_room(tmp_path / "room.l3r")
    with list3r.open(path, writable=True) as memory:
        viewer = Viewer(memory, ViewerSettings(0, clouds=CloudSettings(overview_points=1000)))
        try:
            browser.open(viewer.address)
            browser.says(NOTHING_SELECTED)
            browser.fill("Find", "mug")
            browser.says("2 of 6; type to narrow down")
            browser.enter()
            browser.says("2 found for \u201cmug\u201d")
            browser.says("3 mug")
            browser.says("on 2 table")
            browser.wait(lambda: browser.run("[...document.querySelectorAll('img')].some(i => i.naturalWidth > 200)"))
            browser.fill("Name", "blue <b>cup</b>")
            browser.press("Name it")
            browser.says("3 blue <b>cup</b>")
            assert memory.instance(MUG).label == "blue <b>cup</b>"
            browser.key("d")
            browser.wait(lambda: viewer.state.dark)
            browser.wait(lambda: float(browser.picture()[25:45, 1080:1160].mean()) < 90)  # the panel's head
            browser.press("Link to this view")
            found = "([...document.querySelectorAll('input')].find(i => i.value.includes('?view=')) || {}).value"
            browser.wait(lambda: browser.run(found))
            link = str(browser.run(found))
            (client,) = viewer.server.get_clients().values()
            place = np.array(client.camera.position)
            viewer.show(dark=False, selected=None)
            browser.open("about:blank")
            browser.wait(lambda: not viewer.server.get_clients())
            browser.open(link)
            browser.says("3 blue <b>cup</b>")
            assert viewer.state.dark and viewer.state.selected == MUG
            (client,) = viewer.server.get_clients().values()
            browser.wait(lambda: np.allclose(client.camera.position, place, atol=0.02))
            assert browser.errors == []
        finally:
            viewer.stop()
    with list3r.open(path) as memory:
        assert memory.instance(MUG).label == "blue <b>cup</b>"


def test_a_row_selects_and_flies_and_an_empty_search_clears(browser: Browser, room: Path) -> None:
    with list3r.open(room) as memory:
        viewer = Viewer(memory, ViewerSettings(0))
        try:
            browser.open(viewer.address)
            browser.says("6 of 6")
            browser.wait(lambda: viewer.server.get_clients() and any(p.at_rest for p in viewer._pages.values()))
            browser.fill("Find", "chair")
            browser.says("1 of 6")
            browser.run("document.querySelector('.things [data-thing]').click()")
            browser.says("5 chair")
            (client,) = viewer.server.get_clients().values()
            browser.wait(lambda: np.allclose(client.camera.look_at, viewer.world.instances[CHAIR].center, atol=0.02))
            assert viewer.state.selected == CHAIR and viewer.panel._typed == "chair"
            browser.fill("Find", "elephant")
            browser.says("0 of 6")
            browser.enter()
            browser.says("Nothing found for \u201celephant\u201d")
            browser.says(NOTHING_SELECTED)
            assert viewer.state.selected is None and "5 chair" not in browser.text()
            viewer.show(colors="changes")
            browser.says("Nothing is known to have changed")
            assert browser.errors == []
        finally:
            viewer.stop()


def test_a_click_on_a_thing_selects_it(browser: Browser, room: Path) -> None:
    with list3r.open(room) as memory:
        viewer = Viewer(memory, ViewerSettings(0))
        try:
            browser.open(viewer.address)
            browser.says(NOTHING_SELECTED)
            browser.wait(viewer.server.get_clients)
            time.sleep(5.0)  # the page sets its first camera after it has connected
            viewer.select(CHAIR, turn=True)
            browser.says("5 chair")
            viewer.select(None)
            browser.says(NOTHING_SELECTED)
            browser.wait(lambda: _selects(browser, viewer))
            assert viewer.state.selected == CHAIR
        finally:
            viewer.stop()


def _selects(browser: Browser, viewer: Viewer) -> bool:
    browser.click(640, browser.run("window.innerHeight") / 2)
    browser.run("new Promise(r => setTimeout(r, 500))")
    return viewer.state.selected is not None


def test_the_slider_goes_back_in_time(browser: Browser, two_sessions: Path) -> None:
    with list3r.open(two_sessions) as memory:
        viewer = Viewer(memory, ViewerSettings(0))
        try:
            blue = next(c.instance.id for c in memory.changes() if c.event.kind == "removed")
            assert blue not in viewer.world.instances
            browser.open(viewer.address)
            browser.says("After session")
            before = viewer.world
            browser.run(
                "(() => { const s = document.querySelector('[role=slider]'); s.focus(); s.dispatchEvent("
                "new KeyboardEvent('keydown', {key: 'ArrowLeft', code: 'ArrowLeft', bubbles: true})); })()"
            )
            browser.wait(lambda: viewer.state.session == 1)
            browser.wait(lambda: viewer.world is not before)
            assert blue in viewer.world.instances
            viewer.show(colors="changes", session=2)
            viewer.at_time(3)
            browser.wait(lambda: browser.picture().std() > 10)
            assert browser.errors == []
        finally:
            viewer.stop()


def test_a_slow_page_draws_less_while_its_camera_moves(browser: Browser, room: Path) -> None:
    with list3r.open(room) as memory:
        viewer = Viewer(memory, ViewerSettings(0, clouds=CloudSettings(pause_s=3.0)))
        try:
            browser.open(viewer.address)
            browser.wait(lambda: any(p.at_rest for p in viewer._pages.values()), 300)
            (page,) = viewer._pages.values()
            assert not page.slow and page.seconds_a_point is None
            page.seconds_a_point = 1e-4  # as if it had been measured
            viewer.show(colors="instance")
            assert page.slow and page.most_points == 5000
            browser.wait(lambda: page._nodes[FINE].visible, 300)  # a camera that comes to rest late counts as moving
            (client,) = viewer.server.get_clients().values()
            client.camera.position = client.camera.position + 1.0
            browser.wait(lambda: not page._nodes[FINE].visible, 300)
            assert page._nodes["/coarse"].visible
            browser.wait(lambda: page._nodes[FINE].visible, 300)
            assert not page._nodes["/coarse"].visible and browser.errors == []
        finally:
            viewer.stop()

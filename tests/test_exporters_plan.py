"""The plan view: where things land on the page, tags that can be read, and pictures that hold what they say."""

from __future__ import annotations

import xml.etree.ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from list3r.exporters.components import read_components
from list3r.exporters.plan.colors import PALETTE, nearest_before, plan_colors
from list3r.exporters.plan.frame import PlanFrame, choose_rotation
from list3r.exporters.plan.labels import TagTarget, crossings, place_tags
from list3r.exporters.plan.layout import PlanSettings, choose_layout
from list3r.exporters.plan.margins import round_length
from list3r.exporters.plan.picture import plan_image, write_plan
from list3r.exporters.plan.sheet import plain_text
from list3r.memory.errors import OptionError
from list3r.memory.store.store import Store
from tests.test_exporters import write_split_memory


def test_the_picture_has_its_size_and_its_colours(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with Store.open(make_memory()) as store:
        write_plan(store, tmp_path / "plan.png")
    picture = Image.open(tmp_path / "plan.png")
    assert picture.width == 1600
    assert picture.mode == "RGB"
    pixels = np.asarray(picture).reshape(-1, 3).astype(int)
    for id in (2, 3, 4, 5):
        assert (np.abs(pixels - PALETTE[id]).max(axis=1) <= 2).sum() > 20, f"the box of {id} is not drawn"


def test_width_follows_the_settings(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        picture = plan_image(store, read_components(store)[0], PlanSettings(width_px=1000))
    assert picture.width == 1000
    with pytest.raises(OptionError, match="at least"):
        PlanSettings(width_px=500)


def test_the_page_is_seen_from_above(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        (component,) = read_components(store)
        rotation, note = choose_rotation(component, "estimated")
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(rotation[2], [0, 0, 1])
    assert "z is up" in note
    along = np.abs(rotation[:2, :2])
    assert np.allclose(np.sort(along.ravel()), [0, 0, 1, 1], atol=1e-9), "the walls lie along the page"


def test_without_gravity_the_camera_path_gives_the_page(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        component = read_components(store)[0]
        rotation, note = choose_rotation(component, store.facts.gravity)
    camera_up = -component.poses[0][1].rotation[:, 1]
    assert rotation[2] @ camera_up > 0.99
    assert "gravity unknown" in note


def test_world_points_land_on_the_page() -> None:
    frame = PlanFrame(np.eye(3), np.array([1.0, 2.0]), 100.0, (400, 200), "")
    assert np.allclose(frame.to_px([[1.0, 2.0, 5.0], [2.0, 2.5, 0.0]]), [[200, 100], [300, 50]])


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**16))
def test_tags_do_not_cover_each_other(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    anchors = [
        TagTarget((float(x), float(y)), (float(w), float(h)), (24.0, 16.0))
        for x, y, w, h in zip(*rng.uniform(0, 1000, (2, count)), *rng.uniform(2, 60, (2, count)), strict=True)
    ]
    places = np.array(place_tags(anchors, (0.0, 0.0, 1000.0, 1000.0)))
    apart = np.abs(places[:, None] - places[None])
    touching = (apart[..., 0] < 24.0) & (apart[..., 1] < 16.0)
    assert touching.sum() == count
    assert places.min() >= 8.0
    assert places.max() <= 992.0


def test_a_tag_on_a_large_thing_is_on_it() -> None:
    (place,) = place_tags([TagTarget((500.0, 500.0), (100.0, 100.0), (24.0, 16.0))], (0.0, 0.0, 1000.0, 1000.0))
    assert place == (500.0, 500.0)


def test_round_lengths() -> None:
    assert [round_length(v) for v in (0.9, 1.0, 4.9, 7.0, 23.0)] == pytest.approx([0.5, 1.0, 2.0, 5.0, 20.0])


def test_letters_that_the_font_lacks_are_replaced() -> None:
    assert plain_text("écran 2 × 3 cm · …") == "ecran 2 ? 3 cm · …"
    assert plain_text("🪴 plant") == "plant"


def test_a_wide_scene_has_its_legend_below() -> None:
    wide, square = (choose_layout(np.array(span), 60, PlanSettings()) for span in ((10.0, 4.0), (4.0, 4.0)))
    assert (wide.columns, square.columns) == (3, 1)
    assert wide.legend_xy[1] > wide.map_px[1]
    assert square.legend_xy[0] > square.map_px[0]
    assert wide.rows * wide.columns < 60
    assert choose_layout(np.array((10.0, 4.0)), 0, PlanSettings()).rows == 0


def test_things_without_a_tag_are_faint(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        picture = plan_image(store, read_components(store)[0], PlanSettings(max_tags=2))
    pixels = np.asarray(picture).reshape(-1, 3).astype(int)
    drawn = [int((np.abs(pixels - PALETTE[id]).max(axis=1) <= 2).sum()) for id in (2, 3)]
    legend_only = (np.abs(pixels - PALETTE[5]).max(axis=1) <= 2).sum()
    assert min(drawn) > 2 * 20
    assert 0 < legend_only < drawn[0]


def test_neighbours_have_different_colours() -> None:
    places = {n: np.array(xy) for n, xy in enumerate(np.random.default_rng(0).uniform(0, 100, (60, 2)))}
    colors = plan_colors(places)
    for n in places:
        earlier = sorted(range(n), key=lambda k: float(np.linalg.norm(places[k] - places[n])))[:6]
        assert colors[n] not in {colors[k] for k in earlier}
    assert plan_colors({}) == {} and set(colors.values()) <= set(PALETTE)


def test_lines_that_cross_are_counted() -> None:
    leaders = np.array([[0.0, 1.0, 2.0, 1.0], [5.0, 5.0, 6.0, 6.0]])
    ends = np.array([[1.0, 2.0], [1.0, 0.5], [9.0, 0.0]])
    assert crossings(np.array([1.0, 0.0]), ends, leaders).tolist() == [1, 0, 0]


def test_a_vector_plan_says_what_the_picture_says(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        store.instances.set_labels({3: "Übel <b> & \x07"})
    with Store.open(path) as store:
        write_plan(store, tmp_path / "plan.svg")
    page = xml.etree.ElementTree.parse(tmp_path / "plan.svg").getroot()
    texts = [e.text for e in page.iter("{http://www.w3.org/2000/svg}text")]
    assert "room.l3r" in texts and "Übel <b> & \\x07" in texts and {"2", "3", "4", "5"} <= set(texts)
    images = list(page.iter("{http://www.w3.org/2000/svg}image"))
    assert [i.get("href", "")[:22] for i in images] == ["data:image/png;base64,"]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1400), st.integers(0, 2**32 - 1))
def test_the_nearest_before_are_those_that_are_found_one_by_one(count: int, seed: int) -> None:
    xy = np.random.default_rng(seed).normal(size=(count, 2))
    found = nearest_before(xy, 6)
    assert len(found) == count
    for k in range(0, count, 37):
        away = np.linalg.norm(xy[:k] - xy[k], axis=1)
        assert found[k] == np.argsort(away, kind="stable")[:6].tolist()

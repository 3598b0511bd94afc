"""The plan view: where things land on the page, tags that can be read, and pictures that hold what they say."""

from __future__ import annotations

import xml.etree.ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import ConvexHull

from list3r.exporters.components import read_components
from list3r.exporters.palette import instance_color
from list3r.exporters.plan.drawing import PlanSettings, draw_grid, footprints, plan_figure, write_plan
from list3r.exporters.plan.view import PlanView, choose_rotation, choose_view
from list3r.exporters.tags import TagTarget, crossings, place_tags
from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from tests.test_exporters import write_split_memory


def drawn(store: Store, how: PlanSettings | None = None) -> NDArray[np.int64]:
    """Return the pixels of the plan of the main component. Shape (N, 3)."""
    figure = plan_figure(store, read_components(store)[0], how)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].reshape(-1, 3).astype(np.int64)  # type: ignore[attr-defined]


def pixels_of(pixels: NDArray[np.int64], instance_id: int) -> int:
    """Return how many pixels have the colour of an instance."""
    return int((np.abs(pixels - np.array(instance_color(instance_id))).max(axis=1) <= 2).sum())


def test_the_picture_has_its_size_and_its_colours(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with Store.open(make_memory()) as store:
        write_plan(store, tmp_path / "plan.png")
    picture = Image.open(tmp_path / "plan.png")
    assert picture.width == 1600
    pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(np.int64)
    for id in (2, 3, 4, 5):
        assert pixels_of(pixels, id) > 20, f"the box of {id} is not drawn"


def test_width_follows_the_settings(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        figure = plan_figure(store, read_components(store)[0], PlanSettings(width_px=1000))
    assert round(figure.get_figwidth() * figure.dpi) == 1000
    with pytest.raises(OptionError, match="at least"):
        PlanSettings(width_px=500)


@pytest.mark.parametrize("turned_deg", [0.0, 13.0, 60.0])
def test_marks_of_the_axes_are_coordinates_of_the_memory(turned_deg: float) -> None:
    """However the page is turned, the point at a mark has the world coordinate that the mark says."""
    c, s = np.cos(np.deg2rad(turned_deg)), np.sin(np.deg2rad(turned_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    view = PlanView(rotation, np.array([-1.0, -3.0]), np.array([5.0, 2.0]), "")
    ax = Figure().add_subplot(xlim=(-1, 5), ylim=(-3, 2))
    draw_grid(ax, view, "m")
    for along, is_x in ((ax.xaxis, True), (ax.yaxis, False)):
        assert len(along.get_ticklocs()) > 2
        world_axis = "xy".index(along.get_label_text()[0])
        for mark, text in zip(along.get_ticklocs(), along.get_ticklabels(), strict=True):
            world = rotation[:2].T @ ([mark, -3.0] if is_x else [-1.0, mark])
            assert world[world_axis] == pytest.approx(float(text.get_text()), abs=1e-9)


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
    assert [i.get("{http://www.w3.org/1999/xlink}href", "")[:22] for i in images] == ["data:image/png;base64,"]


def test_instances_without_a_tag_are_faint(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        pixels = drawn(store, PlanSettings(max_tags=2))
    assert min(pixels_of(pixels, 2), pixels_of(pixels, 3)) > 2 * 20
    assert 0 < pixels_of(pixels, 5) < pixels_of(pixels, 2), "only the legend has it"


def test_outlines_are_the_shadows_of_boxes(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        (component,) = read_components(store)
        view = choose_view(component, {i.id: store.surfaces.of_instance(i) for i in component.instances}, "estimated")
    outlines = footprints(view, list(component.instances))
    for instance, outline in zip(component.instances, outlines, strict=True):
        hull = ConvexHull(view.on_page(instance.box.corners()))
        x, y = outline.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(hull.volume, rel=1e-6)

"""What a camera sees, with things hidden by others, and when a thing was seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.records import Observation
from list3r.memory.store.store import Store
from list3r.queries.match import Match
from list3r.queries.seen import seen, visible
from list3r.queries.views.camera import PosedCamera, camera_at_pose, camera_at_time, camera_of_frame, last_camera
from list3r.queries.within import within
from tests.conftest import box_points, chunk_result, instance, local_instance, write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)
LOOKING_ALONG_X = (0.5, -0.5, 0.5, -0.5)
"""R_world_cam as w, x, y, z: forward +x, right -y, down -z."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    with Store.create(tmp_path_factory.mktemp("camera") / "room.l3r") as opened, opened.transaction():
        write_small_room(opened)
        yield opened


def ids(matches: list[Match]) -> list[int]:
    return [m.instance.id for m in matches]


def at(store: Store, *place: float) -> PosedCamera:
    return camera_at_pose(store, place, LOOKING_ALONG_X)


def test_the_pose_of_a_frame_is_where_the_camera_stood(store: Store) -> None:
    camera = camera_of_frame(store, 5)
    assert np.allclose(camera.place, (0.0, 0.05, 0.0)) and np.allclose(camera.up, (0, 0, 1))
    assert np.allclose(camera.T_world_cam[:3, :3], at(store, 0, 0, 0).T_world_cam[:3, :3])
    assert getattr(camera_at_time(store, 5 / 30 + 0.01).frame, "frame_index", None) == 5
    assert np.allclose(camera_at_time(store, 1e9).place, last_camera(store).place)


def test_a_camera_sees_what_is_in_front_of_it(store: Store) -> None:
    ahead = ids(visible(store, at(store, 0.0, 0.0, 0.9)))
    assert {TABLE, MUG, TWIN} <= set(ahead)
    behind = camera_at_pose(store, (0.0, 0.0, 0.9), (0.5, -0.5, -0.5, 0.5))
    assert visible(store, behind, structure=True) == []


@pytest.fixture(scope="module")
def screened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A screen at x = 1 (id 1), a crate right behind it (2), another to the left of it (3)."""
    things = (
        ((1.0, 0.0, 0.0), (0.02, 1.0, 1.0)),
        ((2.0, 0.0, 0.0), (0.3, 0.3, 0.3)),
        ((2.0, 1.2, 0.0), (0.3, 0.3, 0.3)),
    )
    frames = np.arange(4)
    local = tuple(local_instance(k, box_points(c, s, 3000, k), (9, 9, 9), frames) for k, (c, s) in enumerate(things))
    with Store.create(tmp_path_factory.mktemp("screen") / "screen.l3r") as opened, opened.transaction():
        session = opened.sessions.add("walk", "abc", {}, 4)
        chunk = opened.chunks.add(session, chunk_result(0, 0, 4, local))
        opened.instances.put(
            instance(k + 1, c, s, (9, 9, 9), component=chunk, structure="wall" if k == 0 else None)
            for k, (c, s) in enumerate(things)
        )
        opened.observations.set(Observation(k + 1, chunk, k) for k in range(3))
        yield opened


def test_what_hides_is_not_seen_but_lies_in_the_frustum(screened: Store) -> None:
    camera = camera_of_frame(screened, 0)
    assert sorted(ids(visible(screened, camera, structure=True))) == [1, 3]
    assert ids(visible(screened, camera)) == [3], "what may not answer still hides"
    assert sorted(ids(within(screened, camera=camera))) == [3]
    assert sorted(ids(within(screened, camera=camera, occlusion=False))) == [2, 3]
    assert within(screened, camera=camera, max_depth=1.5) == []
    from_above = camera_at_pose(screened, (0.0, 0.0, 0.6), LOOKING_ALONG_X)
    half = {m.instance.id: m.score for m in visible(screened, from_above, min_visible=0.0)}
    assert half[3] > half.get(2, 0.0)


def test_a_picture_gives_its_box_and_how_far_it_is(store: Store) -> None:
    """A mug of 8 cm at 1.76 m with 60 px is 2.7 px wide, and is seen at its place in the picture."""
    camera = camera_of_frame(store, 0)
    raised = camera.T_world_cam + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.77], [0, 0, 0, 0]])
    camera = dataclasses.replace(camera, T_world_cam=raised)
    match = next(m for m in visible(store, camera) if m.instance.id == MUG)
    assert match.view is not None and match.view.frame_index == 0
    u, v = 32.0 - 60.0 * 0.1 / 1.8, 24.0
    x0, y0, x1, y1 = match.view.box_xyxy
    assert x0 - 1 <= u <= x1 + 1 and (y0 - 1 <= v <= y1 + 1)
    assert match.distance_m is not None and abs(match.distance_m - 1.76) < 0.05
    assert "followed in this frame" in match.reason


def test_the_far_end_of_the_frustum(store: Store) -> None:
    camera = at(store, 0.0, 0.0, 0.9)
    assert set(ids(visible(store, camera, max_depth=2.0))) >= {MUG}
    assert TWIN not in ids(visible(store, camera, max_depth=2.0))
    assert visible(store, camera, max_depth=0.5, structure=True) == [] or FLOOR in ids(
        visible(store, camera, max_depth=0.5, structure=True)
    )


def test_filters_choose_among_what_is_seen(store: Store) -> None:
    assert sorted(ids(visible(store, at(store, 0, 0, 0.9), max_size=0.2))) == [MUG, TWIN]


def test_when_a_thing_was_seen(store: Store) -> None:
    found = seen(store, MUG)
    assert [f.frame_index for f in found.frames] == list(range(20))
    assert found.spans_s == ((1, 0.0, pytest.approx(19 / 30)),)
    assert found.frames[3].box_xyxy == (10.0, 20.0, 30.0, 30.0)
    assert len(seen(store, MUG, gap_s=0.0).spans_s) == 20


def test_nonsense_is_refused(store: Store) -> None:
    camera = camera_of_frame(store, 0)
    for ask in (
        lambda: camera_of_frame(store, 4711),
        lambda: camera_of_frame(store, 0, session=9),
        lambda: camera_at_time(store, float("nan")),
        lambda: camera_at_pose(store, (0, 0, 0), (0, 0, 0, 0)),
        lambda: camera_at_pose(store, (0, 0, 0), "up"),
        lambda: camera_at_pose(store, (0, 0), (1, 0, 0, 0)),
        lambda: visible(store, camera, min_visible=2.0),
        lambda: visible(store, camera, max_depth=0.0),
        lambda: within(store, camera=camera, radius=1.0, center=(0, 0, 0)),
        lambda: within(store, center=(0, 0, 0), radius=1.0, max_depth=1.0),
        lambda: seen(store, MUG, gap_s=-1.0),
    ):
        with pytest.raises(OptionError):
            ask()
    with pytest.raises(UnknownIdError):
        seen(store, 77)
    with pytest.raises(OptionError, match="nearest that has one is 19"):
        camera_of_frame(store, 20)

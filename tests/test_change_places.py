"""What stands in the place of what is gone: facts on rooms of boxes that are alike but for one thing."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.core.records import Edge
from list3r.memory.library.change.free_space_carving import FreeSpaceCarving
from list3r.memory.library.change.places import Places
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.overlap.pair_scores import pair_scores
from list3r.memory.library.overlap.point_verdicts import UNTOLD
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.overlap.visibility import (
    DepthView,
    VisibilitySettings,
    in_sight_of,
    point_visibility,
    seen_through_shares,
    tally,
)
from list3r.memory.store.store import Store
from tests.session_scenes import ROOM, Box, add_session, cameras, cast, place_together, simulated_chunk

TABLE = (0.0, 0.0, 0.75)
S = VisibilitySettings()


def _view(depth: float, frame: int = 0) -> DepthView:
    picture = np.full((120, 160), depth, np.float32)
    return DepthView(1, frame, Sim3.identity(), 1.0, picture, (130.0, 130.0, 79.5, 59.5))


def _patch(z: float = 2.0) -> np.ndarray:
    side = np.linspace(-0.06, 0.06, 6)
    return np.array([[x, y, z] for x in side for y in side])


def test_a_point_counts_the_frames_that_see_it_and_that_see_through_it() -> None:
    free, met = tally(_patch(), [_view(2.0), _view(2.6, 1), _view(2.6, 2), _view(1.2, 3)], S)
    assert set(free.tolist()) == {2}
    assert set(met.tolist()) == {1}


@pytest.mark.parametrize(("depths", "share"), [((2.0, 2.01), 0.0), ((2.6, 2.6), 1.0), ((1.2, 0.0), None), ((), None)])
def test_a_surface_is_seen_through_or_not_or_nothing_is_told(depths: tuple[float, ...], share: float | None) -> None:
    assert seen_through_shares([_patch()], [_view(d, k) for k, d in enumerate(depths)], S) == [share]


def test_what_a_view_tells_lies_in_what_it_can_see() -> None:
    rng = np.random.default_rng(5)
    told, points = 0, rng.uniform(-6.0, 6.0, (4000, 3))
    for _ in range(12):
        S_cam_world = Sim3(np.array(rng.uniform(0.5, 2.0)), rotation_exp(rng.normal(size=3)), rng.normal(size=3))
        picture = rng.choice([0.0, 1.0, 9.0], (120, 160), p=[0.1, 0.1, 0.8]).astype(np.float32)
        view = DepthView(1, 0, S_cam_world, float(rng.uniform(0.5, 2.0)), picture, (130.0, 130.0, 79.5, 59.5))
        ((low, high),) = in_sight_of([view], S)
        known = point_visibility(points, view, S) != UNTOLD
        told += int(known.sum())
        assert ((points[known] >= low) & (points[known] <= high)).all()
    assert told > 200
    assert in_sight_of([], S).shape == (0, 2, 3)


def _two(path: Path, second: dict[str, Box], first: dict[str, Box] | None = None) -> Path:
    with Store.create(path) as store:
        for room, start in ((first or dict(ROOM), 0.4), (second, 1.0)):
            with store.transaction():
                add_session(store, room, np.concatenate([cameras(TABLE, start), cameras(TABLE, start + 0.1)]))
                place_together(store)
                consolidate(store)
    return path


def _tied(path: Path, second: dict[str, Box], sigma_m: tuple[float, float, float]) -> list[str]:
    """Kinds of what is told to have changed where the sessions lie on each other as surely as one relation tells."""
    with Store.create(path) as store:
        for room, start in ((dict(ROOM), 0.4), (second, 1.0)):
            with store.transaction():
                add_session(store, room, np.concatenate([cameras(TABLE, start), cameras(TABLE, start + 0.1)]))
                place_together(store)
                covariance = np.diag(np.square([*sigma_m, 1e-4, 1e-4, 1e-4, 0.0]))
                tie = Edge(
                    1, 2, "loop", Sim3.identity(), 1.0, 1.0, 9, 0.0, True, "", frames=(0, 0), covariance=covariance
                )
                store.edges.add([tie] if len(store.chunks.all()) == 2 else [])
                consolidate(store)
        return sorted(e.kind for e in store.events.all(2) if e.kind != "seen_again")


def test_nothing_has_moved_by_what_the_sessions_may_lie_off_each_other(tmp_path: Path) -> None:
    """Along the way that it went, that is: across it they may lie as they will."""
    blue = ROOM["blue"]
    moved = {**ROOM, "blue": Box((blue.center[0] + 0.25, *blue.center[1:]), blue.size, blue.rgb)}
    assert _tied(tmp_path / "sure.l3r", moved, (0.01, 0.01, 0.01)) == ["moved"]
    assert _tied(tmp_path / "across.l3r", moved, (0.01, 0.2, 0.01)) == ["moved"]
    assert _tied(tmp_path / "along.l3r", moved, (0.2, 0.01, 0.01)) == []


def test_what_is_far_off_is_not_asked_about_and_what_is_told_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second session that sees only the table tells nothing of a stool that is behind it."""
    moved = {**_without("red"), "blue": Box((0.6, 0.0, 0.80), ROOM["blue"].size, ROOM["blue"].rgb)}
    asked: list[bool] = []
    short = Places.out_of_sight

    def noted(places: Places, n: int, session: int) -> bool:
        asked.append(short(places, n, session))
        return asked[-1]

    monkeypatch.setattr(Places, "out_of_sight", noted)
    events, states = [], []
    for name, always in (("short", False), ("long", True)):
        if always:
            monkeypatch.setattr(Places, "out_of_sight", lambda *_: False)
            monkeypatch.setattr(Places, "far_apart", lambda *_: False)
        with Store.create(tmp_path / f"{name}.l3r") as store:
            for room, target in ((dict(ROOM), TABLE), (dict(ROOM), (0.0, 2.6, 0.3)), (moved, TABLE)):
                with store.transaction():
                    add_session(store, room, np.concatenate([cameras(target, 0.4, 0.4), cameras(target, 0.5, 0.4)]))
                    place_together(store)
                    consolidate(store)
            events.append([(e.session_id, e.instance_id, e.kind, e.reason) for e in store.events.all()])
            states.append([i.state for i in store.instances.all()])
    assert events[0] == events[1]
    assert states[0] == states[1]
    assert {kind for _, _, kind, _ in events[0]} >= {"moved", "removed"}
    assert any(asked)


def test_what_is_gone_is_gone_wherever_the_sessions_may_lie(tmp_path: Path) -> None:
    """A box on a table may be sunk into it where height is not known, never where it is."""
    for sigma_m, told in (((0.01, 0.01, 0.01), ["removed"]), ((0.01, 0.01, 0.09), [])):
        assert _tied(tmp_path / f"{sigma_m[2]}.l3r", _without("red"), sigma_m) == told


@pytest.mark.parametrize(("aside_m", "times", "told"), [(0.0, 2, ["removed"]), (0.9, 2, []), (0.0, 0.34, [])])
def test_what_is_removed_was_looked_for_as_a_whole_and_often(
    tmp_path: Path, aside_m: float, times: float, told: list[str]
) -> None:
    """Frames that see through one side of a stool tell nothing of the other, and a few may see past it."""
    with Store.create(tmp_path / "a.l3r") as store:
        stool = ROOM["stool"].center
        for room, aside, turn, repeat in ((dict(ROOM), 0.0, 1.6, 2.0), (_without("stool"), aside_m, 0.04, times)):
            with store.transaction():
                path = cameras((stool[0] + aside, *stool[1:]), 1.55 - turn / 2, turn)
                path = np.concatenate([path] * 2)[: int(repeat * len(path))]
                add_session(store, room, path)
                place_together(store)
                consolidate(store)
        assert [e.kind for e in store.events.all(2) if e.kind != "seen_again"] == told
        gone = [i for i in store.instances.all() if np.linalg.norm(i.box.center - stool) < 0.3]
        assert [i.state for i in gone] == (told or ["unseen"])


@pytest.mark.parametrize(
    ("kind", "there", "told"),
    [("metric", True, ["removed"]), ("relative", True, []), ("relative", False, ["removed"])],
)
def test_computed_depth_that_is_a_little_off_does_not_see_through_things(
    tmp_path: Path, kind: str, there: bool, told: list[str]
) -> None:
    """A second session of which depth is 4 % too large does not find the stool, whether it stands there or not."""
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        path = np.concatenate([cameras(ROOM["stool"].center, 0.8)] * 2)
        add_session(store, dict(ROOM), path)
        seen, found = (
            simulated_chunk(room, path) for room in (ROOM if there else _without("stool"), _without("stool"))
        )
        far = tuple(replace(k, depth_small=1.04 * k.depth_small) for k in seen.keyframes)
        session = store.sessions.add("simulated", "1", {}, len(path))
        store.chunks.add(session, replace(found, keyframes=far, scale_kind=kind))
        place_together(store)
        consolidate(store)
        assert [e.kind for e in store.events.all(2) if e.kind != "seen_again"] == told


def _without(name: str) -> dict[str, Box]:
    return {k: b for k, b in ROOM.items() if k != name}


LOW = Box((0.05, -0.15, 0.78), (0.24, 0.16, 0.08), ROOM["green"].rgb)
"""Stands where the green box stood and looks like it, but is lower and wider."""


def test_what_stays_is_seen_through_by_nobody(tmp_path: Path) -> None:
    with Store.open(_two(tmp_path / "a.l3r", dict(ROOM))) as store:
        u, v = (chunk_summaries(store)[c.chunk_id].shapes for c in store.chunks.all())
        pairs = pair_scores(u, v, Sim3.identity())
        shares = FreeSpaceCarving(store, S).shares(u, v, pairs, Sim3.identity())
        assert len(shares[0]) == len(shares[1]) == len(pairs.i) > 0
        assert max(shares[0].max(), shares[1].max()) < 0.02
        assert [e.kind for e in store.events.all(2) if e.kind != "seen_again"] == []


def test_a_thing_of_the_same_look_in_the_place_of_another_is_not_seen_again(tmp_path: Path) -> None:
    """Depth tells them apart, although colour does not."""
    with Store.open(_two(tmp_path / "a.l3r", {**_without("green"), "low": LOW})) as store:
        again = [e.from_box.center for e in store.events.all(2) if e.kind == "seen_again" and e.from_box is not None]
        assert min(float(np.linalg.norm(c - ROOM["green"].center)) for c in again) > 0.1


def test_two_that_change_places_both_move(tmp_path: Path) -> None:
    """Either stands where the other stood, so neither place is empty."""
    shapes = {"red": (0.26, 0.10, 0.14), "blue": (0.10, 0.26, 0.14)}
    place = {"red": (-0.5, 0.15, 0.81), "blue": (0.5, 0.2, 0.81)}
    before = {**ROOM, **{k: Box(place[k], shapes[k], ROOM[k].rgb) for k in shapes}}
    after = {**before, "red": Box(place["blue"], shapes["red"], ROOM["red"].rgb)}
    after["blue"] = Box(place["red"], shapes["blue"], ROOM["blue"].rgb)
    with Store.open(_two(tmp_path / "a.l3r", after, before)) as store:
        moved = [e for e in store.events.all(2) if e.kind == "moved"]
        assert [e.kind for e in store.events.all(2) if e.kind not in ("seen_again", "moved")] == []
        assert len(moved) == 2
        for event in moved:
            assert event.from_box is not None
            assert event.to_box is not None
            assert 0.9 < float(np.linalg.norm(event.to_box.center - event.from_box.center)) < 1.1


SHEET = Box((0.0, 0.25, 0.742), (0.30, 0.20, 0.004), (240, 240, 235))
"""Lies on the table, too thin for depth to tell it from that."""


def _add_pictured(store: Store, room: dict[str, Box], start: float, light: float, found: dict[str, Box]) -> None:
    """Add a session whose keyframes have pictures in some light, and of whose room only so much was found."""
    lit = {k: replace(b, rgb=tuple(int(light * c) for c in b.rgb)) for k, b in room.items()}
    poses = np.concatenate([cameras(TABLE, start), cameras(TABLE, start + 0.1)])
    chunk = simulated_chunk(lit, poses)
    colors = np.array([*(b.rgb for b in lit.values()), (0, 0, 0)], np.uint8)
    keyframes = []
    for keyframe in chunk.keyframes:
        picture = io.BytesIO()
        Image.fromarray(colors[cast(lit, keyframe.T_chunk_cam)[1]]).save(picture, "jpeg", quality=95)
        keyframes.append(replace(keyframe, jpeg=picture.getvalue()))
    known = [tuple(lit[k].rgb) for k in found if k in lit]
    kept = [i for i in chunk.library.instances if tuple(i.support.rgb[0].tolist()) in known]
    kept = [replace(i, local_id=n) for n, i in enumerate(kept)]
    session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, len(poses))
    store.chunks.add(
        session, replace(chunk, keyframes=tuple(keyframes), library=replace(chunk.library, instances=tuple(kept)))
    )


WITH_SHEET = {**ROOM, "sheet": SHEET}


@pytest.mark.parametrize("light", [1.0, 0.7])
@pytest.mark.parametrize(
    ("first", "second", "found", "told"),
    [
        (WITH_SHEET, dict(ROOM), dict(ROOM), ["removed"]),
        (dict(ROOM), WITH_SHEET, WITH_SHEET, ["added"]),
        (WITH_SHEET, WITH_SHEET, dict(ROOM), []),
    ],
)
def test_a_sheet_that_depth_cannot_tell_from_its_table_is_missed_by_its_colour(
    tmp_path: Path, first: dict[str, Box], second: dict[str, Box], found: dict[str, Box], told: list[str], light: float
) -> None:
    """But not where it only was not found: the pictures show it."""
    with Store.create(tmp_path / "a.l3r") as store:
        for room, start, bright, known in ((first, 0.4, 1.0, first), (second, 1.0, light, found)):
            with store.transaction():
                _add_pictured(store, room, start, bright, known)
                place_together(store)
                consolidate(store)
        events = [e for e in store.events.all(2) if e.kind != "seen_again"]
        assert [e.kind for e in events] == told
        assert all("another surface in its place" in e.reason for e in events)


def test_without_pictures_depth_alone_tells(tmp_path: Path) -> None:
    with Store.open(_two(tmp_path / "a.l3r", dict(ROOM), WITH_SHEET)) as store:
        assert [e.kind for e in store.events.all(2) if e.kind != "seen_again"] == []

"""Relations: what stands on what, in what, beside what; and what does not follow from where one stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.memory.core.geometry import rotation_exp
from list3r.memory.library.relations.instance_geometry import InstanceGeometry, fit_box
from list3r.memory.library.relations.predicates import INVERSE, relations
from list3r.memory.library.relations.scene import certainty
from list3r.memory.library.relations.symmetry import round_axis
from tests.memory_scenes import BOX, CHAIR, FLOOR, MAGAZINE, MUG, TABLE, TWIN, WALL, Piece, surface

LEGS = [Piece("leg", (x, y, 0.35), (0.05, 0.05, 0.7), points=150) for x in (-0.65, 0.65) for y in (-0.35, 0.35)]
SEAT = Piece("seat", (0, 1.0, 0.45), (0.45, 0.45, 0.03), points=900)
BACK = Piece("back", (0, 1.22, 0.75), (0.45, 0.03, 0.5), points=700)
CHAIR_LEGS = [Piece("leg", (x, 1 + y, 0.22), (0.03, 0.03, 0.44), points=60) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]


def body(
    id: int, *pieces: Piece, structure: str | None = None, seed: int = 0, view: float | None = 0.6
) -> InstanceGeometry:
    points = np.concatenate([surface(p, seed + 31 * id + n, view) for n, p in enumerate(pieces)]).astype(float)
    rgb = np.tile(np.uint8([200, 200, 200]), (len(points), 1))
    box = fit_box(points, upright=True)
    return InstanceGeometry(id, points, rgb, box, np.stack([points.min(axis=0), points.max(axis=0)]), None, structure)


def moved(b: InstanceGeometry, offset: tuple[float, float, float]) -> InstanceGeometry:
    points = b.points + np.asarray(offset)
    box = fit_box(points, upright=True)
    return InstanceGeometry(
        b.id, points, b.rgb, box, np.stack([points.min(axis=0), points.max(axis=0)]), None, b.structure
    )


def facts(bodies: list[InstanceGeometry], **more: object) -> set[tuple[int, str, int]]:
    found = relations(bodies, gravity_known=True, **more)  # type: ignore[arg-type]
    return {(r.subject, r.predicate, r.object) for r in found}


def kitchen(seed: int = 0) -> list[InstanceGeometry]:
    return [
        body(1, FLOOR, structure="floor", seed=seed),
        body(2, TABLE, *LEGS, seed=seed),
        body(3, MUG, seed=seed),
        body(4, TWIN, seed=seed),
        body(5, BOX, seed=seed),
        body(6, MAGAZINE, seed=seed),
        body(7, SEAT, BACK, *CHAIR_LEGS, seed=seed),
        body(8, WALL, structure="wall", seed=seed, view=-1.5),
    ]


@pytest.mark.parametrize("seed", range(4))
def test_small_things_stand_on_the_table_and_furniture_on_the_floor(seed: int) -> None:
    on = {(s, o) for s, p, o in facts(kitchen(seed)) if p == "on"}
    assert on == {(3, 2), (4, 2), (5, 2), (6, 2), (2, 1), (7, 1)}


@pytest.mark.parametrize("drift", [-0.02, -0.01, 0.01, 0.03])
def test_contact_survives_heights_that_are_off(drift: float) -> None:
    bodies = kitchen()
    shifted = [moved(b, (0, 0, drift)) if b.id in (3, 4, 5, 6) else b for b in bodies]
    assert {(3, 2), (4, 2), (5, 2), (6, 2)} <= {(s, o) for s, p, o in facts(shifted) if p == "on"}


def test_what_floats_or_stands_beside_is_not_on() -> None:
    table = body(2, TABLE, *LEGS)
    assert (3, "on", 2) not in facts([table, moved(body(3, MUG), (0, 0, 0.15))])
    assert (3, "above", 2) in facts([table, moved(body(3, MUG), (0, 0, 0.15))])
    assert (3, "on", 2) not in facts([table, moved(body(3, MUG), (0.9, 0, 0))])


def test_a_thing_on_a_seat_is_on_the_chair_though_its_back_is_higher() -> None:
    chair = body(7, SEAT, BACK, *CHAIR_LEGS)
    cushion = body(9, Piece("cushion", (0, 0.98, 0.5), (0.35, 0.35, 0.07), points=600))
    assert (9, "on", 7) in facts([chair, cushion])


def test_a_stack_stands_on_what_is_just_below() -> None:
    table = body(2, TABLE, *LEGS)
    lower = body(5, BOX)
    upper = moved(body(3, MUG), (-0.5, -0.3, 0.16))
    found = facts([table, lower, upper])
    assert (5, "on", 2) in found and (3, "on", 5) in found and (3, "on", 2) not in found


def test_a_mug_beside_a_magazine_is_on_the_table() -> None:
    table, magazine = body(2, TABLE, *LEGS), body(6, MAGAZINE)
    for dx in (-0.10, -0.12, -0.15):
        mug = moved(body(3, MUG), (0.1 + dx, -0.35, 0.0))
        assert (3, "on", 2) in facts([table, magazine, mug])


def test_each_thing_is_on_at_most_one() -> None:
    subjects = [s for s, p, _ in facts(kitchen()) if p == "on"]
    assert len(subjects) == len(set(subjects))


def test_a_thing_in_a_box_is_in_it_and_not_on_it() -> None:
    walls = [
        Piece("side", (x, y, 0.8), (0.02 if x else 0.4, 0.02 if y else 0.4, 0.16), points=300)
        for x, y in ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2))
    ]
    bottom = Piece("bottom", (0, 0, 0.725), (0.4, 0.4, 0.01), points=500)
    crate = body(2, *walls, bottom, view=None)
    ball = body(3, Piece("ball", (0.02, 0.0, 0.775), (0.1, 0.1, 0.09), round=True, points=300))
    found = facts([crate, ball])
    assert (3, "in", 2) in found and (2, "contains", 3) in found and (3, "on", 2) not in found


def test_a_stool_pushed_under_the_table_is_under_it() -> None:
    stool = body(3, Piece("stool", (0.1, 0, 0.2), (0.35, 0.35, 0.4), points=700))
    found = facts([body(2, TABLE, *LEGS), stool])
    assert (3, "under", 2) in found and (2, "on", 3) not in found


def test_a_picture_hangs_on_the_wall() -> None:
    wall = body(8, WALL, structure="wall", view=-1.5)
    picture = body(3, Piece("picture", (0.5, 1.97, 1.5), (0.5, 0.02, 0.4), points=500), view=-1.5)
    assert (3, "attached_to", 8) in facts([wall, picture])


def test_a_table_whose_legs_were_not_seen_stands_on_the_floor_and_a_shelf_on_the_wall_does_not() -> None:
    floor, wall = body(1, FLOOR, structure="floor"), body(8, WALL, structure="wall", view=-1.5)
    table = body(2, Piece("table", (0, 0, 0.5), (1.4, 0.8, 0.44), points=3000))
    shelf = body(3, Piece("shelf", (0, 1.9, 0.5), (0.8, 0.2, 0.5), points=900))
    lamp = body(4, Piece("lamp", (1.0, 0, 1.8), (0.3, 0.3, 0.3), points=500))
    found = facts([floor, wall, table, shelf, lamp])
    assert {(s, o) for s, p, o in found if p == "on"} == {(2, 1)}
    assert (3, "attached_to", 8) in found


def test_neighbours_are_next_to_each_other_and_near() -> None:
    found = facts([body(2, CHAIR), moved(body(3, CHAIR), (0.7, 0, 0)), moved(body(4, CHAIR), (4.0, 0, 0))])
    assert {(2, "next_to", 3), (3, "next_to", 2), (2, "near", 3), (3, "near", 2)} <= found
    assert not any(4 in (s, o) for s, _, o in found)


def test_inverses_come_together_with_the_same_numbers() -> None:
    found = relations(kitchen(), gravity_known=True)
    table = {(r.subject, r.predicate, r.object): r for r in found}
    assert len(table) == len(found)
    for r in found:
        if r.predicate in INVERSE:
            other = table[(r.object, INVERSE[r.predicate], r.subject)]
            assert (other.confidence, other.margin) == (r.confidence, r.margin)
        assert 0.0 <= r.confidence <= 1.0 and r.margin >= 0.0


def test_without_gravity_there_are_no_vertical_relations() -> None:
    found = relations(kitchen(), gravity_known=False)
    assert {r.predicate for r in found} == {"near", "next_to"}


@given(st.floats(-np.pi, np.pi), st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3, 3)))
@settings(max_examples=8, deadline=None)
def test_relations_do_not_change_when_the_world_is_turned_about_the_vertical_and_shifted(
    yaw: float, offset: tuple[float, float, float]
) -> None:
    rotation = rotation_exp(np.array([0, 0, yaw]))
    turned = []
    for b in kitchen():
        points = b.points @ rotation.T + np.asarray(offset)
        box = fit_box(points, upright=True)
        turned.append(
            InstanceGeometry(
                b.id, points, b.rgb, box, np.stack([points.min(axis=0), points.max(axis=0)]), None, b.structure
            )
        )
    assert facts(turned) == facts(kitchen())


@pytest.mark.parametrize("scale", [0.1, 8.0])
def test_relations_scale_with_the_unit_of_a_relative_memory(scale: float) -> None:
    scaled = []
    for b in kitchen():
        points = b.points * scale
        box = fit_box(points, upright=True)
        scaled.append(
            InstanceGeometry(
                b.id, points, b.rgb, box, np.stack([points.min(axis=0), points.max(axis=0)]), None, b.structure
            )
        )
    assert facts(scaled, unit=scale) == facts(kitchen())


def test_parts_of_different_frames_of_reference_have_no_relations() -> None:
    a, b = body(2, CHAIR), moved(body(3, CHAIR), (0.6, 0, 0))
    apart = InstanceGeometry(3, b.points, b.rgb, b.box, b.aabb, None, None, component=5)
    assert relations([a, apart], gravity_known=True) == []


def test_no_bodies_no_relations() -> None:
    assert relations([], gravity_known=True) == []


def shell(id: int, radius: float, height: float, arc: tuple[float, float], noise: float = 0.003) -> InstanceGeometry:
    """The wall of an open basket between two azimuths, as it is seen from one side, and its bottom."""
    rng = np.random.default_rng(id)
    angle, z = rng.uniform(*arc, 600), rng.uniform(0, height, 600)
    wall = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    flat = rng.uniform(-radius, radius, (200, 2)) * 0.6
    points = np.concatenate([wall, np.column_stack([flat, np.zeros(200)])]) + rng.normal(0, noise, (800, 3))
    box = fit_box(points, upright=True)
    aabb = np.stack([points.min(axis=0), points.max(axis=0)])
    return InstanceGeometry(id, points, np.full((800, 3), 180, np.uint8), box, aabb, None)


@pytest.mark.parametrize("arc", [(0.0, 2 * np.pi), (0.2, 3.3)])
def test_a_ball_is_in_a_basket_of_which_only_the_far_half_is_seen(arc: tuple[float, float]) -> None:
    ball = body(3, Piece("ball", (0, 0, 0.18), (0.24, 0.24, 0.26), round=True, points=400))
    found = facts([body(1, FLOOR, structure="floor"), shell(2, 0.2, 0.26, arc), ball])
    assert {(3, "in", 2), (2, "contains", 3), (2, "on", 1)} <= found
    assert not any(p == "next_to" or (s, p) == (3, "on") for s, p, _ in found)


def test_a_ball_beside_or_before_a_basket_is_not_in_it() -> None:
    for x, y in ((0.36, 0.0), (0.0, 0.36)):
        ball = body(3, Piece("ball", (x, y, 0.1), (0.2, 0.2, 0.2), round=True, points=400))
        assert not any(p == "in" for _, p, _ in facts([shell(2, 0.2, 0.26, (0.0, 2 * np.pi)), ball]))


def test_what_stands_between_the_boards_of_a_shelf_is_in_it_and_what_stands_on_top_is_not() -> None:
    boards = [Piece("board", (0, 0, z), (0.8, 0.3, 0.03), points=500) for z in (0.1, 0.6, 1.1, 1.6)]
    shelf = body(2, *boards, Piece("back", (0, -0.14, 0.85), (0.8, 0.02, 1.5), points=900))
    vase = body(3, Piece("vase", (0.2, 0.02, 0.75), (0.14, 0.14, 0.25), round=True, points=400))
    bowl = body(4, Piece("bowl", (-0.2, 0.02, 1.68), (0.2, 0.2, 0.1), round=True, points=400))
    found = facts([body(1, FLOOR, structure="floor"), shelf, vase, bowl])
    assert (3, "in", 2) in found and (4, "on", 2) in found and (4, "in", 2) not in found


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_a_book_in_a_shelf_is_in_it_also_where_one_point_is_left_of_the_board_above(share: float) -> None:
    boards = [Piece("board", (0, 0, z), (0.8, 0.3, 0.03), points=500) for z in (0.1, 1.1)]
    shelf = body(2, *boards, Piece("back", (0, -0.14, 0.85), (0.8, 0.02, 1.5), points=900))
    above = (np.abs(shelf.points[:, 0] - 0.2) < 0.2) & (np.abs(shelf.points[:, 1]) < 0.13) & (shelf.points[:, 2] > 0.6)
    kept = ~above
    kept[np.flatnonzero(above)[np.argmin(np.linalg.norm(shelf.points[above, :2] - (0.2, 0.0), axis=1))]] = share > 0
    few = replace(shelf, points=shelf.points[kept], rgb=shelf.rgb[kept])
    book = body(3, Piece("book", (0.2, 0.0, 0.24), (0.14, 0.14, 0.25), points=400))
    found = facts([body(1, FLOOR, structure="floor"), few, book])
    assert ((3, "in", 2) in found) == (share > 0)


def test_a_gap_is_not_made_wider_by_the_sides_that_are_hidden() -> None:
    left = body(2, Piece("left", (0, 0, 0.1), (0.2, 0.2, 0.2), points=600), view=np.pi)
    right = body(3, Piece("right", (0.28, 0, 0.1), (0.2, 0.2, 0.2), points=600), view=0.0)
    assert (2, "next_to", 3) in facts([left, right])


def test_a_shade_whose_thin_foot_was_not_seen_stands_on_what_is_under_it() -> None:
    table = body(2, TABLE, *LEGS)
    top = float(table.points[:, 2].max())
    shade = body(3, Piece("shade", (0.1, 0.1, top + 0.18), (0.22, 0.22, 0.17), round=True, points=400))
    assert (3, "on", 2) in facts([body(1, FLOOR, structure="floor"), table, shade])


def test_a_rug_is_next_to_nothing_but_a_magazine_on_the_table_is() -> None:
    rug = body(9, Piece("rug", (1.2, 1.0, 0.008), (1.2, 1.4, 0.012), points=1500))
    found = facts([*kitchen(), rug])
    assert (9, "on", 1) in found and not any(p == "next_to" and 9 in (s, o) for s, p, o in found)
    beside = moved(body(6, MAGAZINE), (0.0, 0.0, 0.0))
    low, high = beside.aabb
    mug = body(3, Piece("mug", (high[0] + 0.08, (low[1] + high[1]) / 2, low[2] + 0.05), (0.08, 0.08, 0.1), round=True))
    assert (3, "next_to", 6) in facts([beside, mug])


@pytest.mark.parametrize("seed", range(4))
def test_a_pillow_against_the_headboard_is_on_the_bed(seed: int) -> None:
    mattress = Piece("mattress", (0, 0, 0.28), (1.4, 2.0, 0.38), points=2500)
    headboard = Piece("headboard", (0, -1.02, 0.5), (1.4, 0.06, 0.95), points=1500)
    pillow = Piece("pillow", (0.2, -0.8, 0.53), (0.6, 0.38, 0.12), points=400)
    found = facts([body(1, FLOOR, structure="floor"), body(2, mattress, headboard, seed=seed), body(3, pillow)])
    assert (3, "on", 2) in found
    assert not {p for s, p, o in found if (s, o) == (3, 2)} & {"in"}


def test_a_ball_of_which_only_the_top_looks_out_of_a_bowl_is_in_it() -> None:
    rng = np.random.default_rng(3)
    bowl = rng.normal(size=(1500, 3))
    bowl = 0.14 * bowl / np.linalg.norm(bowl, axis=1, keepdims=True) * [1, 1, 1] + [0, 1.0, 0.89]
    bowl = bowl[(bowl[:, 2] < 0.88) & (rng.random(len(bowl)) < np.where(bowl[:, 1] > 1.0, 1.0, 0.3))]
    ball = rng.normal(size=(900, 3))
    ball = 0.06 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.01, 1.0, 0.84]
    ball = ball[ball[:, 2] > 0.83]
    parts = []
    for id, points in ((2, bowl), (3, ball)):
        rgb = np.tile(np.uint8([90, 90, 200]), (len(points), 1))
        corners = np.stack([points.min(axis=0), points.max(axis=0)])
        parts.append(InstanceGeometry(id, points, rgb, fit_box(points, upright=True), corners, None, None))
    assert (3, "in", 2) in facts(parts)


def sofa() -> list[Piece]:
    return [
        Piece("seat", (0, 0, 0.3), (1.4, 0.85, 0.26), points=1500),
        Piece("back", (0, -0.32, 0.6), (1.8, 0.22, 0.4), points=900),
        *(Piece("arm", (x, 0, 0.4), (0.18, 0.85, 0.4), points=700) for x in (-0.81, 0.81)),
    ]


@pytest.mark.parametrize("x", [-0.5, 0.0, 0.45])
def test_a_cushion_between_the_arms_of_a_sofa_is_on_it(x: float) -> None:
    cushion = body(3, Piece("cushion", (x, -0.1, 0.61), (0.42, 0.16, 0.36), points=600))
    found = facts([body(1, FLOOR, structure="floor"), body(2, *sofa(), view=np.pi / 2), cushion])
    assert (3, "on", 2) in found and (3, "in", 2) not in found


def test_a_ball_on_a_flat_box_is_not_in_it() -> None:
    ball = body(3, Piece("ball", (0, 0, 0.26), (0.12, 0.12, 0.12), round=True, points=400))
    found = facts([body(2, Piece("carton", (0, 0, 0.1), (0.25, 0.25, 0.2), points=900)), ball])
    assert (3, "on", 2) in found and (3, "in", 2) not in found


def test_a_bowl_beside_a_box_that_was_taken_for_part_of_the_cabinet_is_on_the_cabinet() -> None:
    cabinet = [
        Piece("cabinet", (0, 0, 0.4), (0.9, 0.42, 0.8), points=1500),
        Piece("box", (-0.2, 0, 0.89), (0.24, 0.3, 0.18), points=300),
    ]
    bowl = body(3, Piece("bowl", (0.1, 0, 0.86), (0.24, 0.24, 0.1), round=True, points=500))
    found = facts([body(1, FLOOR, structure="floor"), body(2, *cabinet), bowl])
    assert (3, "on", 2) in found and (3, "in", 2) not in found


def gap_of(*bodies: InstanceGeometry) -> float:
    """The gap that `near` was said with."""
    limit = float(np.clip(0.25 * (bodies[0].size + bodies[1].size), 0.15, 0.4))
    return limit - next(r.margin for r in relations(list(bodies), gravity_known=True) if r.predicate == "near")


@pytest.mark.parametrize("points", [150, 600, 4000])
def test_a_gap_does_not_depend_on_how_densely_the_surfaces_were_seen(points: int) -> None:
    left = body(2, Piece("left", (0, 0, 0.2), (0.4, 0.4, 0.4), points=points), view=0.6)
    right = body(3, Piece("right", (0.55, 0, 0.2), (0.4, 0.4, 0.4), points=points), view=0.6)
    assert gap_of(left, right) == pytest.approx(0.15, abs=0.02)


def test_readings_amidst_the_edge_between_two_things_do_not_bring_them_nearer() -> None:
    left = body(2, Piece("left", (0, 0, 0.1), (0.2, 0.2, 0.2), points=600))
    right = body(3, Piece("right", (0.32, 0, 0.1), (0.2, 0.2, 0.2), points=600))
    stray = np.column_stack([np.linspace(0.12, 0.2, 4), np.zeros(4), np.linspace(0.05, 0.2, 4)])
    points = np.concatenate([left.points, stray])
    rgb = np.tile(np.uint8([200, 200, 200]), (len(points), 1))
    frayed = InstanceGeometry(2, points, rgb, left.box, left.aabb, None)
    assert gap_of(frayed, right) == pytest.approx(gap_of(left, right), abs=0.005)


def front(radius: float, height: float, view: float, *, ball: bool, seed: int = 5) -> np.ndarray:
    """What is seen of a ball, or of a pipe, about the origin from an azimuth and from above. Shape (N, 3)."""
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(1500, 3))
    away[:, 2] *= ball
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    seen = away[away @ np.array([np.cos(view), np.sin(view), 0.8]) > 0.15][:400]
    points = radius * seen + rng.normal(0, 0.003, (len(seen), 3))
    points[:, 2] += radius if ball else rng.uniform(0, height, len(seen))
    return points


def made_of(id: int, points: np.ndarray) -> InstanceGeometry:
    rgb = np.tile(np.uint8([90, 90, 200]), (len(points), 1))
    corners = np.stack([points.min(axis=0), points.max(axis=0)])
    return InstanceGeometry(id, points, rgb, fit_box(points, upright=True), corners, None)


@pytest.mark.parametrize("view", [0.3, 2.0, 4.5])
def test_the_backs_of_round_things_are_told_by_their_fronts(view: float) -> None:
    behind = np.array([-0.24 * np.cos(view), -0.24 * np.sin(view), 0.0])
    pipe, ball = front(0.07, 0.24, view, ball=False), front(0.08, 0.0, view, ball=True) + behind
    assert gap_of(made_of(2, pipe), made_of(3, ball)) == pytest.approx(0.24 - 0.07 - 0.08, abs=0.015)


def test_only_what_is_round_has_an_axis() -> None:
    for ball in (True, False):
        found = round_axis(front(0.08, 0.2, 1.0, ball=ball) + np.array([1.0, 2.0, 3.0]), 0.015)
        assert found is not None and np.linalg.norm(found - [1.0, 2.0]) < 0.01
    for other in (body(3, BOX), body(4, CHAIR), body(5, TABLE, *LEGS), body(6, MAGAZINE), body(7, WALL)):
        assert round_axis(other.points, 0.015) is None
    assert round_axis(np.zeros((60, 3)), 0.015) is None
    assert round_axis(np.column_stack([np.zeros((60, 2)), np.linspace(0, 1, 60)]), 0.015) is None


def test_what_is_measured_at_the_bound_is_not_said() -> None:
    def at(gap: float) -> list[InstanceGeometry]:
        return [
            body(2, Piece("left", (0, 0, 0.2), (0.4, 0.4, 0.4), points=3000)),
            body(3, Piece("right", (0.4 + gap, 0, 0.2), (0.4, 0.4, 0.4), points=3000)),
        ]

    said = [
        [r for r in relations(at(gap), gravity_known=True) if r.predicate == "next_to"] for gap in (0.16, 0.2, 0.24)
    ]
    assert len(said[0]) == 2 and all(r.confidence >= 0.6 for r in said[0]) and not said[2]
    assert not [r for r in said[1] if r.confidence < 0.6]


def test_what_shares_no_height_is_near_and_not_next_to() -> None:
    low = Piece("low", (0, 0, 0.15), (0.3, 0.3, 0.3), points=1200)
    high = Piece("high", (0.34, 0, 0.55), (0.3, 0.3, 0.3), points=1200)
    level = Piece("level", (0.34, 0, 0.15), (0.3, 0.3, 0.3), points=1200)
    apart = {p for s, p, o in facts([body(1, low, view=None), body(2, high, view=None)]) if (s, o) == (1, 2)}
    beside = {p for s, p, o in facts([body(1, low, view=None), body(2, level, view=None)]) if (s, o) == (1, 2)}
    assert "near" in apart and "next_to" not in apart
    assert {"near", "next_to"} <= beside


def test_what_lies_metres_beyond_a_boundary_is_sure_not_to_hold() -> None:
    assert certainty(-6.5, 0.015) < 1e-300 < certainty(0.0, 0.015) == 0.5 < certainty(6.5, 0.015) == 1.0

"""The simulated world, camera, renderer and sensor: what they claim to be true is true."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.simulation.changes import Change, apply_changes, random_changes
from list3r.frames.base import Camera
from list3r.memory.core.errors import OptionError
from list3r.simulation.rendering.render import RenderedFrame, Renderer
from list3r.simulation.rendering.sensor import SensorSettings, sense
from list3r.simulation.walk import PathSettings, camera_path, viewing_poses
from list3r.simulation.worlds.materials import Material, bake
from list3r.simulation.worlds.objects import BOX, CYLINDER, SPHERE, Part, SimulatedObject
from list3r.simulation.worlds.truth import footprint_gap, true_relations, world_truth
from list3r.simulation.worlds.world import SimulatedWorld, make_world

CAMERA = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
SEEDS = [0, 1, 2, 3]


@pytest.fixture(scope="module", params=[0, 3])
def world(request: pytest.FixtureRequest) -> SimulatedWorld:
    return make_world(request.param)


def rays() -> np.ndarray:
    """Directions of the pixels with z = 1. Shape (H, W, 3)."""
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    y = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)


# ----------------------------------------------------------------------------------------------- world


def test_a_seed_makes_one_world() -> None:
    assert make_world(5) == make_world(5)
    assert make_world(5) != make_world(6)


@pytest.mark.parametrize("seed", SEEDS)
def test_things_stand_on_what_they_are_said_to_stand_on(seed: int) -> None:
    world = make_world(seed)
    for obj in world.objects:
        if obj.support is None or obj.container is not None:
            continue
        box, base = obj.box(), world.object_of(obj.support).box()
        bottom, top = box.center[2] - box.size[2] / 2, base.center[2] + base.size[2] / 2
        assert bottom <= top + 1e-6, obj.label
        offset = np.abs((box.center - base.center) @ base.rotation)
        assert np.all(offset[:2] <= base.size[:2] / 2), obj.label
        if obj.label not in ("cushion", "pillow"):
            assert bottom == pytest.approx(top, abs=1e-6), obj.label


@pytest.mark.parametrize("seed", SEEDS)
def test_small_things_keep_apart_and_are_not_tiny(seed: int) -> None:
    world = make_world(seed)
    small = [t for t in world.objects if t.label in ("mug", "box", "book", "ball", "bowl", "vase") and not t.container]
    assert len(small) >= 14
    for k, a in enumerate(small):
        assert a.box().size.max() > 0.08
        for b in small[:k]:
            assert a.support != b.support or footprint_gap(a.box(), b.box()) > 0.0


@pytest.mark.parametrize("seed", SEEDS)
def test_big_things_stay_within_their_walls(seed: int) -> None:
    world = make_world(seed)
    for obj in world.objects:
        if obj.structure is None:
            corners = obj.box().corners()
            room = next(r for r in world.rooms if r.x0 <= corners[:, 0].mean() <= r.x1)
            assert corners[:, 0].min() > room.x0 - 0.02 and corners[:, 0].max() < room.x1 + 0.02, obj.label
            assert corners[:, 1].min() > -0.02 and corners[:, 1].max() < room.depth + 0.02, obj.label
            assert corners[:, 2].min() > -1e-6


def test_relations_are_consistent(world: SimulatedWorld) -> None:
    triples = true_relations(world)
    assert len(triples) == len(set(triples))
    beside = {(s, o) for s, p, o in triples if p == "next_to"}
    assert beside and all((o, s) in beside for s, o in beside)
    labels = {t.id: t.label for t in world.objects}
    assert any(labels[s] == "mug" and labels[o] == "table" for s, p, o in triples if p == "on")
    assert any(labels[s] == "ball" and labels[o] in ("bowl", "basket") for s, p, o in triples if p == "in")


# ----------------------------------------------------------------------------------------------- walk


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("fps", [12.0, 30.0])
def test_the_walk_keeps_to_human_speed_and_comes_back(seed: int, fps: float) -> None:
    world = make_world(seed)
    time_s, poses = camera_path(world.tour, None, PathSettings(fps=fps), seed)
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * fps
    turn = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    angle = np.rad2deg(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))) * fps
    assert step.max() <= 0.6
    assert angle.max() <= 40
    assert np.allclose(np.diff(time_s), 1 / fps)
    assert np.linalg.norm(poses[0, :3, 3] - poses[-1, :3, 3]) < 0.5
    rooms = [np.mean((poses[:, 0, 3] > r.x0) & (poses[:, 0, 3] < r.x1)) for r in world.rooms]
    assert min(rooms) > 0.25
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_fewer_frames_cut_the_walk_and_more_slow_it() -> None:
    tour, settings = make_world(0).tour, PathSettings(sway_m=0, sway_deg=0)
    whole = camera_path(tour, None, settings)[1]
    assert np.allclose(camera_path(tour, 50, settings)[1], whole[:50])
    slow = camera_path(tour, 2 * len(whole), settings)[1]
    assert np.allclose(slow[-1], whole[-1], atol=1e-2)


# ----------------------------------------------------------------------------------------------- renderer


@pytest.mark.slow
def test_every_point_lies_in_the_box_of_its_thing(world: SimulatedWorld) -> None:
    renderer = Renderer(world, CAMERA)
    boxes = {t.id: t.box() for t in world.objects}
    _, poses = camera_path(world.tour, None, PathSettings())
    seen = set()
    for pose in poses[::29]:
        frame = renderer.render(pose)
        assert np.all(frame.ids > 0), "the rooms are closed"
        points = (rays() * frame.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        for object_id in np.unique(frame.ids):
            box = boxes[int(object_id)]
            local = np.abs((points[frame.ids == object_id] - box.center) @ box.rotation)
            assert np.all(local <= box.size / 2 + 1e-3), world.object_of(int(object_id)).label
        seen |= set(np.unique(frame.ids).tolist())
    assert len(seen) > 40


def single(part: Part) -> SimulatedWorld:
    """A world of one thing at the origin."""
    room = make_world(0).rooms[0]
    return SimulatedWorld(0, (room,), (SimulatedObject(1, "thing", (part,), (0.0, 0.0, 0.0)),), ())


def view(eye: tuple[float, float, float], yaw_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    angles = [np.array([np.deg2rad(a)]) for a in (yaw_deg, pitch_deg, 0.0)]
    return viewing_poses(np.array([eye]), *angles)[0]


GREY = Material("plain", (120, 120, 120), (140, 140, 140))


def test_a_box_has_its_depth_and_outline() -> None:
    frame = Renderer(single(Part(BOX, (0, 0, 0), (0.5, 0.3, 0.2), GREY)), CAMERA).render(view((-2.5, 0, 0), 0))
    assert frame.depth[60, 80] == pytest.approx(2.0, abs=1e-5)
    rows, columns = np.nonzero(frame.ids)
    assert columns.max() - columns.min() + 1 == pytest.approx(0.6 * CAMERA.fx / 2.0, abs=1.01)
    assert rows.max() - rows.min() + 1 == pytest.approx(0.4 * CAMERA.fy / 2.0, abs=1.01)
    assert frame.depth[0, 0] == 0
    assert frame.ids[0, 0] == 0


def test_round_things_lie_on_their_surfaces() -> None:
    pose = view((-1.5, 0.2, 0.9), -8, -30)
    for kind, half in ((SPHERE, (0.3, 0.3, 0.3)), (CYLINDER, (0.3, 0.3, 0.25))):
        frame = Renderer(single(Part(kind, (0, 0, 0), half, GREY)), CAMERA).render(pose)
        hit = frame.ids > 0
        assert hit.sum() > 300
        p = ((rays() * frame.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3])[hit]
        if kind == SPHERE:
            assert np.allclose(np.linalg.norm(p, axis=1), 0.3, atol=1e-4)
        else:
            wall = np.abs(np.hypot(p[:, 0], p[:, 1]) - 0.3) < 1e-4
            assert np.all(wall | (np.abs(np.abs(p[:, 2]) - 0.25) < 1e-4))
            assert wall.any() and not wall.all()


def test_an_open_cylinder_shows_its_inside() -> None:
    part = Part(CYLINDER, (0, 0, 0), (0.3, 0.3, 0.25), GREY, open_top=True)
    pose = view((0, 0, 1.5), 0, -89.9)
    frame = Renderer(single(part), CAMERA).render(pose)
    assert frame.depth[60, 80] == pytest.approx(1.75, abs=0.01)


def test_the_nearer_thing_hides_the_farther_whatever_the_order() -> None:
    near = SimulatedObject(1, "near", (Part(BOX, (-1, 0, 0), (0.1, 0.1, 0.1), GREY),), (0.0, 0.0, 0.0))
    far = SimulatedObject(2, "far", (Part(BOX, (1, 0, 0), (0.1, 3, 3), GREY),), (0.0, 0.0, 0.0))
    room = make_world(0).rooms[0]
    for objects in ((near, far), (far, near)):
        frame = Renderer(SimulatedWorld(0, (room,), objects, ()), CAMERA).render(view((-3, 0, 0), 0))
        assert frame.ids[60, 80] == 1
        assert frame.ids[10, 10] == 2


@pytest.mark.slow
def test_surfaces_have_texture_to_hold_on_to(world: SimulatedWorld) -> None:
    _, poses = camera_path(world.tour, None, PathSettings())
    renderer = Renderer(world, CAMERA)
    for pose in poses[::60]:
        grey = renderer.render(pose).color.mean(axis=2)
        blocks = grey.reshape(6, 20, 8, 20).std(axis=(1, 3))
        assert np.quantile(blocks, 0.1) > 1.5


def test_a_texture_repeats_without_a_seam() -> None:
    tile = bake(Material("plaster", (200, 200, 200), (150, 150, 150)))
    seam = np.abs(tile[0] - tile[-1]).mean()
    inside = np.abs(np.diff(tile, axis=0)).mean()
    assert seam < 2 * inside


# ----------------------------------------------------------------------------------------------- sensor


def wall_frame(depth: float, size: int = 200) -> RenderedFrame:
    flat = np.full((size, size), depth, np.float32)
    return RenderedFrame(
        np.full((size, size, 3), 128, np.float32), flat, np.ones((size, size), np.int32), np.ones_like(flat)
    )


@pytest.mark.parametrize("depth", [0.8, 1.5, 3.0])
def test_depth_noise_has_the_stated_deviation(depth: float) -> None:
    settings = SensorSettings()
    z = sense(wall_frame(depth), settings, 0, 0, 0.0).depth
    z = z[z > 0]
    step = settings.disparity_step_per_m * depth**2
    wanted = np.hypot(settings.depth_sigma_m + settings.depth_sigma_per_m * depth**2, step / np.sqrt(12))
    assert z.std() == pytest.approx(wanted, rel=0.1)
    assert z.mean() == pytest.approx(depth, abs=step / 2)
    assert len(z) / 200**2 == pytest.approx(1 - settings.dropout, abs=2e-3)
    levels = np.unique(np.round(1 / z.astype(np.float64) / settings.disparity_step_per_m, 3))
    assert np.allclose(levels, np.rint(levels), atol=0.02)


def test_nothing_is_read_out_of_range_or_at_grazing_rays() -> None:
    for depth in (0.2, 6.0):
        assert not sense(wall_frame(depth), SensorSettings(), 0, 0, 0.0).depth.any()
    frame = wall_frame(1.0)
    grazing = RenderedFrame(frame.color, frame.depth, frame.ids, np.full_like(frame.depth, 0.05))
    assert not sense(grazing, SensorSettings(), 0, 0, 0.0).depth.any()


def test_edges_lose_readings_and_flat_parts_do_not() -> None:
    frame = wall_frame(1.0)
    frame.depth[:, 100:] = 1.5
    lost = sense(frame, SensorSettings(dropout=0.0), 0, 0, 0.0).depth == 0
    assert lost[:, 98:102].mean() > 0.1
    assert not lost[:, :95].any()


def test_noise_is_the_same_for_the_same_seed_and_frame() -> None:
    frame = wall_frame(1.0)
    one, two = sense(frame, SensorSettings(), 3, 7, 0.5), sense(frame, SensorSettings(), 3, 7, 0.5)
    other = sense(frame, SensorSettings(), 3, 8, 0.5)
    assert np.array_equal(one.color, two.color) and np.array_equal(one.depth, two.depth)
    assert not np.array_equal(one.depth, other.depth)
    clean = sense(frame, SensorSettings(noise=False), 3, 7, 0.5)
    assert np.array_equal(clean.depth, frame.depth)


# ----------------------------------------------------------------------------------------------- changes


@pytest.mark.parametrize("seed", SEEDS)
def test_changes_move_remove_and_add_what_they_say(seed: int) -> None:
    world = make_world(seed)
    changes = random_changes(world, seed, moved=2, removed=1, added=1)
    after = apply_changes(world, changes)
    assert after == apply_changes(world, random_changes(world, seed, moved=2, removed=1, added=1))
    before_ids, after_ids = {t.id for t in world.objects}, {t.id for t in after.objects}
    removed = {c.obj for c in changes if c.kind == "removed"}
    assert before_ids - after_ids == removed
    assert len(after_ids - before_ids) == 1
    for change in changes:
        if change.kind == "moved":
            assert change.obj is not None
            old, new = world.object_of(change.obj), after.object_of(change.obj)
            assert new.parts == old.parts
            assert new.support == change.target != old.support
    same = before_ids & after_ids - {c.obj for c in changes}
    assert all(world.object_of(k) == after.object_of(k) for k in same)


def test_what_a_bowl_holds_moves_with_it() -> None:
    world = make_world(0)
    bowl = next(t for t in world.objects if t.label == "bowl" and any(x.container == t.id for x in world.objects))
    ball = next(t for t in world.objects if t.container == bowl.id)
    other = next(
        t for t in world.objects if t.label == "box" and t.support not in (bowl.support, None) and not t.container
    )
    assert other.support is not None
    roomy = apply_changes(world, (Change("removed", other.id),))
    after = apply_changes(roomy, (Change("moved", bowl.id, other.support, seed=1),))
    offset = np.array(ball.position) - np.array(bowl.position)
    assert np.allclose(
        np.array(after.object_of(ball.id).position) - np.array(after.object_of(bowl.id).position), offset
    )
    gone = apply_changes(world, (Change("removed", bowl.id),))
    assert ball.id not in {t.id for t in gone.objects}


def test_changes_that_make_no_sense_are_named() -> None:
    world = make_world(0)
    with pytest.raises(OptionError, match="moved, removed or added"):
        Change("painted", 3)
    with pytest.raises(OptionError, match="999"):
        apply_changes(world, (Change("removed", 999),))
    with pytest.raises(OptionError, match="target"):
        apply_changes(world, (Change("moved", 14),))
    with pytest.raises(OptionError, match="cannot add"):
        Change("added", None, 13, "piano")
    with pytest.raises(OptionError, match="only"):
        random_changes(world, 0, moved=100)


def test_the_truth_names_boxes_and_what_was_seen(world: SimulatedWorld) -> None:
    truth = world_truth(world, {13: {"frames": 4, "largest_px": 99}})
    entries = {e["id"]: e for e in truth["instances"]}
    assert len(entries) == len(world.objects)
    assert entries[13]["largest_px"] == 99
    assert np.allclose(entries[13]["box"]["size"], world.object_of(13).box().size, atol=1e-6)
    assert all(r["subject"] in entries and r["object"] in entries for r in truth["relations"])

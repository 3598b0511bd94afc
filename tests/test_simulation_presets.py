"""Videos by preset: the way is one that a person could film, and what is said to be true of it is true."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulation.casting import Caster
from benchmarks.simulation.covisibility import covisibility, seen_share
from benchmarks.simulation.presets import make_shot, make_video, preset_camera, preset_names
from benchmarks.simulation.takes import Shot
from benchmarks.simulation.video import SimulatedVideo
from benchmarks.simulation.walks import PresetWalk
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.world import make_world

PRESETS = preset_names()


@cache
def video(preset: str, seed: int = 101, movers: bool = True) -> SimulatedVideo:
    return make_video(preset, seed, (32, 24), movers)


@cache
def shot(preset: str, seed: int = 101) -> Shot:
    return make_shot(preset, seed)


def angles(poses: np.ndarray) -> np.ndarray:
    """Rotation from each pose to the next, degrees."""
    turn = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    return np.rad2deg(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))


# ----------------------------------------------------------------------------------------------- casting


@pytest.mark.slow
def test_the_fast_caster_and_the_renderer_see_the_same() -> None:
    camera = preset_camera((64, 48))
    world = make_world(1)
    poses = camera_path(world.tour, None, PathSettings())[1][::40]
    shown = shot("twins")
    for objects, home, views in ((world.objects, world, poses), (None, shown.building.world, shown.T_world_cam[::150])):
        caster, renderer = Caster(objects or home.objects, camera), Renderer(home, camera)
        for pose in views:
            depth, ids = caster.cast(pose)
            frame = renderer.render(pose)
            assert (ids == frame.ids).mean() > 0.999
            assert (np.abs(depth - frame.depth) < 1e-4).mean() > 0.999


def test_the_fast_caster_sees_movers_where_the_renderer_does() -> None:
    film = shot("dynamic")
    camera, moving = preset_camera((64, 48)), [m.obj for m in film.movers]
    caster = Caster(film.building.world.objects, camera, moving)
    renderer = Renderer(film.building.world, camera, moving)
    for k in (200, 500, 800):
        for scene in (caster.scene, renderer.scene):
            for mover in film.movers:
                scene.place(mover.obj.id, mover.T_world_object[k])
        depth, ids = caster.cast(film.T_world_cam[k])
        frame = renderer.render(film.T_world_cam[k])
        assert np.array_equal(ids, frame.ids)
        assert np.allclose(depth, frame.depth, atol=1e-4)


# ----------------------------------------------------------------------------------------------- all presets


@pytest.mark.parametrize("preset", PRESETS)
def test_a_seed_makes_one_video(preset: str) -> None:
    one, again, other = shot(preset), make_shot(preset, 101), shot(preset, 102)
    assert one.building == again.building
    assert np.array_equal(one.T_world_cam, again.T_world_cam)
    assert one.building.world.objects != other.building.world.objects
    count = min(len(one.T_world_cam), len(other.T_world_cam))
    assert np.abs(one.T_world_cam[:count] - other.T_world_cam[:count]).max() > 1


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("seed", [101, 102, 103])
def test_a_person_could_film_it(preset: str, seed: int) -> None:
    film = shot(preset, seed)
    assert 800 <= len(film.time_s) <= 1300
    assert np.allclose(np.diff(film.time_s), film.time_s[1])
    assert 12 <= 1 / film.time_s[1] <= 15
    step = np.linalg.norm(np.diff(film.T_world_cam[:, :3, 3], axis=0), axis=1) / film.time_s[1]
    turn = angles(film.T_world_cam) / film.time_s[1]
    for cut in film.cuts:
        step[cut - 1] = turn[cut - 1] = 0
    assert step.max() < 1.5 and turn.max() < 140
    assert np.all((film.T_world_cam[:, 2, 3] > 1.2) & (film.T_world_cam[:, 2, 3] < 1.75))
    assert np.allclose(np.linalg.det(film.T_world_cam[:, :3, :3]), 1)
    assert (len(film.cuts) > 0) == (preset == "kidnap")
    assert (len(film.movers) > 0) == (preset == "dynamic")


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_the_building_is_closed_and_the_camera_in_the_open(preset: str) -> None:
    film = video(preset)
    assert np.all(film.ids > 0) and np.all(film.depth > 0.05)
    assert film.depth.shape == film.ids.shape == (len(film.time_s), 24, 32)
    known = {t.id for t in film.world.objects} | {m.id for m in film.movers}
    assert len(known) == len(film.world.objects) + len(film.movers)
    assert set(np.unique(film.ids).tolist()) <= known == set(film.classes)


def test_points_of_pixels_lie_on_their_things() -> None:
    film = video("dynamic")
    boxes = {t.id: t.box() for t in film.world.objects}
    camera = film.camera
    rays = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1) - [camera.cx, camera.cy]
    rays = np.concatenate([rays / camera.fx, np.ones((camera.height, camera.width, 1))], axis=-1)
    reach = {m.obj.id: m.obj.box() for m in shot("dynamic").movers}
    for k in range(0, len(film.time_s), 60):
        points = (rays * film.depth[k, ..., None]) @ film.T_world_cam[k, :3, :3].T + film.T_world_cam[k, :3, 3]
        for object_id in np.unique(film.ids[k]):
            own = points[film.ids[k] == object_id]
            if object_id in reach:
                pose = next(m.T_world_object[k] for m in film.movers if m.id == object_id)
                own = (own - pose[:3, 3]) @ pose[:3, :3]
            box = reach.get(int(object_id)) or boxes[int(object_id)]
            assert np.all(np.abs((own - box.center) @ box.rotation) <= box.size / 2 + 2e-3)


def test_what_makes_no_sense_is_named() -> None:
    with pytest.raises(OptionError, match="calm, loop, kidnap, dynamic, twins, sparse, corridor"):
        make_video("moon", 1)
    with pytest.raises(OptionError, match="4x4"):
        make_video("calm", 1, (4, 4))


# ----------------------------------------------------------------------------------------------- each preset


@pytest.mark.slow
def test_a_loop_comes_back_and_goes_on_along_its_old_path() -> None:
    film = video("loop")
    xy = film.T_world_cam[:, :2, 3]
    first, late = xy[: len(xy) // 6], xy[2 * len(xy) // 3 :]
    assert np.linalg.norm(np.diff(xy, axis=0), axis=1).sum() > 25
    assert np.linalg.norm(xy - xy[0], axis=1).max() > 6
    assert np.linalg.norm(late[:, None] - first[None], axis=2).min() < 0.3
    early, end = np.arange(0, len(xy) // 4, 4), np.arange(2 * len(xy) // 3, len(xy), 4)
    assert covisibility(film, early, end).max() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [101, 102, 103, 104])
def test_a_kidnapped_camera_wakes_where_it_has_been(seed: int) -> None:
    film = video("kidnap", seed)
    for cut in film.cuts:
        assert seen_share(film, [cut - 1], [cut]).max() == 0 == seen_share(film, [cut], [cut - 1]).max()
        assert covisibility(film, np.arange(0, cut - 240, 3), [cut]).max() > 0.3


@pytest.mark.slow
def test_cuts_fall_anywhere_in_the_chunks_and_some_videos_have_two() -> None:
    cuts = [shot("kidnap", seed).cuts for seed in range(101, 113)]
    assert {len(c) for c in cuts} == {1, 2}
    assert len({c[0] % 70 for c in cuts}) > 6


def test_twins_look_alike_and_are_two_places() -> None:
    film, house = video("twins"), shot("twins").building
    rooms = [room for room in house.rooms() if room.twin]
    a, b = (room for room in rooms if room.twin == rooms[0].twin)
    assert [film.classes[k] for k in a.objects] == [film.classes[k] for k in b.objects]
    assert not set(a.objects) & set(b.objects)
    in_a, in_b = (np.flatnonzero([room.contains(x, y) for x, y in film.T_world_cam[:, :2, 3]]) for room in (a, b))
    assert len(in_a) > 100 and len(in_b) > 100
    assert covisibility(film, in_a[::5], in_b[::5]).max() < 0.2
    back = max((in_a, in_b), key=lambda frames: int(np.diff(frames).max()))
    gap = int(np.diff(back).argmax())
    assert covisibility(film, back[: gap + 1 : 4], back[gap + 1 :: 4]).max() > 0.5


@pytest.mark.slow
def test_movers_fill_the_picture_and_are_gone_on_request() -> None:
    film, still = video("dynamic"), video("dynamic", movers=False)
    assert np.array_equal(film.T_world_cam, still.T_world_cam) and film.world == still.world
    assert not still.movers
    person, carton = film.movers
    share = (film.ids == person.id).mean(axis=(1, 2))
    assert np.mean((share > 0.10) & (share < 0.45)) > 0.5
    moving = np.isin(film.ids, [person.id, carton.id])
    assert np.array_equal(film.ids[~moving], still.ids[~moving])
    assert np.all(film.depth <= still.depth + 1e-5)


def test_a_thing_is_carried_away_while_it_is_filmed() -> None:
    film = video("dynamic")
    carton = film.movers[1]
    place, shown = carton.T_world_object[:, :3, 3], (film.ids == carton.id).any(axis=(1, 2))
    held = np.flatnonzero(place[:, 2] > 0)
    assert np.allclose(place[: held[0]], place[0]) and np.allclose(place[held[-1] + 1 :], place[-1])
    assert np.linalg.norm(place[0] - place[-1]) > 0.5
    assert shown[: held[0]].sum() > 5 and shown[held].sum() > 20
    speed = np.linalg.norm(np.diff(film.movers[0].T_world_object[:, :3, 3], axis=0), axis=1) / film.time_s[1]
    assert speed.max() < 3


@pytest.mark.slow
def test_sparse_rooms_hold_little_and_a_corridor_is_long() -> None:
    def per_frame(preset: str) -> float:
        return float(np.mean([len(np.unique(ids)) for ids in video(preset).ids[::10]]))

    assert per_frame("sparse") < 0.75 * per_frame("calm")
    way = video("corridor").T_world_cam[:, :3, 3]
    assert np.linalg.norm(way - way[0], axis=1).max() > 15
    assert np.linalg.norm(way[-1] - way[0]) < 1


# ----------------------------------------------------------------------------------------------- covisibility


def test_covisibility_is_a_share_and_symmetric() -> None:
    film, frames = video("calm"), np.arange(0, 800, 20)
    common = covisibility(film, frames, frames)
    assert np.array_equal(common, common.T)
    assert common.min() >= 0 and common.max() <= 1
    assert np.all(np.diag(common) > 0.97)
    near, far = covisibility(film, frames, frames + 2), covisibility(film, frames, frames + 12)
    assert np.diag(near).mean() > np.diag(far).mean() > 0.1


def test_what_moves_is_no_common_surface() -> None:
    film, still = video("dynamic"), video("dynamic", movers=False)
    frames = np.arange(0, 400, 40)
    with_movers, without = seen_share(film, frames, frames + 2), seen_share(still, frames, frames + 2)
    assert np.all(np.diag(with_movers) > 0.5 * np.diag(without))
    person = film.movers[0].id
    all_person = SimulatedVideo(**{**vars(film), "ids": np.full_like(film.ids, person)})
    assert not covisibility(all_person, frames, frames).any()


# ----------------------------------------------------------------------------------------------- with colour


@pytest.mark.slow
def test_a_preset_is_written_as_a_sequence_with_its_movers(tmp_path: Path) -> None:
    settings = PresetWalk(seed=101, preset="dynamic", frames=4, start=500, size=(64, 48), write_ids=True)
    root = write_walk(tmp_path / "dynamic", settings)
    film = shot("dynamic")
    caster = Caster(film.building.world.objects, settings.camera(), [m.obj for m in film.movers])
    truth = json.loads((root / "truth.json").read_text())
    assert truth["preset"] == "dynamic" and truth["cuts"] == []
    assert [m["label"] for m in truth["movers"]] == ["person", "carton"]
    for k in range(4):
        ids = cv2.imread(str(root / "ids" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        for told, mover in zip(truth["movers"], film.movers, strict=True):
            caster.scene.place(mover.obj.id, mover.T_world_object[500 + k])
            assert np.allclose(told["position"][k], mover.T_world_object[500 + k, :3, 3], atol=1e-5)
        assert np.array_equal(ids, caster.cast(film.T_world_cam[500 + k])[1])
    source = open_source(root)
    assert source.info.frame_count == 4 and source.info.has_depth


def test_cuts_are_numbered_as_the_frames_are_written() -> None:
    cut = shot("kidnap").cuts[0]
    settings = PresetWalk(seed=101, preset="kidnap", frames=6, start=cut - 3, size=(32, 32))
    assert settings.cuts() == (3,)
    assert PresetWalk(seed=101, preset="kidnap", frames=6).cuts() == ()
    assert settings.movers() == () == WalkSettings().movers()
    with pytest.raises(OptionError, match="leaves nothing"):
        PresetWalk(seed=101, preset="calm", start=5000).poses()

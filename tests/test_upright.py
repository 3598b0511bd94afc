"""Videos without gravity and without scale: up as the camera was held, and a metre that is guessed and says so."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.feedforward_sim.feedforward import FeedForwardModel
from benchmarks.simulation.presets import make_video
from list3r.api import open as open_scene
from list3r.cli.app import run
from list3r.exporters.components import read_components
from list3r.exporters.plan.view import choose_rotation
from list3r.exporters.scene_json import write_scene_json
from list3r.exporters.simready.assembly import SimreadySettings, write_simready
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Array, Sim3, rotation_exp
from list3r.memory.core.records import FrameSamples
from list3r.memory.library.maintenance import edits
from list3r.memory.library.overlap.planes import Planes, sampled_faces
from list3r.memory.library.relations.predicates import relations
from list3r.memory.library.world.gravity import Gravity, gravity_from_planes, gravity_of, sure_of_up
from list3r.memory.library.world.guess import GUESS, GuessSettings, guess_metre
from list3r.memory.library.world.held import parse_up, up_as_held
from list3r.memory.store.store import Store
from list3r.pipeline import mapping
from list3r.pipeline.filming import film_advice
from list3r.pipeline.finishing import guess_anew
from list3r.pipeline.placing import place_chunks
from list3r.pipeline.settings import BuildSettings
from list3r.queries.relations import relations as find_relations
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.walk import viewing_poses
from tests.conftest import box_points, chunk_result, local_instance, small_picture
from tests.test_relations import kitchen

Z = np.array([0.0, 0.0, 1.0])


def held(
    yaw_deg: tuple[float, float], pitch_deg: float = -20.0, roll_deg: float = 0.0, noise_deg: float = 0.0, seed: int = 0
) -> Sim3:
    """60 cameras of a z-up world that turn from one yaw to another, on an arm's length."""
    rng, count = np.random.default_rng(seed), 60
    yaw = np.radians(np.linspace(*yaw_deg, count))
    roll = np.radians(rng.normal(0.0, noise_deg, count))
    pitch = np.radians(pitch_deg + rng.normal(0.0, 3.0, count))
    place = np.stack([0.5 * np.cos(yaw), 0.5 * np.sin(yaw), 1.4 + 0.02 * rng.normal(size=count)], axis=1)
    T = viewing_poses(place, yaw, pitch, roll)
    turned = T[:, :3, :3] @ rotation_exp(np.array([0.0, 0.0, np.radians(roll_deg)]))
    return Sim3(np.ones(count), turned, T[:, :3, 3])


def faces(level: int = 300, walls: int = 300, noise_deg: float = 6.0, lean_deg: float = 0.0, seed: int = 0) -> Planes:
    """What computed depth shows of a room: normals of floor and walls and of clutter, and no plane."""
    rng = np.random.default_rng(seed)
    side = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])[rng.integers(0, 3, walls)]
    normals = np.concatenate([np.tile(Z, (level, 1)), side])
    normals += np.radians(noise_deg) * rng.normal(size=normals.shape)
    normals = np.concatenate([normals, rng.normal(size=(200, 3))])
    normals = normals @ rotation_exp(np.array([np.radians(lean_deg), 0.0, 0.0])).T
    none = np.zeros((0, 3))
    return Planes(none, none, np.zeros(0), none, np.zeros(0, int), normals / np.linalg.norm(normals, axis=1)[:, None])


NOTHING = replace(faces(), faces=np.zeros((0, 3)))


def moved(S: Sim3, planes: Planes) -> Planes:
    return replace(planes, faces=planes.faces @ S.rotation.T)


def lean(found: Array, up: Array = Z) -> float:
    return float(np.degrees(np.arccos(np.clip(found @ up, -1.0, 1.0))))


# ---------------------------------------------------------------------------------------------- up as held


@pytest.mark.parametrize("seed", range(6))
def test_up_is_recovered_from_cameras_with_noisy_roll_in_any_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras = held((0.0, 300.0), pitch_deg=rng.uniform(-40.0, 5.0), noise_deg=6.0, seed=seed)
    wild = rng.permutation(60)[:6]
    cameras.rotation[wild] = cameras.rotation[wild] @ rotation_exp(np.array([0.0, 0.0, 1.0]))
    S = Sim3.exp(np.append(rng.normal(0.0, 1.0, 6), 0.3))
    found = gravity_from_planes(NOTHING, S @ cameras)
    assert found.status == "assumed" and found.deviation_deg is not None
    assert lean(found.up, S.rotation[:, 2]) < 5.0 <= found.deviation_deg < 10.0


def test_the_deviation_falls_with_how_far_the_camera_turned() -> None:
    told = [up_as_held(held((0.0, width), noise_deg=2.0)).deviation_deg for width in (1.0, 40.0, 90.0, 180.0, 340.0)]
    assert told[:4] == sorted(told[:4], reverse=True) and told[0] > 18.0 and told[-1] < 8.0
    little = gravity_from_planes(NOTHING, held((0.0, 20.0)))
    assert little.status == "unknown" and "turn" in little.reason


@pytest.mark.parametrize("pitch", [-45.0, -10.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_surfaces_make_up_exact_where_the_camera_hardly_turned(pitch: float, seed: int) -> None:
    S = Sim3.exp(np.append(np.random.default_rng(seed).normal(0.0, 1.0, 6), 0.0))
    cameras = S @ held((0.0, 20.0), pitch_deg=pitch, noise_deg=4.0, seed=seed)
    found = gravity_from_planes(moved(S, faces(seed=seed)), cameras)
    assert found.status == "assumed" and found.deviation_deg == 3.0
    assert lean(found.up, S.rotation[:, 2]) < 2.0


def test_walls_alone_tell_up_too_and_one_wall_does_not() -> None:
    cameras = held((0.0, 20.0), pitch_deg=-5.0)
    assert lean(gravity_from_planes(faces(level=0), cameras).up) < 2.0
    one = faces(level=0)
    flat = np.abs(one.faces[:, 1]) < 0.5
    assert gravity_from_planes(replace(one, faces=one.faces[flat]), cameras).status == "unknown"


@pytest.mark.parametrize(
    ("cameras", "planes"),
    [
        (held((0.0, 90.0), roll_deg=90.0), faces()),
        (held((0.0, 90.0), roll_deg=-90.0), NOTHING),
        (held((0.0, 300.0), roll_deg=180.0), faces()),
        (held((0.0, 200.0), roll_deg=45.0), faces()),
        (held((0.0, 90.0)), faces(lean_deg=40.0)),
        (held((0.0, 10.0), pitch_deg=-88.0), replace(faces(), faces=np.tile(Z, (300, 1)))),
    ],
    ids=["on its side", "on its other side", "upside down", "askew", "surfaces that lean", "the floor alone"],
)
def test_evidence_that_contradicts_itself_leaves_up_unknown(cameras: Sim3, planes: Planes) -> None:
    found = gravity_from_planes(planes, cameras)
    assert found.status == "unknown" and found.deviation_deg is None and found.reason


@pytest.mark.parametrize("roll", [0.0, 12.0, 30.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("width", [45.0, 120.0, 300.0])
def test_up_is_never_wrong_by_twenty_degrees_unsaid(roll: float, width: float) -> None:
    for pitch in (-60.0, -30.0, 0.0):
        flat = replace(
            faces(),
            normal=np.array([Z, *np.eye(3)[[0, 1]]]),
            center=np.array([[0.0, 0, 0], [2, 0, 1], [0, 2, 1]]),
            area=np.array([2.0, 4.0, 4.0]),
        )
        for planes in (faces(), faces(level=60), flat, *([NOTHING] if roll != 180.0 else [])):  # alike without surfaces
            found = gravity_from_planes(planes, held((10.0, 10.0 + width), pitch, roll, noise_deg=4.0))
            error = lean(found.up)
            assert found.status == "unknown" or error < max(15.0, 2.0 * (found.deviation_deg or 0.0)), (pitch, error)


def test_planes_tell_up_where_all_cameras_were_rolled_alike() -> None:
    none = np.zeros((0, 3))
    floor = Planes(Z[None], np.zeros((1, 3)), np.array([2.0]), none, np.zeros(0, int), faces().faces)
    found = gravity_from_planes(floor, held((0.0, 150.0), roll_deg=17.0, noise_deg=1.0))
    assert found.status == "estimated" and lean(found.up) < 2.0


def test_faces_look_at_the_cameras() -> None:
    rng = np.random.default_rng(0)
    floor = np.concatenate([rng.uniform(-1, 1, (800, 2)), 0.002 * rng.normal(size=(800, 1))], axis=1)
    T = viewing_poses(np.array([[0.0, 0.0, 1.4]]), np.zeros(1), np.array([-0.8]), np.zeros(1))
    empty = FrameSamples.empty()
    samples = replace(
        empty, points=floor.astype(np.float32), frame=np.full(800, 7), camera_frames=np.array([7]), T_chunk_cam=T
    )
    found = sampled_faces(samples)
    assert len(found) > 500 and np.median(found[:, 2]) > 0.99
    assert len(sampled_faces(empty)) == 0


# ---------------------------------------------------------------------------------------------- --up, facts, parts


@pytest.mark.parametrize(
    ("up", "status", "z"),
    [("planes", "estimated", Z), ("camera", "assumed", Z), ("unknown", "unknown", None), ("0,-1,0", "known", Z)],
)
def test_up_as_it_was_asked_for(tmp_path: Path, up: str, status: str, z: Array | None) -> None:
    frames = np.arange(20)
    table = local_instance(0, box_points((2, 0, -0.6), (1.2, 0.8, 0.005), 900, 0), (150, 110, 70), frames)
    table = replace(table, plane=np.array([0, 0, 1, 0.6]))
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        store.facts.poses = "estimate"
        session = store.sessions.add("walk", "abc", BuildSettings(up=up).as_plain(), 20)
        store.chunks.add(session, chunk_result(0, 0, 20, (table,)))
        place_chunks(store)
        assert store.facts.gravity == status
        assert (store.facts.gravity_deviation_deg is None) == (status in ("known", "unknown"))
        if z is not None:
            assert lean(store.chunks.all()[0].S_world_chunk.rotation @ Z, z) < 1.0


def test_each_part_has_an_up_of_its_own_where_its_surfaces_tell_it(tmp_path: Path) -> None:
    frames = np.arange(20)
    lying = rotation_exp(np.array([1.4, 0.5, 0.2]))
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        store.facts.poses = "estimate"
        session = store.sessions.add("walk", "abc", BuildSettings().as_plain(), 60)
        for k, turn in enumerate((np.eye(3), lying, lying)):
            table = local_instance(0, box_points((2, 0, -0.6), (1.2, 0.8, 0.005), 900, 0) @ turn.T, (9, 9, 9), frames)
            table = replace(table, plane=np.array([*(turn @ Z), 0.6]))
            made = chunk_result(k, 20 * k, 20, (table,) if k < 2 else ())
            T = made.T_chunk_cam.copy()
            T[:, :3] = turn @ T[:, :3]
            samples = replace(made.samples, T_chunk_cam=T)
            store.chunks.add(session, replace(made, T_chunk_cam=T, samples=samples))
        place_chunks(store)
        assert [gravity_of(store, k) for k in (1, 2, 3)] == ["estimated", "unknown", "unknown"]
        place_chunks(store, bend=True)
        assert [gravity_of(store, k) for k in (1, 2, 3)] == ["estimated", "estimated", "unknown"]
        first, second, _ = store.chunks.all()
        assert (
            lean(first.S_world_chunk.rotation @ Z, Z) < 1.0 and lean(second.S_world_chunk.rotation @ lying @ Z, Z) < 1.0
        )
        place_chunks(store, bend=True)
        assert lean(store.chunks.get(2).S_world_chunk.rotation @ lying @ Z, Z) < 1.0


def test_build_takes_a_direction_of_the_first_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk = write_walk(tmp_path / "walk", WalkSettings(frames=24, size=(128, 96)))
    memory = tmp_path / "a.l3r"
    build = ["build", str(walk), "-m", str(memory), "--workers", "0", "--poses", "estimate", "--json"]
    assert run([*build, "--up", "sideways"]) == 2 and "--up sideways" in capsys.readouterr().err
    assert not memory.exists()
    assert run([*build, "--up", "0,-1,0"]) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["film"]  # 24 frames are few
    with open_scene(memory) as scene:
        assert scene.gravity == "known"
        np.testing.assert_allclose(-scene.store.trajectory.poses()[0][1].rotation[:, 1], Z, atol=1e-6)
    assert run(["update", str(memory), str(walk), "--up", "camera"]) == 2
    assert "--up camera is for build" in capsys.readouterr().err
    assert run(["update", str(memory), str(walk), "--association", "paper"]) == 2
    assert "--association is for build" in capsys.readouterr().err
    assert run([*build, "--association", "slam", "--force"]) == 2
    assert "--association slam: choose from list3r, paper, frames" in capsys.readouterr().err


def test_a_direction_is_read_and_nonsense_is_refused() -> None:
    np.testing.assert_allclose(parse_up("0,-2,0"), [0, -1, 0])
    assert parse_up("camera") is None
    for text in ("sideways", "0,0,0", "1,2", "nan,0,1"):
        with pytest.raises(OptionError, match="--up"):
            parse_up(text)


def test_what_needs_up_is_as_sure_as_up(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        store.facts.gravity, store.facts.gravity_deviation_deg = "estimated", 5.0
        assert sure_of_up(store) == 1.0
        store.facts.gravity, sure = "assumed", []
        for deviation in (3.0, 7.0, 10.0):
            store.facts.gravity_deviation_deg = deviation
            sure.append(sure_of_up(store))
    assert 1.0 >= sure[0] > 0.99 > sure[1] > 0.8 > sure[2] > 0.5
    known, assumed = (relations(kitchen(), gravity_known=True, sure_of_up=share) for share in (1.0, 0.6))
    assert len(known) == len(assumed) and any(r.predicate == "on" for r in known)
    for a, b in zip(known, assumed, strict=True):
        share = 1.0 if a.predicate in ("near", "next_to") else 0.6
        assert b.confidence == pytest.approx(share * a.confidence, abs=1e-4)


# ---------------------------------------------------------------------------------------------- a guessed metre


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory of two chunks of a simulated model without scale, its session finished."""
    model = FeedForwardModel(make_video("calm", 102), seed=102)
    path = tmp_path_factory.mktemp("guess") / "two.l3r"
    with Store.create(path) as store:
        with store.transaction():
            session = store.sessions.add("simulation", "", {}, 240)
        for span in plan_chunks(400, ChunkSettings())[:2]:
            mapping.add_chunk(store, session, model.chunk(span), library=False)
        mapping.finish_session(store, session)
    return path


@pytest.fixture
def memory(walked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(walked, tmp_path / "m.l3r"))


def test_a_metre_is_guessed_and_says_so(memory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_scene(memory) as scene:
        lengths = scene.lengths
        assert (scene.units, lengths.metric, str(lengths)) == ("unit", "guessed", "about m")
        assert lengths.deviation is not None and 0.05 < lengths.deviation <= 0.3
        height = float(np.median([S.translation[2] for _, S in scene.store.trajectory.poses()]))
        assert abs(height / 1.5 - 1.0) < 0.25  # of the simulated walker
        assert all("about" in i.description for i in scene.instances())
        write_scene_json(scene.store, tmp_path / "s.json")
    frame = json.loads((tmp_path / "s.json").read_text())["frame"]
    assert (frame["units"], frame["metric"], frame["metric_deviation"]) == ("unit", "guessed", lengths.deviation)
    assert run(["info", str(memory)]) == 0 and "guess, give or take" in capsys.readouterr().out
    assert run(["list", str(memory)]) == 0 and "centre x y z (about m)" in capsys.readouterr().out
    assert run(["within", str(memory), "--point", "1,1,1", "--radius", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["units"], answer["metric"], answer["metre_deviation"]) == ("unit", "guessed", lengths.deviation)
    assert run(["within", str(memory), "--point", "2,2,1", "--radius", "2"]) == 0
    assert "lengths are about metres" in capsys.readouterr().err
    assert run(["edit", "scale", str(memory)]) == 0 and "about metres" in capsys.readouterr().out


def test_an_anchor_goes_before_the_guess_and_its_undo_brings_it_back(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        placed = [c.S_world_chunk.scale for c in store.chunks.all()]
        edit = edits.scale(store, "0,0,0:1,0,0=2m", "ann")
        assert store.facts.scale_kind == "anchored"
        np.testing.assert_allclose([c.S_world_chunk.scale for c in store.chunks.all()], [2.0 * s for s in placed])
        edits.undo(store, edit.entry)
        assert store.facts.scale_kind == "guessed"
        np.testing.assert_allclose([c.S_world_chunk.scale for c in store.chunks.all()], placed)
        assert not store.verify()


def test_a_guess_is_refused_where_a_wrong_metre_hurts(memory: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    with Store.open(memory) as store:
        with pytest.raises(OptionError, match="--guessed-metre"):
            write_simready(store, tmp_path / "props")
        chosen = tuple(i.id for i in store.instances.all(structure=False))[:1]
        assert write_simready(store, tmp_path / "props", SimreadySettings(guessed_metre=True, ids=chosen, workers=0))


def test_a_guess_follows_the_size_of_the_graph(memory: Path) -> None:
    with Store.open(memory, writable=True) as store, store.transaction():
        chunks, estimate = store.chunks.all(), store.facts.gravity_estimate
        assert estimate is not None and estimate.floor_height is not None
        S_graph_world = store.facts.S_world_graph.inverse()
        graph = {c.chunk_id: S_graph_world @ c.S_world_chunk for c in chunks}
        store.facts[GUESS] = None
        found = guess_metre(store, chunks, graph, Gravity("estimated", estimate.up, estimate.floor_height, ""))
        S = Sim3(np.asarray(3.0), np.eye(3), np.zeros(3))
        larger = Gravity("estimated", estimate.up, 3.0 * estimate.floor_height, "")
        threefold = guess_metre(store, chunks, {k: S @ c for k, c in graph.items()}, larger)
        assert found is not None and threefold is not None
        assert threefold.metres == pytest.approx(found.metres / 3.0)
        nothing = guess_metre(store, chunks, graph, Gravity("unknown", Z, None, ""))
        assert nothing is None  # how far things are says too little


def test_names_make_a_guess_better(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        before, large = store.facts[GUESS], max(store.instances.all(structure=False), key=lambda i: i.box.size.max())
        assert before is not None
        edits.label(store, large.id, "bed", "ann")
    guess_anew(memory)
    with Store.open(memory) as store:
        after = store.facts[GUESS]
        assert after is not None and after.deviation < before.deviation and "the size of a bed" in after.source
        scale = float(store.facts.S_world_graph.scale)
        assert store.facts.scale_kind == "guessed" and scale == pytest.approx(after.metres, rel=1e-6)
        assert not store.verify()


def test_without_a_floor_a_table_tells_a_metre_and_other_names_none(memory: Path) -> None:
    with Store.open(memory, writable=True) as store, store.transaction():
        chunks, S_graph_world = store.chunks.all(), store.facts.S_world_graph.inverse()
        graph = {c.chunk_id: S_graph_world @ c.S_world_chunk for c in chunks}
        estimate = store.facts.gravity_estimate
        assert estimate is not None
        no_floor, store.facts[GUESS] = Gravity("estimated", estimate.up, None, ""), None
        things = [i for i in store.instances.all(structure=False) if abs(i.aabb[1, 2] - 0.75) < 0.3]
        store.instances.set_labels({i.id: "chair" for i in things})
        assert guess_metre(store, chunks, graph, no_floor) is None
        labels = {i.id: name for i, name in zip(things, ("table", "chair", "cup", "bottle"), strict=False)}
        store.instances.set_labels(dict(list(labels.items())[:1]))
        assert guess_metre(store, chunks, graph, no_floor) is None  # it may be another surface
        store.instances.set_labels(labels)
        found = guess_metre(store, chunks, graph, no_floor, GuessSettings(most_deviation=0.3))
        assert found is not None and "over a table" in found.source and 0.14 < found.deviation < 0.3


def test_up_of_another_part_is_unknown(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        rows = store.chunks.all()
        with store.transaction():
            apart = {rows[0].chunk_id: rows[0].chunk_id, rows[1].chunk_id: rows[1].chunk_id}
            store.chunks.place({c.chunk_id: c.S_world_chunk for c in rows}, apart, {})
        assert gravity_of(store, rows[0].chunk_id) == store.facts.gravity == "estimated"
        assert gravity_of(store, rows[1].chunk_id) == "unknown"
        part = next(c for c in read_components(store) if c.id == rows[1].chunk_id)
        assert "gravity unknown" in choose_rotation(part, gravity_of(store, part.id))[1]


def test_an_answer_says_that_up_is_assumed(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory(), writable=True) as store:
        assert "assumed" not in find_relations(store, predicate="on").reason
        with store.transaction():
            store.facts.gravity, store.facts.gravity_deviation_deg = "assumed", 7.2
        found = find_relations(store, predicate="on")
        assert found and "up is assumed" in found.reason and "7 degrees" in found.reason
        assert "assumed" not in find_relations(store, predicate="near").reason


# ---------------------------------------------------------------------------------------------- how to film


def test_a_build_says_what_kept_it_from_more(tmp_path: Path) -> None:
    frames = np.arange(200)
    thing = local_instance(0, box_points((2, 0, 0.5), (0.3, 0.3, 0.3), 300, 0), (150, 110, 70), frames)
    night = cv2.imencode(".jpg", np.full((48, 64, 3), 12, np.uint8))[1].tobytes()
    for jpeg, empty, said, unsaid in (
        (small_picture(), 0.0, "up is unknown", "dark"),
        (night, 0.0, "dark", "no depth"),
        (small_picture(), 0.7, "no depth", "dark"),
    ):
        chunk = chunk_result(0, 0, 200, (thing,), jpeg)
        depth = np.full((10, 10), 2.0, np.float32)
        depth[: int(10 * empty)] = 0.0
        keyframe = replace(chunk.keyframes[0], depth_small=depth)
        with Store.create(tmp_path / f"{said}.l3r") as store, store.transaction():
            session = store.sessions.add("walk", "abc", {}, 200)
            store.chunks.add(session, replace(chunk, scale_kind="relative", keyframes=(keyframe,)))
            advice = film_advice(store, session)
        assert advice is not None and said in advice and unsaid not in advice and advice.count(";") <= 1

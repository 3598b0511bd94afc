"""What is read of a damaged memory is refused every time it is asked for; what is not damage is not called so."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.library.maintenance import edits
from list3r.memory.library.maintenance.repair import repair
from list3r.memory.store.schema import SCHEMA_VERSION
from list3r.memory.store.store import Store
from tests.test_hardening_files import spoil

Make = Callable[..., Path]

QUESTIONS: dict[str, Callable[[list3r.SceneMemory], object]] = {
    "instances": lambda scene: scene.instances(),
    "find": lambda scene: scene.find("white box"),
    "nearest": lambda scene: scene.nearest((0.0, 0.0, 0.0)),
    "support": lambda scene: scene.support(2),
    "seen": lambda scene: scene.seen(2),
    "visible": lambda scene: scene.visible(scene.camera(frame=3)),
    "relations": lambda scene: scene.relations(3),
}
DAMAGES = {
    "instances": "UPDATE instances SET confidence = 0.123 WHERE id = 3",
    "surfaces": "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 1",
    "masks": "UPDATE local_instances SET track = zeroblob(length(track)) WHERE local_id = 1",
    "cameras": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 3",
    "places": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "calibration": "UPDATE chunks SET fx = 7",
    "observations": "UPDATE observations SET instance = 2 WHERE local_id = 3",
}


def answer(scene: list3r.SceneMemory, ask: Callable[[list3r.SceneMemory], object]) -> str:
    return repr(ask(scene))


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_memory_answers_as_a_sound_one_or_refuses_every_time(damage: str, make_memory: Make) -> None:
    path = make_memory()
    with list3r.open(path) as scene:
        sound = {name: answer(scene, ask) for name, ask in QUESTIONS.items()}
    spoil(path, DAMAGES[damage])
    refused = 0
    for name, ask in QUESTIONS.items():
        with list3r.open(path) as scene:
            message = []
            for _ in range(4):
                try:
                    message.append(answer(scene, ask))
                except MemoryFileError as error:
                    assert "repair" in str(error)
                    refused += 1
        assert set(message) <= {sound[name]} and len(message) in (0, 4), name
    assert refused >= 4


def test_damage_refuses_what_reads_it_and_nothing_else(make_memory: Make) -> None:
    path = make_memory()
    with list3r.open(path) as scene:
        sound = {name: answer(scene, ask) for name, ask in QUESTIONS.items()}
    spoil(path, DAMAGES["masks"])
    with list3r.open(path) as scene:
        with pytest.raises(MemoryFileError, match="repair"):
            scene.store.local_instances.mask_track(1, 1)
        for name in ("instances", "find", "relations", "nearest"):
            assert answer(scene, QUESTIONS[name]) == sound[name]


@pytest.mark.parametrize("command", ["seen", "within"])
def test_damage_of_masks_is_not_an_answer(command: str, make_memory: Make, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_memory()
    spoil(path, DAMAGES["masks"])
    assert run([command, str(path), "--view", "3"]) == 2
    assert "repair" in capsys.readouterr().err


def test_an_error_of_the_callers_own_is_his(make_memory: Make) -> None:
    path = make_memory()
    for at in (None, 1):
        with pytest.raises(KeyError, match="mine"), list3r.open(path, at=at) as scene:
            scene.instances()
            raise KeyError("mine")
        with list3r.open(path, at=at) as scene:
            assert scene.store.verify() == []
    spoil(path, DAMAGES["instances"])
    with pytest.raises(KeyError, match="mine"), list3r.open(path):
        raise KeyError("mine")


def test_the_past_takes_in_what_is_written_meanwhile_whole(make_memory: Make) -> None:
    path = make_memory()
    with list3r.open(path, at=1) as scene:
        before = {i.id: i.label for i in scene.instances()}
        with Store.open(path, writable=True) as writer:
            edits.delete(writer, 4)
            edits.label(writer, 2, "plate")
        with scene.store.snapshot():
            found = {i.id: i.label for i in scene.instances()}
            ids = {o.instance_id for o in scene.store.observations.all()}
        assert {2, 4} <= set(before) and before[2] is None
        assert found.keys() & {2, 4} == {2} and found[2] == "plate"
        assert ids & {2, 4} == {2}


def test_damage_is_found_in_the_past_too(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, DAMAGES["surfaces"])
    for _ in range(2):
        with pytest.raises(MemoryFileError, match="repair"), list3r.open(path, at=1) as scene:
            scene.support(2)


def test_a_memory_of_a_newer_program_is_not_repaired(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    with sqlite3.connect(path) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    before = path.read_bytes()
    shutil.copy(path, tmp_path / "copy.l3r")
    for out in (None, tmp_path / "sound.l3r"):
        with pytest.raises(MemoryFileError, match="update list3r"):
            repair(path, out)
    assert path.read_bytes() == before and not (tmp_path / "sound.l3r").exists()

"""Recorders that know gravity: the memory's vertical is theirs, whichever way the phone was held."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.evaluation.trajectory import read_tum
from list3r.frames.base import Camera
from list3r.frames.recordings.axes import CLOCKWISE, turns_in_gravity
from list3r.frames.source import open_source
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from tests import recordings
from tests.test_frames_every_format import FORMATS

KNOW_GRAVITY = ("record3d", "live record3d", "stray", "polycam", "arkitscenes")
HELD = {"level": 0, "upright": 1, "on its head": 2, "upright, the other way": 3}
"""How the phone is held, and the clockwise quarter turns that put its pictures upright."""
_LARGE = Camera(recordings.WIDTH, recordings.HEIGHT, *recordings.K)


@cache
def renderers() -> tuple[Renderer, Renderer]:
    """Of pictures and of depth, in a simulated room."""
    world = WalkSettings(seed=1).world()
    return Renderer(world, _LARGE), Renderer(world, _LARGE.resized(recordings.DEPTH_HEIGHT, recordings.DEPTH_WIDTH))


@cache
def filmed(turns: int) -> list[recordings.Shot]:
    """A few steps through a simulated room with the phone held one way."""
    pictures, depths = renderers()
    out = []
    steps = WalkSettings(seed=1).poses()[1][: 3 * recordings.COUNT : 3]
    for T in steps @ np.linalg.matrix_power(CLOCKWISE, -turns % 4):
        color = np.clip(pictures.render(T).color, 0, 255).astype(np.uint8)
        out.append(recordings.Shot(T, color, depths.render(T).depth))
    return out


@pytest.fixture(params=HELD)
def turns(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    turns = HELD[request.param]
    monkeypatch.setattr(recordings, "shots", lambda: filmed(turns))
    return turns


def write(kind: str, root: Path) -> Path:
    writer, package = FORMATS[kind]
    if package and find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    return writer(root)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KNOW_GRAVITY)
def test_the_vertical_is_the_recorders_whichever_way_the_phone_is_held(kind: str, turns: int, tmp_path: Path) -> None:
    source, memory = write(kind, tmp_path / "recording"), tmp_path / "a.l3r"
    list3r.build(source, memory, workers=0)
    with list3r.open(memory) as scene:
        scene.export("tum", tmp_path / "a.txt")
        assert scene.store.facts.gravity == "known"
    for T, shot in zip(read_tum(tmp_path / "a.txt").T_world_cam, filmed(turns), strict=True):
        up_camera = shot.T_world_cam[2, :3]
        off = np.degrees(np.arccos(np.clip(T[2, :3] @ up_camera, -1.0, 1.0)))
        assert off < 0.5, off


@pytest.mark.parametrize("kind", KNOW_GRAVITY)
def test_pictures_that_do_not_stand_upright_are_told_of(kind: str, turns: int, tmp_path: Path) -> None:
    info = open_source(write(kind, tmp_path / "recording")).info
    said = [note for note in info.notes if note.startswith("the pictures ")]
    assert info.z_up
    assert len(said) == (turns > 0)
    assert all(("head" in note) == (turns == 2) for note in said)


def test_a_world_in_which_cameras_stand_on_no_side_has_another_vertical() -> None:
    """As of a file whose world has y up though z is said to be: cameras that look round lie all ways in it."""
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    poses = list(WalkSettings(seed=1).poses()[1])
    assert turns_in_gravity(poses) == 0
    assert turns_in_gravity([y_up @ T for T in poses]) is None
    assert turns_in_gravity([]) is None

"""Furniture is one body and not its faces; what hangs on a wall or lies on a floor is a thing of its own."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.instances.library import build_library
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import LocalInstance, LocalLibrary
from tests.test_instances_library import FLOOR, WALL, Block, look_at, reconstruction_of, render, world_points

CHEST = Block((-0.7, 1.2, 0.0), (0.4, 1.65, 0.85), (150, 100, 60))
BOX = Block((-0.3, 1.3, 0.85), (-0.05, 1.5, 1.0), (60, 110, 190))
PICTURE = Block((-0.6, 1.77, 1.2), (0.1, 1.8, 1.65), (90, 60, 120))
RUG = Block((-0.8, 0.2, 0.0), (0.5, 0.9, 0.012), (150, 60, 60))
ROOM = (FLOOR, WALL, CHEST, BOX, PICTURE, RUG)


def _walk() -> list[Frame]:
    """A camera that walks round a chest, with the noise of a structured-light sensor."""
    rng = np.random.default_rng(2)
    frames = []
    for k in range(30):
        angle = -0.9 + 1.8 * k / 29
        T = look_at((-0.15 + 2.3 * np.sin(angle), 1.4 - 2.3 * np.cos(angle), 1.7), (-0.15, 1.3, 0.75 - 0.4 * (k % 2)))
        depth, which = render(ROOM, T)
        depth = np.where(depth > 0, depth + rng.normal(0.0, 0.0015 + 0.0019 * depth**2), 0.0)
        color = np.array([block.rgb for block in ROOM], np.uint8)[which]
        color = np.clip(color + rng.normal(0.0, 2.0, color.shape), 0, 255).astype(np.uint8)
        frames.append(Frame(k, k / 30, color, depth.astype(np.float32), T))
    return frames


@pytest.fixture(scope="module")
def room() -> tuple[list[Frame], LocalLibrary]:
    frames = _walk()
    return frames, build_library(frames, reconstruction_of(frames))


def _votes(library: LocalLibrary, frames: list[Frame], block: Block, facing: int | None = None) -> list[int]:
    """Pixels of a block, or of its side across one axis, that each instance has."""
    votes = [0] * len(library.instances)
    for frame in frames[::5]:
        depth, which = render(ROOM, frame.T_source_cam)
        mine = which == ROOM.index(block)
        if facing is not None:
            v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
            camera = reconstruction_of(frames[:1]).camera
            rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
            at = depth[..., None] * rays @ frame.T_source_cam[:3, :3].T + frame.T_source_cam[:3, 3]
            sides = np.minimum(np.abs(at - block.low), np.abs(at - block.high))
            mine &= np.argmin(sides, axis=-1) == facing
        for instance in library.instances:
            for row in np.flatnonzero(instance.track.frames == frame.index):
                votes[instance.local_id] += int((decode_mask(instance.track.masks[row], mine.shape) & mine).sum())
    return votes


def _find(library: LocalLibrary, frames: list[Frame], block: Block) -> LocalInstance:
    return library.instances[int(np.argmax(_votes(library, frames, block)))]


def test_top_front_and_sides_of_a_chest_are_one_thing(room: tuple[list[Frame], LocalLibrary]) -> None:
    frames, library = room
    owners = [int(np.argmax(_votes(library, frames, CHEST, facing))) for facing in (0, 1, 2)]
    assert len(set(owners)) == 1
    points = world_points(library.instances[owners[0]], frames)
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    assert np.all(np.abs(low[[0, 1]] - np.array(CHEST.low)[[0, 1]]) < 0.06)
    assert np.all(np.abs(high - np.array(CHEST.high)) < 0.06)


def test_what_stands_on_a_chest_is_no_part_of_it(room: tuple[list[Frame], LocalLibrary]) -> None:
    frames, library = room
    assert _find(library, frames, BOX).local_id != _find(library, frames, CHEST).local_id


@pytest.mark.parametrize("block", [PICTURE, RUG])
def test_a_picture_and_a_rug_are_things(room: tuple[list[Frame], LocalLibrary], block: Block) -> None:
    frames, library = room
    found = _find(library, frames, block)
    assert not found.structure
    assert found.local_id not in {_find(library, frames, other).local_id for other in ROOM if other is not block}
    low, high = np.quantile(world_points(found, frames), [0.02, 0.98], axis=0)
    assert np.all(np.abs(low - np.array(block.low)) < 0.04) and np.all(np.abs(high - np.array(block.high)) < 0.04)


def test_floor_and_wall_stay_structure(room: tuple[list[Frame], LocalLibrary]) -> None:
    frames, library = room
    assert _find(library, frames, FLOOR).structure and _find(library, frames, WALL).structure
    assert sum(i.structure for i in library.instances) == 2

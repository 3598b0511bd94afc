"""The local instance library on a rendered table scene whose truth is known, and on nothing at all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.instances.geometric.kernels import without_lone
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.discovery import LearnedDiscoverer
from list3r.instances.library import InstanceSettings, build_library
from list3r.instances.overlays import draw_debug
from list3r.instances.tracking.joining import join_candidates
from list3r.memory.core.masks import decode_mask, shown_surface
from list3r.memory.core.records import LocalInstance, LocalLibrary
from list3r.memory.store.store import Store
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.keyframe_record import make_keyframes
from tests.conftest import chunk_result
from tests.ray_boxes import through_box

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


@dataclass(frozen=True)
class Block:
    """An axis-aligned box of one colour; z is up, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    rgb: tuple[int, int, int]


FLOOR = Block((-3, -3, -0.1), (3, 3, 0.0), (120, 120, 125))
WALL = Block((-3, 1.8, 0.0), (3, 1.9, 2.6), (215, 215, 205))
TABLE = (
    Block((-0.6, 0.3, 0.69), (0.6, 1.1, 0.73), (170, 130, 80)),
    Block((-0.58, 0.32, 0.0), (-0.52, 0.38, 0.69), (160, 120, 70)),
    Block((0.52, 0.32, 0.0), (0.58, 0.38, 0.69), (160, 120, 70)),
)
MUG = Block((-0.3, 0.55, 0.73), (-0.22, 0.63, 0.82), (225, 225, 230))
TIN = Block((0.2, 0.6, 0.73), (0.38, 0.78, 0.83), (60, 110, 190))
SHEET = Block((-0.1, 0.45, 0.73), (0.11, 0.75, 0.733), (120, 40, 130))
SCENE = (FLOOR, WALL, *TABLE, MUG, TIN, SHEET)


def render(
    blocks: tuple[Block, ...], T_world_cam: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Depth along z (0 for a miss) and the block at each pixel, -1 for none."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    direction = np.ascontiguousarray(np.moveaxis(rays @ T_world_cam[:3, :3].T, -1, 0))
    depth, which = np.full(u.shape, np.inf), np.full(u.shape, -1)
    for number, block in enumerate(blocks):
        enter, leave = through_box(T_world_cam[:3, 3], direction, block.low, block.high)
        hit = (enter < leave) & (enter > 0.1) & (enter < depth)
        depth[hit], which[hit] = enter[hit], number
    return np.where(np.isfinite(depth), depth, 0.0), which


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> NDArray[np.float64]:
    """T_world_cam of a level camera at `eye` that looks at `target`."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return T


def walk(blocks: tuple[Block, ...], count: int = 24) -> tuple[list[Frame], Reconstruction]:
    """A camera that moves before the table, with the noise of a structured-light sensor."""
    rng = np.random.default_rng(1)
    frames = []
    for k in range(count):
        x = -0.5 + 1.0 * k / max(count - 1, 1)
        T = look_at((x, -0.7, 1.45), (0.3 * x, 0.75, 0.7))
        depth, which = render(blocks, T)
        depth = np.where(depth > 0, depth + rng.normal(0.0, 0.0015 + 0.0019 * depth**2), 0.0)
        color = np.array([block.rgb for block in blocks], np.uint8)[which]
        color = np.clip(color + rng.normal(0.0, 2.0, color.shape), 0, 255).astype(np.uint8)
        frames.append(Frame(k, k / 30, color, depth.astype(np.float32), T))
    return frames, reconstruction_of(frames)


def reconstruction_of(frames: list[Frame]) -> Reconstruction:
    depth = np.stack([frame.depth for frame in frames if frame.depth is not None])
    first = np.linalg.inv(frames[0].T_source_cam)
    return Reconstruction(
        frame_indices=np.array([frame.index for frame in frames]),
        posed=np.ones(len(frames), bool),
        T_chunk_cam=np.stack([first @ frame.T_source_cam for frame in frames]),
        camera=CAMERA,
        depth=depth,
        confidence=(depth > 0).astype(np.float16),
        scale_kind="metric",
        keyframes=np.arange(0, len(frames), 5),
    )


@pytest.fixture(scope="module")
def scene() -> tuple[list[Frame], Reconstruction, LocalLibrary]:
    frames, reconstruction = walk(SCENE)
    return frames, reconstruction, build_library(frames, reconstruction)


def world_points(instance: LocalInstance, frames: list[Frame]) -> NDArray[np.float64]:
    T = frames[0].T_source_cam
    assert T is not None
    return np.asarray(instance.support.points @ T[:3, :3].T + T[:3, 3])


def find(library: LocalLibrary, frames: list[Frame], block: Block) -> LocalInstance:
    """The instance that most of a block's own pixels belong to, over all frames."""
    number = SCENE.index(block)
    votes = np.zeros(len(library.instances))
    for frame in frames[::4]:
        mine = render(SCENE, frame.T_source_cam)[1] == number
        for instance in library.instances:
            for row in np.flatnonzero(instance.track.frames == frame.index):
                votes[instance.local_id] += (decode_mask(instance.track.masks[row], (240, 320)) & mine).sum()
    return library.instances[int(np.argmax(votes))]


def test_every_thing_is_an_instance_of_its_own(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    owners = [find(library, frames, block).local_id for block in (FLOOR, WALL, TABLE[0], MUG, TIN, SHEET)]
    assert len(set(owners)) == len(owners)


def test_sizes_are_those_of_the_things(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    for block in (MUG, TIN):
        points = world_points(find(library, frames, block), frames)
        low, high = np.quantile(points, [0.02, 0.98], axis=0)
        assert np.all(high - low < np.subtract(block.high, block.low) + 0.03)
        assert np.all(low > np.array(block.low) - 0.02) and np.all(high < np.array(block.high) + 0.02)
        assert high[2] - low[2] > 0.5 * (block.high[2] - block.low[2])


def test_legs_belong_to_the_table(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    table = find(library, frames, TABLE[0])
    assert find(library, frames, TABLE[1]).local_id == table.local_id
    assert world_points(table, frames)[:, 2].min() < 0.3


def test_floor_and_wall_are_structure(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    floor, wall = find(library, frames, FLOOR), find(library, frames, WALL)
    assert floor.structure and wall.structure
    assert {i.local_id for i in library.instances if i.structure} == {floor.local_id, wall.local_id}
    assert floor.plane is not None
    normal = frames[0].T_source_cam[:3, :3] @ floor.plane[:3]
    assert np.allclose(normal, [0.0, 0.0, 1.0], atol=0.02)


def test_masks_agree_with_the_rendered_truth(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    tin = find(library, frames, TIN)
    for row in range(0, len(tin.track.frames), 5):
        frame = frames[int(tin.track.frames[row])]
        truth = render(SCENE, frame.T_source_cam)[1] == SCENE.index(TIN)
        mask = decode_mask(tin.track.masks[row], tin.track.image_size)
        assert (mask & truth).sum() / (mask | truth).sum() > 0.6
        assert mask.sum() == tin.track.areas_px[row]
        assert 0.0 <= tin.track.visible_fraction[row] <= 1.0


def test_small_things_apart_may_not_be_joined(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, _, library = scene
    mug, tin = (find(library, frames, block).local_id for block in (MUG, TIN))
    pairs = {tuple(sorted(pair)) for pair in library.cannot_link.tolist()}
    assert tuple(sorted((mug, tin))) in pairs


def test_same_input_same_library(scene: tuple[list[Frame], Reconstruction, LocalLibrary]) -> None:
    frames, reconstruction, library = scene
    again = build_library(frames, reconstruction)
    assert len(again.instances) == len(library.instances)
    for one, two in zip(library.instances, again.instances, strict=True):
        assert np.array_equal(one.support.points, two.support.points)
        assert np.array_equal(one.track.areas_px, two.track.areas_px)
        assert np.array_equal(one.feature, two.feature)
    assert np.array_equal(library.cannot_link, again.cannot_link)


def test_joining_by_overlap_finds_what_the_discoverer_knows() -> None:
    frames, reconstruction = walk(SCENE, 16)
    settings = InstanceSettings(anchor_step=5)
    views = ChunkViews(frames, reconstruction, settings)
    discoverer = LearnedDiscoverer(settings)
    proposals = [discoverer(frames, reconstruction, position) for position in views.anchors]
    known = np.concatenate([p.identity for p in proposals])
    blind = [type(p)(p.position, p.labels, p.score, p.features, p.plane) for p in proposals]
    joined = np.concatenate(join_candidates(views, blind))
    for group in np.unique(joined):
        assert len(np.unique(known[joined == group])) == 1


def test_pictures_are_written(scene: tuple[list[Frame], Reconstruction, LocalLibrary], tmp_path) -> None:
    frames, reconstruction, library = scene
    written = draw_debug(frames, reconstruction, library, tmp_path / "debug", every=10)
    assert len(written) == 4 and all(path.stat().st_size > 0 for path in written)


def test_nothing_to_see_is_an_empty_library() -> None:
    frames, reconstruction = walk(SCENE, 4)
    blind = [Frame(f.index, f.time_s, f.color, np.zeros_like(f.depth), f.T_source_cam) for f in frames]
    assert build_library(blind, reconstruction_of(blind)).instances == ()
    lost = Reconstruction(
        reconstruction.frame_indices,
        np.zeros(4, bool),
        np.full((4, 4, 4), np.nan),
        CAMERA,
        reconstruction.depth,
        reconstruction.confidence,
        "metric",
        np.zeros(0, np.int64),
    )
    library = build_library(frames, lost)
    assert library.instances == () and library.cannot_link.shape == (0, 2)


def test_one_frame_is_enough_to_run() -> None:
    frames, reconstruction = walk(SCENE, 1)
    library = build_library(frames, reconstruction)
    assert any(instance.structure for instance in library.instances)


def test_scale_does_not_matter_without_a_metre() -> None:
    frames, reconstruction = walk(SCENE, 12)
    scaled = Reconstruction(
        reconstruction.frame_indices,
        reconstruction.posed,
        np.stack([np.block([[T[:3, :3], 5.0 * T[:3, 3:]], [T[3:]]]) for T in reconstruction.T_chunk_cam]),
        CAMERA,
        reconstruction.depth * np.float32(5.0),
        reconstruction.confidence,
        "relative",
        reconstruction.keyframes,
    )
    library = build_library(frames, scaled)
    mug, tin = find(library, frames, MUG), find(library, frames, TIN)
    assert mug.local_id != tin.local_id
    assert np.ptp(mug.support.points, axis=0).max() < 5.0 * 0.2


def test_every_instance_shows_in_a_kept_picture(
    scene: tuple[list[Frame], Reconstruction, LocalLibrary], tmp_path: Path
) -> None:
    frames, reconstruction, library = scene
    late = library.instances[-1]  # comes into view bit by bit
    track = replace(late.track, visible_fraction=np.linspace(0.1, 1.0, len(late.track.frames), dtype=np.float32))
    library = replace(library, instances=(*library.instances[:-1], replace(late, track=track)))
    first = replace(reconstruction, keyframes=np.array([0]))
    kept = make_keyframes(frames, first, True, library=library)
    pictured = {k.frame_index for k in kept}
    for track in (i.track for i in library.instances):
        shown = shown_surface(track.visible_fraction, track.areas_px)
        assert shown[np.isin(track.frames, list(pictured))].max() >= 0.8 * shown.max()
    key, *alone = kept
    assert key.descriptor.any() and alone and all(k.jpeg for k in kept)
    assert not any(k.descriptor.any() or k.depth_small.size or k.keypoints_xy.size for k in alone)
    assert len(make_keyframes(frames, first, False, library=library)) == 1
    with Store.create(tmp_path / "room.l3r") as store, store.transaction():
        chunk = store.chunks.add(store.sessions.add("walk", "a", {}, 30), chunk_result(0, 0, 30, ()))
        store.keyframes.add(chunk, kept[1:])
        assert set(store.keyframes.with_picture(1)) == pictured - {0}
        assert store.keyframes.descriptors([1])[0][:, 1].tolist() == [0]


def test_lone_pixels_lose_their_label() -> None:
    labels = np.random.default_rng(1).integers(0, 3, (9, 7)).astype(np.int32)
    framed = np.pad(labels, 1, constant_values=-1)
    near = [framed[1 + y : 10 + y, 1 + x : 8 + x] for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y]
    kept, most = without_lone(labels)
    assert np.array_equal(most, np.max(near, axis=0))
    assert np.array_equal(kept, np.where(sum(n == labels for n in near) >= 3, labels, 0))

"""What several tests share: where the real sequences lie, and a small memory made by the store's own verbs."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from PIL import Image

from list3r.memory.core.geometry import OrientedBox, Sim3
from list3r.memory.core.records import (
    BestView,
    ChunkResult,
    FrameSamples,
    Instance,
    Keyframe,
    LocalInstance,
    LocalLibrary,
    MaskTrack,
    Observation,
    Relation,
    Support,
)
from list3r.memory.store.store import Store

THOROUGH = os.environ.get("LIST3R_TEST_PROFILE") == "thorough"
settings.register_profile("suite", max_examples=300 if THOROUGH else 40, deadline=None)
settings.load_profile("suite")

# What is made of memories here is nobody's: it goes when the tests end.
_CACHE = tempfile.TemporaryDirectory()
os.environ.setdefault("LIST3R_CACHE", _CACHE.name)

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real sequences beside the checkout; the test is skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"the real sequences are not at {DATA}")
    return DATA


def box_points(center: tuple[float, ...], size: tuple[float, ...], count: int, seed: int) -> np.ndarray:
    """Points on the surface of an axis-aligned box. Shape (count, 3)."""
    rng = np.random.default_rng(seed)
    unit = rng.uniform(-0.5, 0.5, (count, 3))
    face = rng.integers(0, 3, count)
    unit[np.arange(count), face] = np.sign(unit[np.arange(count), face]) * 0.5
    return (np.asarray(center) + unit * np.asarray(size)).astype(np.float32)


def local_instance(local_id: int, points: np.ndarray, rgb: tuple[int, int, int], frames: np.ndarray) -> LocalInstance:
    """A local instance with a mask of 10 x 20 px in every frame."""
    feature = np.random.default_rng(local_id).normal(size=16).astype(np.float32)
    count = len(frames)
    track = MaskTrack(
        frames=frames.astype(np.int64),
        boxes_xyxy=np.tile(np.array([[10, 20, 30, 30]], np.float32), (count, 1)),
        centers_xy=np.tile(np.array([[20, 25]], np.float32), (count, 1)),
        areas_px=np.full(count, 200, np.int32),
        visible_fraction=np.full(count, 0.9, np.float32),
        masks=tuple(np.array([20 * 64 + 10, 20], np.uint32) for _ in range(count)),
        image_size=(48, 64),
    )
    support = Support(points, np.full(len(points), 0.8, np.float32), np.tile(np.array(rgb, np.uint8), (len(points), 1)))
    return LocalInstance(local_id, track, feature / np.linalg.norm(feature), support, stability=0.9)


def chunk_result(
    index: int, first: int, count: int, instances: tuple[LocalInstance, ...], jpeg: bytes = b"", depth: float = 1.0
) -> ChunkResult:
    """A chunk whose camera stands at the origin looking along +x of a z-up world, moving 1 cm a frame along y; its
    keyframe sees a wall at a depth, or nothing at 0.
    """
    T_chunk_cam = np.tile(np.eye(4), (count, 1, 1))
    T_chunk_cam[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T_chunk_cam[:, 1, 3] = 0.01 * np.arange(count)
    frames = np.arange(first, first + count)
    keyframe = Keyframe(
        frame_index=first,
        T_chunk_cam=T_chunk_cam[0],
        descriptor=np.eye(8, dtype=np.float32)[index % 8],
        keypoints_xy=np.zeros((4, 2), np.float32),
        keypoint_descriptors=np.zeros((4, 32), np.uint8),
        points_cam=np.ones((4, 3), np.float32),
        depth_small=np.full((6, 8), depth, np.float32),
        camera_small=(8.0, 8.0, 4.0, 3.0),
        jpeg=jpeg,
    )
    samples = FrameSamples(
        frame=np.repeat(frames, 2),
        pixel=np.tile(np.array([5, 9], np.int32), count),
        points=np.random.default_rng(index).normal(size=(2 * count, 3)).astype(np.float32),
        confidence=np.ones(2 * count, np.float32),
        instance=np.full(2 * count, -1, np.int32),
        camera_frames=frames.astype(np.int64),
        T_chunk_cam=T_chunk_cam,
    )
    return ChunkResult(
        index=index,
        frame_indices=frames.astype(np.int64),
        times_s=frames / 30.0,
        posed=np.ones(count, bool),
        T_chunk_cam=T_chunk_cam,
        T_source_cam=None,
        intrinsics=(60.0, 60.0, 32.0, 24.0),
        image_size=(48, 64),
        scale_kind="metric",
        keyframes=(keyframe,),
        samples=samples,
        library=LocalLibrary(instances, np.zeros((0, 2), np.int32), "test@1/16"),
    )


def instance(
    id: int, center: tuple[float, ...], size: tuple[float, ...], rgb: tuple[int, int, int], **more: object
) -> Instance:
    """A global instance with an upright box."""
    c, s = np.asarray(center, float), np.asarray(size, float)
    fields: dict[str, object] = {
        "label": None,
        "description": f"thing {id}",
        "confidence": 0.9,
        "observations": 12,
        "first_seen_s": 0.0,
        "last_seen_s": 1.5,
        "state": "present",
        "structure": None,
        "color_name": "white",
        "component": 1,
        "best_view": BestView(1, 3, (10.0, 20.0, 30.0, 30.0)),
    }
    fields.update(more)
    return Instance(
        id=id,
        center=c,
        aabb=np.stack([c - s / 2, c + s / 2]),
        box=OrientedBox(c, s, np.eye(3)),
        color_rgb=rgb,
        **fields,  # type: ignore[arg-type]
    )


SMALL_ROOM: tuple[tuple[str, tuple[float, ...], tuple[float, ...], tuple[int, int, int], str | None], ...] = (
    ("floor", (2.0, 0.0, -0.01), (4.0, 4.0, 0.02), (120, 120, 120), "floor"),
    ("table", (2.0, 0.0, 0.36), (1.2, 0.8, 0.72), (150, 110, 70), None),
    ("mug", (1.8, 0.1, 0.77), (0.08, 0.08, 0.1), (240, 240, 240), None),
    ("mug", (2.2, -0.1, 0.77), (0.08, 0.08, 0.1), (240, 240, 235), None),
    ("chair", (2.0, 1.0, 0.45), (0.45, 0.45, 0.9), (90, 60, 30), None),
    ("wall", (4.0, 0.0, 1.25), (0.02, 4.0, 2.5), (220, 220, 210), "wall"),
)
"""A floor, a table with two twin mugs on it, a chair beside it, a wall: ids 1 to 6."""


@pytest.fixture
def make_memory(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a small finished memory, metric and upright, and gives its path."""

    def make(name: str = "room.l3r") -> Path:
        path = tmp_path / name
        with Store.create(path) as store, store.transaction():
            write_small_room(store)
        return path

    return make


def small_picture() -> bytes:
    """A JPEG of 64 x 48 px, grey with a brighter left half."""
    image = np.full((48, 64, 3), 90, np.uint8)
    image[:, :32] = 200
    out = io.BytesIO()
    Image.fromarray(image).save(out, format="JPEG")
    return out.getvalue()


def write_small_room(
    store: Store, jpeg: bytes = b"", *, frames: int = 20, points: int = 400, depth: float = 1.0
) -> None:
    """Fill an empty store with `SMALL_ROOM`, seen in one chunk of so many frames; the first may have a picture, and
    sees a wall before all else, or nothing at a depth of 0.
    """
    local = tuple(
        local_instance(k, box_points(center, size, points, k), rgb, np.arange(frames))
        for k, (_, center, size, rgb, _) in enumerate(SMALL_ROOM)
    )
    session = store.sessions.add("walk", "abc", {"length": 100}, frames)
    chunk = store.chunks.add(session, chunk_result(0, 0, frames, local, jpeg, depth))
    store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
    store.facts.scale_kind, store.facts.scale_source = "metric", "sensor depth"
    store.facts.gravity = "estimated"
    store.instances.put(
        instance(k + 1, center, size, rgb, structure=structure, component=chunk, label=None, description=name)
        for k, (name, center, size, rgb, structure) in enumerate(SMALL_ROOM)
    )
    store.observations.set(Observation(k + 1, chunk, k) for k in range(len(local)))
    store.embeddings.put("test@1/16", range(1, len(local) + 1), np.stack([i.feature for i in local]))
    store.relations.replace(
        None,
        [
            Relation(3, "on", 2, 0.95, 0.02),
            Relation(4, "on", 2, 0.94, 0.02),
            Relation(2, "on", 1, 0.9, 0.03),
            Relation(5, "next_to", 2, 0.8, 0.1),
        ],
    )
    store.sessions.complete(session)

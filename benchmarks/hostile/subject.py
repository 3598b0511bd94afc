"""A small memory with rows in every table, for `benchmarks/hardening.py` to falsify, damage and query."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import (
    ChangeEvent,
    DetectedLabel,
    Edge,
    LocalInstance,
    Observation,
    SessionCamera,
    Votes,
)
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from tests.conftest import (
    SMALL_ROOM,
    box_points,
    chunk_result,
    instance,
    local_instance,
    small_picture,
    write_small_room,
)

FRAMES, POINTS = 6, 80
"""Of each session, and of each instance: few, for thousands of commands read them."""


def write_subject(path: Path) -> Path:
    """Write two sessions of one room with edges, events, votes, labels, corrections and edits; a second in all."""
    with Store.create(path) as store:
        with store.transaction():
            write_small_room(store, small_picture(), frames=FRAMES, points=POINTS)
            _add_session(store)
        edits.label(store, 2, "mug")
        edits.merge(store, 3, 4)
        with store.transaction():
            _tell_changes(store)
    return path


def _add_session(store: Store) -> None:
    """The same room once more, two metres further down the same walk."""
    session = store.sessions.add("walk again", "def", {"length": 100}, FRAMES)
    chunk = store.chunks.add(session, chunk_result(1, 0, FRAMES, tuple(_seen()), small_picture()))
    store.chunks.place({chunk: Sim3.identity()}, {chunk: 1})
    edge = Edge(1, chunk, "loop", Sim3.identity(), 0.5, 0.5, 9, 0.01, True, "seen again", {"s_det": 0.5}, (0, 3))
    store.edges.add([edge, replace(edge, accepted=False, frames=(2, 5), reason="it contradicts the others")])
    store.observations.set(Observation(k + 1, chunk, k) for k in range(len(SMALL_ROOM)))
    store.bends.replace({chunk: Bend(np.array([0.0, FRAMES - 1.0]), np.zeros((2, 7)))})
    camera = SessionCamera((60.0, 60.0, 32.0, 24.0), (0.01, -0.02, 0.0, 0.0, 0.0), ("the camera was estimated",))
    store.sessions.put(
        replace(store.sessions.get(session), camera=camera, cuts=(7,), depth_step=1, lost_reasons=("too dark",))
    )
    store.sessions.complete(session)


def _seen() -> Iterable[LocalInstance]:
    for k, (_, center, size, rgb, _structure) in enumerate(SMALL_ROOM):
        yield local_instance(k, box_points(center, size, POINTS, k + 50), rgb, np.arange(FRAMES))


def _tell_changes(store: Store) -> None:
    ids = sorted(i.id for i in store.instances.all())
    box = instance(1, (1.0, 0.0, 0.4), (0.4, 0.4, 0.8), (90, 60, 30)).box
    kinds = (("moved", box, box), ("removed", box, None), ("added", None, box), ("seen_again", box, box))
    store.events.replace(
        ChangeEvent(2, n, kind, before, after, ((1, 3), (2, 4)), 0.9, "it stands elsewhere")
        for n, (kind, before, after) in zip(ids, kinds, strict=False)
    )
    store.votes.put(1, "net", {2: Votes(0.5, {"cup": (4.0, 16.0)}, 4.0)})
    store.detected_labels.replace({ids[2]: DetectedLabel("cup", 0.9, 3.0, "net")})


def write_source(folder: Path, frames: int = 4) -> Path:
    """Write a folder in the TUM layout, textured pictures of a wall 2 m away that moves sideways; depth in 1/5000 m."""
    rng = np.random.default_rng(0)
    wall = rng.integers(0, 255, (48, 64 + 2 * frames, 3), np.uint8)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in range(frames):
        Image.fromarray(wall[:, 2 * k : 2 * k + 64]).save(folder / "rgb" / f"{k}.0.png")
        Image.fromarray(np.full((48, 64), 10_000, np.uint16)).save(folder / "depth" / f"{k}.0.png")
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{k}.0 {kind}/{k}.0.png\n" for k in range(frames)))
    poses = "".join(f"{k}.0 {0.08 * k} 0 0 0 0 0 1\n" for k in range(frames))
    (folder / "groundtruth.txt").write_text(poses)
    (folder / "calibration.txt").write_text("50 50 31.5 23.5\n")
    return folder

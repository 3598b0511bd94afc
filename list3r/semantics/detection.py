"""Things get names: a box detector looks at frames of a memory, and its boxes vote (see `detection.voting`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame, FrameSource
from list3r.frames.decoding.decode import decode_rgb
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import OptionError
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import ChunkRow, JsonFields, MaskTrack, Votes
from list3r.memory.library.labels import LabelSettings, apply_labels, put_votes
from list3r.memory.store.store import Store
from list3r.semantics.detector import Detector
from list3r.semantics.voting import ThingInFrame, VotingSettings, summed, vote

LOOKS_PER_S = 5.0
"""Frames of a source looked at in a second: nearer ones show the same view and get the same boxes."""
Progress = Callable[[int, int], None]
"""Called with (chunks done, chunks in all)."""


@dataclass(frozen=True)
class DetectReport(JsonFields):
    """What a detector saw."""

    detector: str
    frames: int
    """Pictures looked at."""
    boxes: int
    """Of any score, also those that are too unsure to name anything by themselves."""
    labels: dict[int, str]
    """What things are called now by detectors, by id."""


def detect(
    store: Store,
    detector: Detector,
    sources: Mapping[int, FrameSource] | None = None,
    *,
    chunks: list[int] | None = None,
    voting: VotingSettings | None = None,
    labels: LabelSettings | None = None,
    progress: Progress | None = None,
) -> DetectReport:
    """Look at the frames of a memory and name its things, in one transaction.

    `sources` are the videos of sessions, by session id, whose frames are looked at; of the others the kept pictures of
    keyframes are. With `chunks` only those are looked at, and the votes of the others stay. Raises `OptionError` where
    there is no picture.
    """
    rows = [c for c in store.chunks.all() if chunks is None or c.chunk_id in chunks]
    watch = _Watch(store, detector, sources or {}, voting)
    with store.transaction():
        for done, chunk in enumerate(rows):
            if progress is not None:
                progress(done, len(rows))
            put_votes(store, chunk.chunk_id, detector.name, watch.votes(chunk), detector.class_names)
        if rows and not watch.pictures:
            raise OptionError(
                f"{store.path} keeps no pictures; name the video: list3r detect {store.path} --source {_source(store)}"
            )
        named = apply_labels(store, labels)
    if progress is not None:
        progress(len(rows), len(rows))
    return DetectReport(detector.name, watch.pictures, watch.boxes, {n: d.label for n, d in sorted(named.items())})


class _Watch:
    """A detector that looks at chunks one by one, at no frame twice."""

    def __init__(
        self, store: Store, detector: Detector, sources: Mapping[int, FrameSource], voting: VotingSettings | None
    ) -> None:
        self._store, self._detector, self._sources, self._voting = store, detector, sources, voting
        self._home = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
        self._in_session, self._in_chunk = _posed(store)
        metric = store.facts.scale_kind in ("metric", "anchored")
        self._sizes = {i.id: i.box.size for i in store.instances.all()} if metric else {}
        self._looked: set[tuple[int, int]] = set()
        self.pictures = self.boxes = 0

    def votes(self, chunk: ChunkRow) -> dict[int, Votes]:
        """What the detector says of the local instances of a chunk."""
        home = {n: i for (k, n), i in sorted(self._home.items()) if k == chunk.chunk_id}
        tracks = {n: self._store.local_instances.mask_track(chunk.chunk_id, n) for n in home}
        source, session = self._sources.get(chunk.session_id), chunk.session_id
        own = self._in_session.get(session, {}) if source is None else self._in_chunk.get(chunk.chunk_id, {})
        votes, last_s, region = [], -np.inf, _region(tracks)
        for index, color in _pictures(self._store, chunk, own, source):
            if (session, index) in self._looked:
                continue
            self._looked.add((session, index))
            found = self._detector(color)
            things = _seen(index, tracks, home, self._sizes)
            votes.append(vote(found, self._detector.class_names, things, own[index] - last_s, self._voting, region))
            last_s = own[index]
            self.pictures, self.boxes = self.pictures + 1, self.boxes + len(found.scores)
        return summed(votes)


def open_sources(store: Store, source: str | Path, options: SourceOptions | None = None) -> dict[int, FrameSource]:
    """The video of the last session that came from this source, opened; of a memory with one session, that one's.

    Raises `SourceError`, and `OptionError` for a source that no session came from.
    """
    opened = open_source(source, options)
    sessions = store.sessions.all()
    path = str(Path(opened.info.path).resolve())
    known = [s.session_id for s in sessions if s.source == path or s.fingerprint == opened.info.fingerprint]
    if not known and len(sessions) == 1:
        known = [sessions[0].session_id]
    if not known:
        raise OptionError(f"no session of {store.path} came from {source}; `list3r info {store.path}` lists them")
    return {known[-1]: opened}


def _posed(store: Store) -> tuple[dict[int, dict[int, float]], dict[int, dict[int, float]]]:
    """Seconds of the posed frames by Frame.index: of each session, and of each chunk."""
    in_session: dict[int, dict[int, float]] = {}
    in_chunk: dict[int, dict[int, float]] = {}
    for frame in store.frames.all():
        if frame.state == "posed":
            in_session.setdefault(frame.session_id, {})[frame.frame_index] = frame.time_s
            in_chunk.setdefault(frame.chunk_id, {})[frame.frame_index] = frame.time_s
    return in_session, in_chunk


def _pictures(
    store: Store, chunk: ChunkRow, own: Mapping[int, float], source: FrameSource | None
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Frame.index and picture of the frames to look at, of the `own` ones (index to seconds)."""
    if source is None:
        for keyframe in store.keyframes.of(chunk.chunk_id):
            image = decode_rgb(keyframe.jpeg)
            if image is not None and keyframe.frame_index in own:
                yield keyframe.frame_index, _fitting(image, chunk)
        return
    last = -np.inf
    positions = []
    for index, time_s in sorted(own.items()):
        if time_s >= last + 1.0 / LOOKS_PER_S - 1e-6:
            positions.append(source.position(index))
            last = time_s
    if not positions:
        return
    wanted = set(positions)
    for offset, frame in enumerate(source.read(positions[0], positions[-1] + 1)):
        if offset + positions[0] in wanted and isinstance(frame, Frame) and frame.index in own:
            if frame.color.shape[:2] != chunk.image_size:
                height, width = chunk.image_size
                raise OptionError(
                    f"frames of the source are {frame.color.shape[1]}x{frame.color.shape[0]}, those of {store.path} "
                    f"{width}x{height}; give the options that it was built with"
                )
            yield frame.index, frame.color


def _fitting(color: NDArray[np.uint8], chunk: ChunkRow) -> NDArray[np.uint8]:
    """A kept picture in the size of the frames."""
    height, width = chunk.image_size
    if color.shape[:2] != (height, width):
        color = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.ascontiguousarray(color)


def _seen(
    index: int, tracks: Mapping[int, MaskTrack], home: Mapping[int, int], sizes: Mapping[int, NDArray[np.float64]]
) -> list[ThingInFrame]:
    """The things that one frame shows; pieces of one thing together."""
    parts: dict[int, list[tuple[int, int]]] = {}
    for local_id, track in tracks.items():
        at = int(np.searchsorted(track.frames, index))
        if at < len(track.frames) and track.frames[at] == index and track.areas_px[at] > 0:
            parts.setdefault(home[local_id], []).append((local_id, at))
    out = []
    for instance_id, pieces in sorted(parts.items()):
        chosen = [(tracks[n], at) for n, at in pieces]
        areas = np.array([float(t.areas_px[at]) for t, at in chosen])
        boxes = np.array([t.boxes_xyxy[at] for t, at in chosen], np.float32)
        mask = np.any([decode_mask(t.masks[at], t.image_size) for t, at in chosen], axis=0)
        box = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
        visible = float((areas * [t.visible_fraction[at] for t, at in chosen]).sum() / areas.sum())
        shares = tuple((areas / areas.sum()).tolist())
        out.append(ThingInFrame(tuple(n for n, _ in pieces), shares, box, mask, visible, sizes.get(instance_id)))
    return out


def _region(tracks: Mapping[int, MaskTrack]) -> NDArray[np.float32] | None:
    """The part of the pictures that holds the masks of a chunk: left, top, right, bottom, px. Shape (4,)."""
    boxes = [t.boxes_xyxy[t.areas_px > 0] for t in tracks.values() if (t.areas_px > 0).any()]
    if not boxes:
        return None
    every = np.concatenate(boxes)
    return np.concatenate([every[:, :2].min(axis=0), every[:, 2:].max(axis=0)]).astype(np.float32)


def _source(store: Store) -> str:
    sessions = store.sessions.all()
    return sessions[-1].source if sessions else "VIDEO"

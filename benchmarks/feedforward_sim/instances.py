"""The instance library that a simulated tracker makes of a chunk: tracks that break, merge, leak, come late."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from benchmarks.feedforward_sim.descriptors import (
    FEATURE_SPACE,
    Appearance,
    EmbeddingSettings,
    azimuths,
    track_feature,
)
from benchmarks.feedforward_sim.mask_errors import MaskErrorSettings, exchanged, fragments, parted
from benchmarks.simulation.video import SimulatedVideo
from list3r.memory.core.masks import encode_mask
from list3r.memory.core.records import LocalInstance, LocalLibrary, MaskTrack, Support

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class InstanceErrorSettings:
    """Errors of mask tracks. Areas are of pictures of 64 x 48 pixels and scale with them."""

    small_px: float = 12.0
    """An object with so many pixels in its largest view is missed with a chance of 1/e, a larger one less."""
    least_px: int = 5
    """Masks smaller than this are not made."""
    least_frames: int = 4
    """Shorter tracks are dropped (paper 3.1)."""
    break_rate: float = 0.004
    """Chance at each frame that a track breaks and goes on under a new id."""
    gap_frames: int = 12
    """An object out of sight for longer comes back under a new id."""
    merge_share: float = 0.04
    """Chance that an object shares its track with one that it touches in the picture."""
    leak_rate: float = 0.01
    """Chance at each frame that a mask starts to spill over its border."""
    leak_frames: tuple[int, int] = (3, 12)
    """How long it does."""
    late_frames: float = 2.0
    """Mean of the frames that a track starts late and ends early."""
    structure_seen: float = 0.85
    """Share of walls, floors and ceilings that get a track."""
    structure_known: float = 0.9
    """Share of pieces of structure that are known as such."""
    structure_false: float = 0.01
    """Share of other objects that are taken for structure."""
    support_points: int = 300
    """Most support points of an instance."""
    masks: MaskErrorSettings = field(default_factory=MaskErrorSettings)
    """Further errors of discovery in unseen homes."""
    embedding: EmbeddingSettings = field(default_factory=EmbeddingSettings)


@dataclass(frozen=True)
class ChunkGeometry:
    """Reconstruction of a run of frames, in its own gauge."""

    frames: NDArray[np.int64]
    """Shape (F,)."""
    T_chunk_cam: NDArray[np.float64]
    """Shape (F, 4, 4)."""
    points: Floats
    """Chunk coordinates. Shape (F, H, W, 3)."""
    confidence: Floats
    """In [0, 1], 0 where nothing is known. Shape (F, H, W)."""


@dataclass(frozen=True)
class _Track:
    """A mask track to be."""

    ids: tuple[int, ...]
    positions: NDArray[np.int64]
    """Positions into the chunk's frames. Shape (V,)."""
    masks: Bools
    """Shape (V, H, W)."""
    structure: bool
    leaking: float
    """Share of its frames in which it leaks."""


def unseen_home_errors() -> InstanceErrorSettings:
    """Return the errors of discovery in homes that it never saw (research/discovery 0080): measured there are recall
    0.61 to 0.84, precision 0.35 to 0.85 by masks, 0.3 merged pairs and 0.04 duplicates for each object.
    """
    return InstanceErrorSettings(
        merge_share=0.2,
        masks=MaskErrorSettings(missed=0.15, split=0.15, swapped=0.05, fragments=0.3),
        embedding=EmbeddingSettings(noise=0.45, side_part=0.5, light_part=0.7),
    )


def simulate_library(
    video: SimulatedVideo, geometry: ChunkGeometry, settings: InstanceErrorSettings, seed: list[int]
) -> LocalLibrary:
    """The local instance library of a chunk."""
    rng = np.random.default_rng([*seed, 41])
    ids = video.ids[geometry.frames]
    tracks = _make_tracks(video, ids, geometry.points, settings, rng)
    model = Appearance(video, settings.embedding.size, settings.embedding.label_part, settings.embedding.own_part)
    light = int(video.lights()[geometry.frames[0]]) if len(geometry.frames) else 0
    colors = _in_light(_colors(video, model.top), light)
    azimuth = azimuths(video, model.top)[geometry.frames] if settings.embedding.side_part else None
    instances = tuple(
        _instance(number, track, ids, geometry, _Appearance(model, colors, azimuth, light), settings, rng)
        for number, track in enumerate(tracks)
    )
    return LocalLibrary(instances, _cannot_link(tracks, ids.shape), FEATURE_SPACE)


@dataclass(frozen=True)
class _Appearance:
    """Appearance of objects in a chunk."""

    appearance: Appearance
    colors: NDArray[np.uint8]
    """Of each object. Shape (T, 3)."""
    azimuth: NDArray[np.float64] | None
    """Direction from each object to each camera, radians; None where appearance does not depend on it. (F, T)."""
    light: int


def _make_tracks(
    video: SimulatedVideo,
    ids: NDArray[np.int32],
    points: Floats,
    settings: InstanceErrorSettings,
    rng: np.random.Generator,
) -> list[_Track]:
    top = int(ids.max(initial=0))
    areas = np.stack([np.bincount(i.ravel(), minlength=top + 1) for i in ids])
    structure = {t.id for t in video.world.objects if t.structure is not None}
    scale = ids.shape[1] * ids.shape[2] / (64 * 48)
    tracks: list[_Track] = []
    for group in _groups(ids, areas, structure, settings, rng):
        is_structure = group[0] in structure
        area = areas[:, list(group)].sum(axis=1)
        missed = rng.random() < np.exp(-float(area.max()) / (settings.small_px * scale))
        if is_structure:
            missed = rng.random() > settings.structure_seen
        known = rng.random() < (settings.structure_known if is_structure else settings.structure_false)
        if not is_structure and settings.masks.missed:
            missed = missed or rng.random() < settings.masks.missed
        if missed:
            continue
        for positions in _pieces(np.flatnonzero(area >= settings.least_px), settings, rng):
            whole = np.isin(ids[positions], group)
            loose = not is_structure and settings.masks.any()
            if loose:
                whole = exchanged(ids[positions], whole, structure, settings.masks, rng)
            for masks in parted(whole, points[positions], settings.masks, rng) if loose else [whole]:
                shown = masks.sum(axis=(1, 2)) >= (settings.least_px if loose else 1)
                if shown.sum() < (settings.least_frames if loose else 0):
                    continue
                leaks = _spill(masks, settings, rng)
                kept = (positions[shown], masks[shown]) if loose else (positions, masks)
                tracks.append(_Track(group, *kept, known, leaks))
    if settings.masks.fragments:
        count = round(settings.masks.fragments * sum(not t.structure for t in tracks))
        for positions, masks in fragments(ids, points, structure, count, settings.masks, rng):
            tracks.append(_Track((int(ids[positions][masks][0]),), positions, masks, False, 0.0))
    return tracks


def _groups(
    ids: NDArray[np.int32],
    areas: NDArray[np.int64],
    structure: set[int],
    settings: InstanceErrorSettings,
    rng: np.random.Generator,
) -> list[tuple[int, ...]]:
    """Ids that share a track: mostly one, at times an object and the one it touches most."""
    present = [int(k) for k in np.flatnonzero(areas.sum(axis=0)) if k > 0]
    taken: set[int] = set()
    out: list[tuple[int, ...]] = []
    for k in present:
        merges = rng.random() < settings.merge_share
        if k in taken:
            continue
        taken.add(k)
        other = _most_touched(ids, k, structure | taken) if merges and k not in structure else None
        if other is not None:
            taken.add(other)
        out.append((k,) if other is None else (k, other))
    return out


def _most_touched(ids: NDArray[np.int32], k: int, excluded: set[int]) -> int | None:
    a, b = ids[:, :, 1:], ids[:, :, :-1]
    c, d = ids[:, 1:], ids[:, :-1]
    around = np.concatenate([b[a == k], a[b == k], d[c == k], c[d == k]])
    count = np.bincount(around)
    count[0] = 0
    count[[n for n in excluded if n < len(count)]] = 0
    return int(count.argmax()) if len(count) and count.max() > 0 else None


def _pieces(
    positions: NDArray[np.int64], settings: InstanceErrorSettings, rng: np.random.Generator
) -> list[NDArray[np.int64]]:
    """Runs of one id: broken where the object was out of sight, and now and then without cause."""
    if not len(positions):
        return []
    broken = rng.random(len(positions) - 1) < settings.break_rate
    cuts = np.flatnonzero((np.diff(positions) > settings.gap_frames) | broken) + 1
    out = []
    for piece in np.split(positions, cuts):
        late, early = (int(n) for n in rng.exponential(settings.late_frames, 2))
        kept = piece[late : len(piece) - early]
        if len(kept) >= settings.least_frames:
            out.append(kept)
    return out


def _spill(masks: Bools, settings: InstanceErrorSettings, rng: np.random.Generator) -> float:
    """Let masks leak over their borders for runs of frames, in place; the share of frames that do."""
    leaking = np.zeros(len(masks), bool)
    for start in np.flatnonzero(rng.random(len(masks)) < settings.leak_rate):
        leaking[start : start + int(rng.integers(settings.leak_frames[0], settings.leak_frames[1] + 1))] = True
    size = 2 * max(1, round(masks.shape[2] / 64)) + 1
    kernel = np.ones((size, size), np.uint8)
    for k in np.flatnonzero(leaking):
        masks[k] = cv2.dilate(masks[k].view(np.uint8), kernel) > 0
    return float(leaking.mean())


def _instance(
    number: int,
    track: _Track,
    ids: NDArray[np.int32],
    geometry: ChunkGeometry,
    model: _Appearance,
    settings: InstanceErrorSettings,
    rng: np.random.Generator,
) -> LocalInstance:
    held = ids[track.positions][track.masks]
    count = np.bincount(held, minlength=model.appearance.top + 1)
    count[0] = 0
    share = {int(k): float(count[k]) / max(int(count.sum()), 1) for k in np.flatnonzero(count)}
    support, plane = _support(track, held, geometry, model.colors, settings, rng)
    seen_from = None if model.azimuth is None else {k: model.azimuth[track.positions, k] for k in share}
    return LocalInstance(
        local_id=number,
        track=_mask_track(track, geometry),
        feature=track_feature(model.appearance, share, settings.embedding, rng, model.light, seen_from),
        support=support,
        stability=float(np.clip(0.97 - 0.5 * track.leaking - 0.1 * rng.random(), 0, 1)),
        plane=plane if track.structure else None,
        structure=track.structure,
    )


def _mask_track(track: _Track, geometry: ChunkGeometry) -> MaskTrack:
    height, width = track.masks.shape[1:]
    area = track.masks.sum(axis=(1, 2))
    columns: Bools = np.asarray(track.masks.any(axis=1))
    rows: Bools = np.asarray(track.masks.any(axis=2))
    left, right = columns.argmax(axis=1), width - columns[:, ::-1].argmax(axis=1)
    top, bottom = rows.argmax(axis=1), height - rows[:, ::-1].argmax(axis=1)
    x = track.masks.sum(axis=1) @ np.arange(width) / area
    y = track.masks.sum(axis=2) @ np.arange(height) / area
    eyes = geometry.T_chunk_cam[track.positions][:, :3, 3]
    points = geometry.points[track.positions]
    away = np.array([np.linalg.norm(p[m].mean(axis=0) - e) for p, m, e in zip(points, track.masks, eyes, strict=True)])
    shown = area * away**2
    return MaskTrack(
        frames=geometry.frames[track.positions],
        boxes_xyxy=np.stack([left, top, right, bottom], axis=1).astype(np.float32),
        centers_xy=np.stack([x, y], axis=1).astype(np.float32),
        areas_px=area.astype(np.int32),
        visible_fraction=(shown / max(float(shown.max()), 1e-9)).astype(np.float32),
        masks=tuple(encode_mask(m) for m in track.masks),
        image_size=(height, width),
    )


def _support(
    track: _Track,
    held: NDArray[np.int32],
    geometry: ChunkGeometry,
    colors: NDArray[np.uint8],
    settings: InstanceErrorSettings,
    rng: np.random.Generator,
) -> tuple[Support, NDArray[np.float64] | None]:
    """Points of the masks, likelier where the model is sure, and the plane through them, seen from the cameras."""
    confidence = geometry.confidence[track.positions][track.masks]
    known = np.flatnonzero(confidence > 0)
    count = min(len(known), settings.support_points)
    if count == 0:
        return Support(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8)), None
    chance = confidence[known].astype(np.float64)
    pick = np.sort(rng.choice(known, count, replace=False, p=chance / chance.sum()))
    points = geometry.points[track.positions][track.masks][pick]
    support = Support(points, confidence[pick], colors[held[pick]])
    middle = points.mean(axis=0, dtype=np.float64)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][-1].astype(np.float64)
    eye = geometry.T_chunk_cam[track.positions][:, :3, 3].mean(axis=0)
    normal = normal if normal @ (eye - middle) > 0 else -normal
    return support, np.append(normal, -normal @ middle)


def _colors(video: SimulatedVideo, top: int) -> NDArray[np.uint8]:
    """Colour of each object: that of its first part. Shape (top + 1, 3)."""
    out = np.full((top + 1, 3), 128, np.uint8)
    for obj in video.world.objects:
        out[obj.id] = np.clip(obj.parts[0].material.color, 0, 255)
    return out


def _in_light(colors: NDArray[np.uint8], light: int) -> NDArray[np.uint8]:
    """Return colours under a light: any but the first is dim and warm."""
    return colors if light == 0 else (colors * np.array([0.62, 0.5, 0.36])).astype(np.uint8)


def _cannot_link(tracks: list[_Track], shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Pairs of tracks that show in one frame with masks that never overlap. Shape (P, 2)."""
    if not tracks:
        return np.zeros((0, 2), np.int32)
    size = shape[1] * shape[2]
    cells = [np.flatnonzero(t.masks) + np.repeat(t.positions, t.masks.sum(axis=(1, 2))) * size for t in tracks]
    cells = [c - (np.flatnonzero(t.masks) // size) * size for c, t in zip(cells, tracks, strict=True)]
    row = np.repeat(np.arange(len(tracks)), [len(c) for c in cells])
    pixels = csr_matrix((np.ones(len(row), np.int32), (row, np.concatenate(cells))), (len(tracks), shape[0] * size))
    present = np.zeros((len(tracks), shape[0]), np.int32)
    for k, track in enumerate(tracks):
        present[k, track.positions] = 1
    apart = (present @ present.T > 0) & (csr_matrix(pixels @ pixels.T).toarray() == 0)
    return np.argwhere(np.triu(apart, 1)).astype(np.int32)

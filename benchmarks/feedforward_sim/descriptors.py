"""Appearance in a simulated network: embeddings of instances and descriptors of whole frames.

Two objects of one class of appearance (twins) share their embedding but for a small own part. A frame's descriptor sums
its content, so that twin rooms from similar viewpoints are similar and one place from another side is not, as the paper
reports of frame similarity (A.2). The defaults match the published cosines of trained place recognition. Measured on
seed 101 of six presets (10 to 90 % of the pairs): consecutive frames 0.95 and more; revisits with more than half of the
picture shared 0.7 to 0.97, with a twentieth to a half 0.3 to 0.9; places that share nothing 0.0 to 0.65, but up to 0.98
in twin rooms, where most pairs of 0.85 and more are false.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.feedforward_sim.runs import runs_of
from benchmarks.simulation.video import SimulatedVideo

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

FEATURE_SPACE = "simulated@1/32"
"""Embedding space of instance features."""


@dataclass(frozen=True)
class EmbeddingSettings:
    """Features of instances."""

    size: int = 32
    label_part: float = 0.6
    """Part of a class of appearance that all objects of its label share, of unit length."""
    own_part: float = 0.25
    """Length of an object's own part, against unit length of the part shared with its twins."""
    noise: float = 0.3
    """Length of the noise of each track's feature."""
    side_part: float = 0.0
    """Part of the appearance that depends on the side an object is seen from, of unit length."""
    light_part: float = 0.0
    """Part that another light than the first one replaces, of unit length."""


@dataclass(frozen=True)
class FrameDescriptorSettings:
    """Descriptors of frames."""

    size: int = 64
    content: float = 0.7
    """Length of the content, anywhere in the picture."""
    arrangement: float = 0.62
    """Length of the content by place in the picture and viewing direction."""
    common: float = 0.4
    """Length of the part shared by all indoor pictures."""
    noise: float = 0.14
    """Length of the noise that lasts over frames (blur, exposure, people)."""
    noise_frame: float = 0.05
    """Length of each frame's own noise."""
    structure_weight: float = 0.5
    """Weight of walls, floors and ceilings, which are plain, against objects of the same area."""
    side_part: float = 0.5
    """Part of an object's appearance in the arrangement that depends on the side it is seen from, of unit length."""
    light_part: float = 0.0
    """Part of the content that another light replaces, of unit length."""


class Appearance:
    """Embeddings of the objects of a video, one for each id."""

    def __init__(self, video: SimulatedVideo, size: int, label_part: float, own_part: float) -> None:
        labels = {t.id: t.label for t in video.world.objects} | {m.id: m.label for m in video.movers}
        words = {label: k for k, label in enumerate(sorted(set(labels.values())))}
        self.top = max([int(video.ids.max(initial=0)), *labels])
        self.classes = np.array([video.classes.get(k, 10_000 + k) for k in range(self.top + 1)])
        self.shared = np.zeros((self.top + 1, size))
        self.full = np.zeros((self.top + 1, size))
        rest = np.sqrt(1 - label_part**2)
        for k in range(1, self.top + 1):
            word = words.get(labels.get(k, ""), len(words))
            shared = label_part * _unit([video.seed, 31, word], size) + rest * _unit(
                [video.seed, 32, self.classes[k]], size
            )
            self.shared[k] = shared / np.linalg.norm(shared)
            self.full[k] = self.shared[k] + own_part * _unit([video.seed, 33, k], size)
        self._size, self._seed = size, video.seed

    def lit(self, vectors: Array, light: int, part: float) -> Array:
        """Return appearances (top + 1, D) as they are in a light: another than the first replaces a part of them."""
        if light == 0 or part == 0.0:
            return vectors
        fresh = {int(v): _unit([self._seed, 38, light, v], self._size) for v in set(self.classes.tolist())}
        change = np.stack([fresh[int(v)] for v in self.classes])
        return np.asarray(
            np.sqrt(1 - part**2) * vectors + part * change * (np.linalg.norm(vectors, axis=1) > 0)[:, None]
        )

    def side(self, k: int, azimuth: Array) -> Array:
        """Return an object's appearance, the mean over directions (V,). Shape (D,)."""
        turns = np.stack([np.cos(azimuth), np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)], axis=-1)
        return np.asarray(turns.mean(axis=0) @ _waves([self._seed, 39, int(self.classes[k])], self._size))


def track_feature(
    appearance: Appearance,
    share: dict[int, float],
    settings: EmbeddingSettings,
    rng: np.random.Generator,
    light: int = 0,
    azimuth: dict[int, Array] | None = None,
) -> Floats:
    """Unit-length feature of a mask track that holds objects in the given shares of its area. Shape (D,).

    `azimuth` has the directions, radians, from which each of them was seen in the track's frames.
    """
    full = appearance.lit(appearance.full, light, settings.light_part)
    seen = {k: full[k] for k in share}
    if settings.side_part and azimuth is not None:
        rest = np.sqrt(1 - settings.side_part**2)
        seen = {k: rest * v + settings.side_part * appearance.side(k, azimuth[k]) for k, v in seen.items()}
    z = sum(part * seen[k] for k, part in share.items()) / max(sum(share.values()), 1e-9)
    z = z + settings.noise * rng.standard_normal(settings.size) / np.sqrt(settings.size)
    return np.asarray(z / np.linalg.norm(z), np.float32)


def frame_descriptors(video: SimulatedVideo, settings: FrameDescriptorSettings, seed: int) -> Floats:
    """Unit-length descriptors of all frames of a video. Shape (F, D)."""
    count, size = len(video.ids), settings.size
    model = Appearance(video, size, 0.5, 0.0)
    areas = _areas(video, model.top)
    structure = np.zeros(model.top + 1, bool)
    structure[[t.id for t in video.world.objects if t.structure is not None]] = True
    amount = np.sqrt(areas) * np.where(structure, settings.structure_weight, 1.0)
    amount[..., 0] = 0.0
    content, arrangement = np.zeros((count, size)), np.zeros((count, size))
    lights = video.lights()
    azimuth = azimuths(video, model.top)
    for light in sorted(set(lights.tolist())):
        rows = lights == light
        shown = model.lit(model.shared, light, settings.light_part)
        content[rows] = _normalised(np.sqrt((amount[rows] ** 2).sum(axis=1)) @ shown)
        arrangement[rows] = _normalised(_arranged(video, amount[rows], azimuth[rows], model, shown, settings))
    rng = np.random.default_rng([seed, video.seed, 34])
    lasting = rng.standard_normal((count, size))
    for run in runs_of(np.arange(count)):
        lasting[run] = gaussian_filter1d(lasting[run], 10.0, axis=0, mode="wrap")
    out = settings.content * content + settings.arrangement * arrangement + settings.common * _unit([35], size)
    out += settings.noise * _normalised(lasting) + settings.noise_frame * _normalised(
        rng.standard_normal((count, size))
    )
    return _normalised(out).astype(np.float32)


def _arranged(
    video: SimulatedVideo,
    amount: Array,
    azimuth: Array,
    model: Appearance,
    shown: Array,
    settings: FrameDescriptorSettings,
) -> Array:
    """Sum over objects and parts of the picture of their appearance from the visible side, mixed by part. (F, D)."""
    size, part = settings.size, settings.side_part
    seeds = sorted({int(v) for v in model.classes})
    waves = {v: _waves([video.seed, 36, v], size) for v in seeds}
    table = np.stack([waves[int(v)] for v in model.classes])
    turns = np.stack([np.cos(azimuth), np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)], axis=-1)
    side = np.einsum("ftk,tkd->ftd", turns, table)
    seen = np.sqrt(1 - part**2) * shown[None] + part * side
    mix = np.stack([_orthogonal([37, k], size) for k in range(amount.shape[1])])
    by_part = np.einsum("fpt,ftd->fpd", amount, seen)
    return np.asarray(np.einsum("fpd,pde->fe", by_part, mix))


def _areas(video: SimulatedVideo, top: int) -> Array:
    """Shares of the picture that objects fill in its six parts (two rows of three), softly. Shape (F, 6, top + 1)."""
    count, height, width = video.ids.shape
    column = (np.arange(width) + 0.5) / width * 3 - 0.5
    row = (np.arange(height) + 0.5) / height * 2 - 0.5
    across = np.clip(1 - np.abs(np.clip(column, 0, 2)[None] - np.arange(3)[:, None]), 0, 1)
    down = np.clip(1 - np.abs(np.clip(row, 0, 1)[None] - np.arange(2)[:, None]), 0, 1)
    weight = np.einsum("rh,cw->rchw", down, across).reshape(6, -1) / (height * width)
    out = np.zeros((count, 6, top + 1))
    for k, ids in enumerate(video.ids.reshape(count, -1)):
        for part in range(6):
            out[k, part] = np.bincount(ids, weight[part], minlength=top + 1)
    return out


def azimuths(video: SimulatedVideo, top: int) -> Array:
    """Direction from each object to the camera in the object's own frame, radians about its upright. (F, top + 1)."""
    parts, cut = [], video.cuts[0] if video.later is not None else len(video.time_s)
    for world, rows in ((video.world, slice(0, cut)), (video.later or video.world, slice(cut, None))):
        place, yaw = np.zeros((top + 1, 2)), np.zeros(top + 1)
        round_ = np.zeros(top + 1, bool)
        for obj in world.objects:
            place[obj.id], yaw[obj.id], round_[obj.id] = obj.box().center[:2], obj.yaw, obj.is_round()
        away = video.T_world_cam[rows, None, :2, 3] - place[None]
        azimuth = np.arctan2(away[..., 1], away[..., 0]) - yaw
        parts.append(np.where(round_, 0.0, azimuth))
    return np.concatenate(parts)


def _waves(seed: list[int], size: int) -> Array:
    """Coefficients of a smooth function on the circle of unit mean square length. Shape (4, size)."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.standard_normal((4, size)) * np.array([[0.8], [0.8], [0.6], [0.6]]) / np.sqrt(size))


def _orthogonal(seed: list[int], size: int) -> Array:
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))
    return np.asarray(q * np.sign(np.diag(r)))


def _unit(seed: list[int], size: int) -> Array:
    v = np.random.default_rng([int(n) for n in seed]).standard_normal(size)
    return np.asarray(v / np.linalg.norm(v))


def _normalised(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9))

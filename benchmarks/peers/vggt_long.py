"""VGGT-Long's association of chunks, reimplemented from its published code (DengKaiCQ/VGGT-Long, 6b9f61f).

Pi-Long (DengKaiCQ/Pi-Long, ae567d9) uses the same code: its loop selection, loop windows and optimiser are those files,
its alignment the same rounds in single precision on a GPU. Only the network differs, and its confidences are in [0, 1],
as those of the samples here. So one row is for both.

Parts, with the file: loop selection (LoopModels/LoopModel.py), windows and one loop a pair of chunks
(loop_utils/sim3utils.py, vggt_long.py), alignment of point maps (sim3utils.py), loop edges through a joint window
(vggt_long.py) and the optimiser (loop_utils/sim3loop.py, fastloop/solve_python.py). `base_config.yaml` has the
settings. Lengths are those of the reconstruction, as there.

Two differences: point maps are the samples on nested pixel grids of every variant of the benchmark, not all pixels;
chunks without shared frames, which exist only where cuts are given, get no edge, as in the published code.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.shared_points import shared_samples
from list3r.association.paper.plain_alignment import ratio_of_radii
from list3r.association.revisits.joint_window import JointReconstructor
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VggtLongSettings:
    """The values of its configs/base_config.yaml."""

    least_similarity: float = 0.85
    """Cosine of two frames above which they may close a loop."""
    neighbours: int = 5
    """Most similar frames that are considered for each frame."""
    least_gap: int = 10
    """Frames nearer in time are no loop."""
    suppressed: int = 25
    """Frames on either side of a loop's ends in which no other loop may end."""
    half_window: int = 10
    """Frames of a joint window on either side of a loop's end."""
    confidence_share: float = 0.1
    """Points count from this share of the lesser median confidence on."""
    huber: float = 0.1
    """Residual above which a point counts less, units of the target chunk."""
    rounds: int = 5
    """Reweighted alignments after the first."""
    tolerance: float = 1e-9
    iterations: int = 30
    """Of the optimiser (Levenberg-Marquardt)."""
    damping: float = 1e-6


class Chunk(Protocol):
    """Input of a chunk."""

    @property
    def frame_indices(self) -> NDArray[np.int64]: ...

    @property
    def samples(self) -> FrameSamples: ...


@dataclass(frozen=True)
class LoopWindow:
    """A loop between two chunks, and the frames of its joint window."""

    chunk_a: int
    frames_a: tuple[int, int]
    """First frame and the one after the last."""
    chunk_b: int
    frames_b: tuple[int, int]


@dataclass(frozen=True)
class LoopEdge:
    """The measured relation of a loop."""

    window: LoopWindow
    S_b_a: Sim3


def place(
    chunks: Sequence[Chunk],
    descriptors: NDArray[np.float32],
    joint: JointReconstructor,
    settings: VggtLongSettings | None = None,
) -> tuple[list[Sim3], list[LoopEdge], list[bool]]:
    """Place all chunks; their `S_world_chunk`, the loops, and whether each chunk shares frames with the one before.

    `descriptors` are unit vectors of all frames, shape (F, D). The first chunk is the world.
    """
    s = settings or VggtLongSettings()
    spans = [(int(c.frame_indices[0]), int(c.frame_indices[-1]) + 1) for c in chunks]
    sequential, tied = [], [False]
    for before, after in pairwise(chunks):
        shared = bool(len(shared_samples(before.samples, after.samples)[0]))
        sequential.append(align(before.samples, after.samples, s) if shared else Sim3.identity())
        tied.append(shared)
    loops = []
    for window in loop_windows(spans, find_loops(descriptors, s), s):
        made = joint(1, range(*window.frames_a), 1, range(*window.frames_b))
        if made is None:
            continue
        S_a_joint = align(chunks[window.chunk_a].samples, made.u, s)
        S_b_joint = align(chunks[window.chunk_b].samples, made.v, s)
        loops.append(LoopEdge(window, S_b_joint @ S_a_joint.inverse()))
    placed = [Sim3.identity()]
    for S in sequential:
        placed.append(placed[-1] @ S)
    kept = [n for n, is_tied in enumerate(tied) if n and is_tied]
    constraints = [(n - 1, n, sequential[n - 1]) for n in kept]
    constraints += [(e.window.chunk_b, e.window.chunk_a, e.S_b_a) for e in loops]
    return (optimise(placed, constraints, s) if loops else placed), loops, tied


def find_loops(descriptors: NDArray[np.float32], settings: VggtLongSettings) -> list[tuple[int, int]]:
    """Return pairs of similar frames (later, earlier), the most similar first, thinned globally."""
    similarity = descriptors.astype(np.float64) @ descriptors.astype(np.float64).T
    found: dict[tuple[int, int], float] = {}
    for i in range(len(similarity)):
        nearest = np.argsort(-similarity[i], kind="stable")[1 : settings.neighbours + 1]
        for j in nearest.tolist():
            if similarity[i, j] > settings.least_similarity and abs(i - j) > settings.least_gap:
                found[min(i, j), max(i, j)] = float(similarity[i, j])
    ranked = sorted(found, key=lambda pair: (-found[pair], pair))
    return [(later, earlier) for earlier, later in _thinned(ranked, settings.suppressed)]


def _thinned(ranked: Sequence[tuple[int, int]], reach: int) -> list[tuple[int, int]]:
    """Return the pairs with no end near an end of a better one; an end's reach stops at the pair's other end."""
    suppressed: set[int] = set()
    kept = []
    for earlier, later in ranked:
        if earlier in suppressed or later in suppressed:
            continue
        kept.append((earlier, later))
        suppressed.update(range(max(0, earlier - reach), min(earlier + reach + 1, later)))
        suppressed.update(range(max(earlier + 1, later - reach), later + reach + 1))
    return kept


def loop_windows(
    spans: Sequence[tuple[int, int]], loops: Sequence[tuple[int, int]], settings: VggtLongSettings
) -> list[LoopWindow]:
    """Return the joint windows of loops, one for each ordered pair of different chunks: the first, most alike one."""
    starts = [start for start, _ in spans]
    windows: dict[tuple[int, int], LoopWindow] = {}
    for frame_a, frame_b in loops:
        a, b = bisect_right(starts, frame_a) - 1, bisect_right(starts, frame_b) - 1
        if a != b and (a, b) not in windows:
            ranges = (_window(spans[a], frame_a, settings), _window(spans[b], frame_b, settings))
            windows[a, b] = LoopWindow(a, ranges[0], b, ranges[1])
    return list(windows.values())


def _window(span: tuple[int, int], frame: int, settings: VggtLongSettings) -> tuple[int, int]:
    """Return the frames about one, moved to be within its chunk."""
    (start, stop), half = span, settings.half_window
    if frame - half < start:
        return start, min(stop, start + 2 * half)
    if frame + half > stop:
        return max(start, stop - 2 * half), stop
    return frame - half, frame + half


def align(target: FrameSamples, source: FrameSamples, settings: VggtLongSettings) -> Sim3:
    """Estimate `S_target_source` from the pixels that both hold: Huber weights on confidence, scale by root mean
    square radii, float64 where the published code has float32.

    Raises `ValueError` where no pixel is confident in both.
    """
    at, of = shared_samples(target, source)
    confidence_t, confidence_s = target.confidence[at].astype(float), source.confidence[of].astype(float)
    medians = [np.median(side.confidence[np.isin(side.frame, target.frame[at])]) for side in (target, source)]
    sure = (confidence_t > settings.confidence_share * min(medians)) & (
        confidence_s > settings.confidence_share * min(medians)
    )
    if not sure.any():
        raise ValueError("no pixel is confident in both point maps")
    p, q = source.points[of][sure].astype(np.float64), target.points[at][sure].astype(np.float64)
    return robust_similarity(p, q, np.sqrt(confidence_t * confidence_s)[sure], settings)


def robust_similarity(source: Array, target: Array, weight: Array, settings: VggtLongSettings) -> Sim3:
    """Estimate `S_target_source` of corresponding points. Shapes (N, 3), (N, 3), (N,)."""
    S = ratio_of_radii(source, target, weight, metric=False)
    previous = np.inf
    for _ in range(settings.rounds):
        residual = np.linalg.norm(target - S.apply(source), axis=1)
        large = residual > settings.huber
        down = np.where(large, settings.huber / np.maximum(residual, 1e-300), 1.0)
        new = ratio_of_radii(source, target, weight * down, metric=False)
        change = abs(float(new.scale - S.scale)) + float(np.linalg.norm(new.translation - S.translation))
        angle = np.arccos(np.clip((np.trace(new.rotation @ S.rotation.T) - 1) / 2, -1, 1))
        loss = np.where(large, settings.huber * (residual - 0.5 * settings.huber), 0.5 * residual**2)
        cost = float((loss * weight).sum())
        still = change < settings.tolerance and angle < np.radians(0.1)
        if still or abs(previous - cost) < settings.tolerance * previous:
            break
        S, previous = new, cost
    return S


def optimise(
    placed: Sequence[Sim3], constraints: Sequence[tuple[int, int, Sim3]], settings: VggtLongSettings
) -> list[Sim3]:
    """Return the places that fit the constraints (i, j, S_i_j) best, all of one weight and none robust.

    A residual is log(S_i_j G_j G_i^-1) of inverse poses G, as published; the other way round it would weigh shifts in
    another frame.

    Levenberg-Marquardt on the logarithms of the inverse poses, to which steps are added; the damping halves where a
    step helps and doubles where it does not. Every pose is free; the first one is put back to where it was.
    """
    i, j = (np.array([c[k] for c in constraints]) for k in (0, 1))
    measured = _stack([c[2] for c in constraints])
    x = _stack(placed).inverse().log()

    def residual(x: Array, rows: NDArray[np.int64] | slice = slice(None)) -> Array:
        inverse = Sim3.exp(x)
        C = Sim3(measured.scale[rows], measured.rotation[rows], measured.translation[rows])
        return (C @ _at(inverse, j[rows]) @ _at(inverse, i[rows]).inverse()).log()

    damping, costs = settings.damping, []
    for round_ in range(settings.iterations):
        r = residual(x)
        cost = float((r**2).mean())
        costs.append(cost)
        J = _jacobian(residual, x, i, j)
        A = J.T @ J
        step = np.linalg.lstsq(A + damping * np.diag(np.diag(A)), -J.T @ r.ravel(), rcond=None)[0]
        tried = x + step.reshape(x.shape)
        if float((residual(tried) ** 2).mean()) < cost:
            x, damping = tried, damping / 2
        else:
            damping *= 2
        if cost < 1e-5 and round_ >= 4 and costs[-5] < 1.5 * costs[-1]:
            break
    found = Sim3.exp(x).inverse()
    back = placed[0] @ _at(found, 0).inverse()
    return [back @ _at(found, n) for n in range(len(placed))]


def _jacobian(residual: object, x: Array, i: NDArray[np.int64], j: NDArray[np.int64]) -> Array:
    """Return the derivatives of all residuals by all parameters, by central differences. Shape (7 E, 7 N)."""
    step = 1e-6
    J = np.zeros((len(i), 7, *x.shape))
    for n in range(len(x)):
        rows = np.flatnonzero((i == n) | (j == n))
        for k in range(7 if len(rows) else 0):
            ahead, behind = x.copy(), x.copy()
            ahead[n, k] += step
            behind[n, k] -= step
            J[rows, :, n, k] = (residual(ahead, rows) - residual(behind, rows)) / (2 * step)  # type: ignore[operator]
    return J.reshape(7 * len(i), -1)


def _stack(similarities: Sequence[Sim3]) -> Sim3:
    parts = ([getattr(S, name) for S in similarities] for name in ("scale", "rotation", "translation"))
    return Sim3(*(np.stack([np.asarray(x, np.float64) for x in part]) for part in parts))


def _at(S: Sim3, rows: NDArray[np.int64] | int) -> Sim3:
    return Sim3(S.scale[rows], S.rotation[rows], S.translation[rows])

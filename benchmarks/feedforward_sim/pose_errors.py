"""Errors of the poses that a simulated feed-forward model gives to the frames it reconstructs together.

The error of a reconstruction is the uncertainty of its observations. Shared surfaces constrain frames, so the errors
are drawn from the Gaussian whose precision is the Laplacian of the covisibility graph, in twists of Sim(3): parts of a
chunk that see the same agree, a long chain of views bends and drifts in scale, two sides of a joint window are related
the worse the less they share, and the relation of sides that share nothing is imagined (`placements`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.csgraph import connected_components

from benchmarks.feedforward_sim.runs import runs_of
from benchmarks.simulation.video import SimulatedVideo
from list3r.memory.core.geometry import Sim3, rotation_exp, skew

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseErrorSettings:
    """Errors of poses and of the scale of each frame's geometry.

    The three of `bend_` were set together so that a chunk of 100 frames and a chain of chunks err as published (see
    `feedforward`); their ratios are those of views of a scene: a turn of 0.18 degrees shifts points 2.3 m away by 7 mm,
    0.3 % of the depth, about as much as the shift and the scale.
    """

    bend_deg: float = 0.18
    """Deviation of the rotation between views of the same surface, about its middle."""
    bend_shift: float = 0.0022
    """The same for the shift, as a share of the depth."""
    bend_scale: float = 0.0036
    """The same for the logarithm of scale."""
    bending: float = 1.0
    """Factor on all three; 0 for poses without bending."""
    least_covisibility: float = 0.05
    """Frames that share less are not tied to each other."""
    jitter_deg: float = 0.05
    """Deviation of each frame's own rotation."""
    jitter_shift: float = 0.001
    """Deviation of each frame's own shift, as a share of the depth."""
    glitch_rate: float = 0.004
    """Chance at each frame that a run of wrong and yet confident frames starts."""
    glitch_frames: tuple[int, int] = (2, 6)
    """Length of such a run."""
    glitch_deg: float = 2.0
    glitch_shift: float = 0.02
    """Deviation of the error of such a run; the shift as a share of the depth."""
    alike_radius_m: float = 0.3
    """Look-alike objects within so far of each other become one object in an imagined relation."""
    alike_least_score: float = 0.25
    """Least weight of objects that fall on look-alikes, in square roots of shares of the picture, for that."""
    imagined_deg: float = 2.0
    imagined_shift_m: float = 0.03
    imagined_scale: float = 0.03
    """Deviation of an imagined relation that aligns look-alikes; the scale's of its logarithm."""
    unmoved_deg: float = 10.0
    unmoved_shift_m: float = 0.15
    unmoved_scale: float = 0.25
    """The same for a camera assumed still, without look-alikes."""


def bend(T_world_cam: Array, depth_m: Array, covisibility: Array, settings: PoseErrorSettings, seed: list[int]) -> Sim3:
    """Errors E of frames, p_wrong = E p, as similarities of the world. Batched (F,).

    `T_world_cam` has shape (F, 4, 4), `depth_m` (F,) the middle depth of each frame, `covisibility` (F, F).
    """
    rng = np.random.default_rng([*seed, 11])
    count = len(T_world_cam)
    if settings.bending == 0 or count < 2:
        return Sim3.exp(np.zeros((count, 7)))
    origin = T_world_cam[:, :3, 3].mean(axis=0)
    to_pivot = _world_to_pivot(T_world_cam, depth_m, origin)
    sigma = np.array([settings.bend_shift] * 3 + [np.deg2rad(settings.bend_deg)] * 3 + [settings.bend_scale])
    unit = np.ones((count, 7))
    unit[:, :3] = depth_m[:, None]
    whitened = to_pivot / (unit * sigma)[:, :, None]
    weight = _ties(covisibility, settings.least_covisibility)
    twists = settings.bending * _smooth(_draw(whitened, weight, rng), covisibility, settings.least_covisibility)
    about = Sim3(np.ones(()), np.eye(3), origin)
    return about @ Sim3.exp(twists) @ about.inverse()


def jitter(depth_m: Array, frames: NDArray[np.int64], settings: PoseErrorSettings, seed: list[int]) -> Sim3:
    """Errors of single frames and of short runs of frames, as rigid motions of their cameras. Batched (F,)."""
    rng = np.random.default_rng([*seed, 12])
    count = len(frames)
    turn = np.deg2rad(settings.jitter_deg) * rng.standard_normal((count, 3))
    shift = settings.jitter_shift * depth_m[:, None] * rng.standard_normal((count, 3))
    for run in runs_of(frames):
        for start in range(run.start, run.stop):
            length = int(rng.integers(settings.glitch_frames[0], settings.glitch_frames[1] + 1))
            off = rng.standard_normal(6)
            if rng.random() < settings.glitch_rate:
                wrong = slice(start, min(start + length, run.stop))
                turn[wrong] += np.deg2rad(settings.glitch_deg) * off[:3]
                shift[wrong] += settings.glitch_shift * depth_m[wrong, None] * off[3:]
    return Sim3(np.ones(count), rotation_exp(turn), shift)


def sides(covisibility: Array, settings: PoseErrorSettings) -> NDArray[np.int64]:
    """Number of the side of each frame: frames connected by shared surfaces, directly or through others. Shape (F,)."""
    _, side = connected_components(covisibility >= settings.least_covisibility, directed=False)
    _, first = np.unique(side, return_index=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[side])


def placements(
    video: SimulatedVideo,
    frames: NDArray[np.int64],
    side: NDArray[np.int64],
    descriptors: NDArray[np.float32],
    settings: PoseErrorSettings,
    seed: list[int],
) -> Sim3:
    """The model's placement of each frame's side, as similarities of the world. Batched (F,). The first side is right.
    Another is aligned with the earlier ones by look-alike objects; with too few of them the camera is assumed still
    between the two most similar frames.
    """
    rng = np.random.default_rng([*seed, 13])
    placed = [Sim3.identity()]
    for number in range(1, int(side.max(initial=0)) + 1):
        here = frames[side == number]
        noise = settings.imagined_deg, settings.imagined_shift_m, settings.imagined_scale
        pivot = video.T_world_cam[here][:, :3, 3].mean(axis=0)
        found, best = None, settings.alike_least_score
        for before in range(number):
            S, score = _align_look_alikes(video, frames[side == before], here, settings)
            if score > best:
                found, best = placed[before] @ S, score
        if found is None:
            noise = settings.unmoved_deg, settings.unmoved_shift_m, settings.unmoved_scale
            found, pivot = _unmoved(video, frames, side, number, descriptors, placed)
        placed.append(found @ _noise_about(pivot, noise, rng))
    every = [placed[s] for s in side]
    return Sim3(
        *(np.stack([np.asarray(getattr(p, name)) for p in every]) for name in ("scale", "rotation", "translation"))
    )


def _unmoved(
    video: SimulatedVideo,
    frames: NDArray[np.int64],
    side: NDArray[np.int64],
    number: int,
    descriptors: NDArray[np.float32],
    placed: list[Sim3],
) -> tuple[Sim3, Array]:
    """The motion that aligns the cameras of the two most similar frames; the second's place."""
    before, here = np.flatnonzero(side < number), np.flatnonzero(side == number)
    cosine = descriptors[before] @ descriptors[here].T
    a, b = np.unravel_index(int(np.argmax(cosine)), cosine.shape)
    T_a, T_b = (Sim3.from_matrix(video.T_world_cam[frames[n]]) for n in (before[a], here[b]))
    return placed[int(side[before[a]])] @ T_a @ T_b.inverse(), T_b.translation


def _noise_about(pivot: Array, noise: tuple[float, float, float], rng: np.random.Generator) -> Sim3:
    degrees, shift_m, scale = noise
    x = rng.standard_normal(7) * np.array([shift_m] * 3 + [np.deg2rad(degrees)] * 3 + [scale])
    about = Sim3(np.ones(()), np.eye(3), pivot)
    return about @ Sim3.exp(x) @ about.inverse()


def _align_look_alikes(
    video: SimulatedVideo, frames_a: NDArray[np.int64], frames_b: NDArray[np.int64], settings: PoseErrorSettings
) -> tuple[Sim3, float]:
    """The upright motion that aligns most of side b's content with look-alikes of side a, and its amount."""
    a, b = _weights(video, frames_a), _weights(video, frames_b)
    moving = {m.id for m in video.movers}
    objects = {t.id: t for t in video.world.objects if t.structure is None and t.id not in moving}
    one, two = [k for k in sorted(a) if k in objects], [k for k in sorted(b) if k in objects]
    best, found = 0.0, Sim3.identity()
    if not one or not two:
        return found, best
    at_a, at_b = (np.array([objects[k].box().center for k in side]) for side in (one, two))
    alike = np.array([[video.classes.get(i, -i) == video.classes.get(j, -j) for j in two] for i in one])
    weight = np.sqrt(np.minimum.outer([a[i] for i in one], [b[j] for j in two])) * alike
    for m, n in np.argwhere(alike):
        turn = rotation_exp(np.array([0.0, 0.0, objects[one[m]].yaw - objects[two[n]].yaw]))
        moved = (at_b - at_b[n]) @ turn.T + at_a[m]
        near = np.linalg.norm(at_a[:, None] - moved[None], axis=2) < settings.alike_radius_m
        score = float((weight * near).max(axis=0).sum())
        if score > best:
            best, found = score, Sim3(np.ones(()), turn, at_a[m] - turn @ at_b[n])
    return found, best


def _weights(video: SimulatedVideo, frames: NDArray[np.int64]) -> dict[int, float]:
    """Mean share of the pictures that each object fills."""
    ids, count = np.unique(video.ids[frames], return_counts=True)
    total = float(len(frames) * video.camera.width * video.camera.height)
    return {int(k): float(n) / total for k, n in zip(ids, count, strict=True)}


def _world_to_pivot(T_world_cam: Array, depth_m: Array, origin: Array) -> Array:
    """Adjoints that take twists about `origin` to twists at the middle of each frame's points. Shape (F, 7, 7)."""
    R = T_world_cam[:, :3, :3]
    t = T_world_cam[:, :3, 3] + depth_m[:, None] * R[:, :, 2] - origin
    back, at = np.swapaxes(R, 1, 2), -np.einsum("fji,fj->fi", R, t)
    adjoint = np.zeros((len(R), 7, 7))
    adjoint[:, :3, :3] = adjoint[:, 3:6, 3:6] = back
    adjoint[:, :3, 3:6] = skew(at) @ back
    adjoint[:, :3, 6] = -at
    adjoint[:, 6, 6] = 1.0
    return adjoint


def _ties(covisibility: Array, least: float) -> Array:
    """Weights of the edges: covisibility over the degrees of both ends, so that more frames a second change nothing."""
    c = np.where(covisibility >= least, covisibility, 0.0)
    np.fill_diagonal(c, 1.0)
    degree = c.sum(axis=1)
    weight = c / np.outer(degree, degree)
    np.fill_diagonal(weight, 0.0)
    return np.asarray(weight)


def _draw(whitened: Array, weight: Array, rng: np.random.Generator) -> Array:
    """A draw from the Gaussian of the graph: solve with observations that are noise. Shape (F, 7).

    `whitened` (F, 7, 7) takes the difference of two twists to units of deviation, at the earlier frame of an edge.
    """
    count = len(weight)
    upper = np.triu(weight, 1)
    noise = np.sqrt(upper)[..., None] * rng.standard_normal((count, count, 7))
    pull = np.einsum("iba,ijb->ija", whitened, noise)
    b = pull.sum(axis=0) - pull.sum(axis=1)
    information = np.swapaxes(whitened, 1, 2) @ whitened
    H = -upper[..., None, None] * information[:, None]
    H += np.swapaxes(np.swapaxes(H, 0, 1), 2, 3)
    number = np.arange(count)
    H[number, number] = np.einsum("i,iab->iab", upper.sum(axis=1), information)
    H[number, number] += np.einsum("ij,iab->jab", upper, information)
    dense = H.transpose(0, 2, 1, 3).reshape(7 * count, 7 * count)
    diagonal = np.einsum("ii->i", dense)
    diagonal += 1e-7 * (diagonal + np.median(diagonal))
    return np.asarray(cho_solve(cho_factor(dense), b.ravel()).reshape(count, 7))


def _smooth(twists: Array, covisibility: Array, least: float) -> Array:
    """Frames that see nearly the same have nearly the same error."""
    kernel = np.where(covisibility >= least, covisibility, 0.0) ** 4
    np.fill_diagonal(kernel, 1.0)
    kernel /= kernel.sum(axis=1, keepdims=True)
    return np.asarray(kernel @ twists)

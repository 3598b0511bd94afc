"""A chunk that is too long for the memory: passes over shorter windows, joined by the frames that they share."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.errors import DegenerateError, OptionError
from list3r.memory.core.geometry import Sim3
from list3r.models.device import MemoryBudget, is_out_of_memory
from list3r.reconstruction.feedforward.output import WindowOutput

LEAST_WINDOW = 4
"""Shorter windows share too few frames to be joined; a machine on which four do not fit is refused."""
SHARED = 0.3
"""Share of a window that is in the next one too (the paper's 30 of 100)."""

Pass = Callable[[int, int], WindowOutput]
"""The network's output for the frames at positions [start, stop)."""


def run_windows(count: int, budget: MemoryBudget, run: Pass) -> WindowOutput:
    """The output for `count` frames: in one pass if they fit, else in windows that overlap, joined into one gauge.

    When memory runs out the windows are halved and the pass is made again. Raises `OptionError` when not even
    `LEAST_WINDOW` frames fit.
    """
    while True:
        length = max(min(LEAST_WINDOW, count), budget.limit(count))
        shared = min(max(2, round(SHARED * length)), max(1, length - 1))
        spans = plan_chunks(count, ChunkSettings(max(2, length), shared)) if length < count else []
        spans_or_all = [(s.start, s.stop) for s in spans] or [(0, count)]
        try:
            joined = run(*spans_or_all[0])
            for start, stop in spans_or_all[1:]:
                joined = join(joined, run(start, stop), len(joined.depth) - start)
            return joined
        except Exception as error:
            if not is_out_of_memory(error):
                raise
        if length <= LEAST_WINDOW:
            raise OptionError(
                f"{length} frames at once do not fit into the memory; free it, use smaller pictures, another model or "
                "--device cpu"
            )
        budget.failed(length)
        release()


def join(before: WindowOutput, after: WindowOutput, shared: int) -> WindowOutput:
    """Two windows as one, in the gauge of the first; its last `shared` frames are the first of the second.

    The first half of the shared frames is taken from the first window, the second half from the second, to whose middle
    they are nearer.
    """
    S = between(before.part(slice(len(before.depth) - shared, None)), after.part(slice(0, shared)))
    keep = len(before.depth) - shared // 2
    one, two = before.part(slice(0, keep)), regauged(after, S).part(slice(shared - shared // 2, None))
    return WindowOutput(*(np.concatenate(pair) for pair in zip(one.arrays(), two.arrays(), strict=True)))


def regauged(output: WindowOutput, S: Sim3) -> WindowOutput:
    """Return an output in another gauge, S from its own."""
    T = output.T_window_cam.copy()
    T[:, :3, :3] = S.rotation @ T[:, :3, :3]
    T[:, :3, 3] = S.apply(output.T_window_cam[:, :3, 3])
    return replace(output, T_window_cam=T, depth=(output.depth * np.float32(S.scale)).astype(np.float32))


def between(a: WindowOutput, b: WindowOutput) -> Sim3:
    """S_a_b from the same frames seen in two windows: scale by their depth, rotation and translation by their poses.

    The scale is the median ratio of depth over pixels confident in both, which needs no motion. Raises
    `DegenerateError` when the windows have no valid frame in common.
    """
    valid = a.valid() & b.valid()
    known = a.known() & b.known() & valid[:, None, None]
    if not known.any():
        raise DegenerateError("two windows of a chunk share no frame that both could pose")
    scale = float(np.median(a.depth[known].astype(np.float64) / b.depth[known]))
    Ra, Rb = a.T_window_cam[valid][:, :3, :3], b.T_window_cam[valid][:, :3, :3]
    u, _, vt = np.linalg.svd((Ra @ np.swapaxes(Rb, 1, 2)).sum(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    ta, tb = a.T_window_cam[valid][:, :3, 3], b.T_window_cam[valid][:, :3, 3]
    translation = np.median(ta - scale * tb @ rotation.T, axis=0)
    return Sim3(np.asarray(scale), rotation, translation)


def release() -> None:
    """Return memory that a failed pass left behind to the device."""
    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()

"""Reconstruction `precomputed`: geometry that some model wrote into a folder, in the layout of `precomputed_files`.

Files may hold a chunk or one frame each. Where the manifest gives a chunk length every file has its own gauge, and
frames of several files are joined by the frames that the files share; otherwise all files are in one world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import DegenerateError, OptionError, TrackingError
from list3r.memory.core.geometry import Sim3
from list3r.reconstruction.base import DepthNoise, Reconstruction
from list3r.reconstruction.feedforward.output import WindowOutput, to_reconstruction, with_given_poses
from list3r.reconstruction.feedforward.windows import between, regauged
from list3r.reconstruction.precomputed_files import Manifest, read_frames, read_manifest, read_piece
from list3r.reconstruction.registry import ModelOptions
from list3r.reconstruction.settings import NetworkSettings


def make(options: ModelOptions) -> PrecomputedReconstructor:
    """Return the reader of the folder that the options name as weights. Raises `OptionError` where there is none."""
    if options.weights is None:
        raise OptionError("--reconstruction precomputed needs a folder: --weights DIR (see docs/precomputed.md)")
    return PrecomputedReconstructor(Path(options.weights).expanduser(), options.poses, options.settings.networks)


@dataclass(frozen=True)
class Folder:
    """A folder of files and which frames each holds."""

    manifest: Manifest
    files: tuple[Path, ...]
    """In order of their first frames."""
    frames: tuple[NDArray[np.int64], ...]
    """Numbers of the frames of each file."""

    def holding(self, wanted: NDArray[np.int64]) -> list[int]:
        """Files to read for some frames: the first that has them all, else all that have one."""
        share = [int(np.isin(wanted, held).sum()) for held in self.frames]
        whole = [k for k, n in enumerate(share) if n == len(wanted)]
        return whole[:1] or [k for k, n in enumerate(share) if n]


@lru_cache(maxsize=4)
def open_folder(path: Path) -> Folder:
    """Read a folder's index. Raises `OptionError` for one that is no such folder, or has no files."""
    if not path.is_dir():
        raise OptionError(f"{path}: no such folder; --reconstruction precomputed reads one (see docs/precomputed.md)")
    manifest = read_manifest(path)
    held = sorted(((read_frames(p), p) for p in sorted(path.glob("*.npz"))), key=lambda pair: int(pair[0][0]))
    if not held:
        raise OptionError(f"{path} holds no .npz files")
    return Folder(manifest, tuple(p for _, p in held), tuple(f for f, _ in held))


class PrecomputedReconstructor:
    """A `Reconstructor` that looks frames up by their numbers."""

    def __init__(self, path: Path, poses: str = "estimate", settings: NetworkSettings | None = None) -> None:
        self._path, self._folder, self._poses = path, open_folder(path), poses
        self._settings = settings or NetworkSettings()

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """Return the stored geometry of the frames; those in no file are not posed.

        Raises `TrackingError` when fewer than two are held, `OptionError` for files that are damaged or do not fit.
        """
        wanted = np.array([f.index for f in frames], np.int64)
        output, noise = self._gather(wanted)
        try:
            made = to_reconstruction(frames, camera, output, noise, self._settings)
        except TrackingError:
            raise TrackingError(f"{self._path} holds too little of frames {wanted[0]} to {wanted[-1]}") from None
        made = replace(made, scale_kind=self._folder.manifest.scale)
        return with_given_poses(made, frames) if self._poses == "given" else made

    def _gather(self, wanted: NDArray[np.int64]) -> tuple[WindowOutput, DepthNoise | None]:
        """The stored output for the wanted frames, in the gauge of the first file, and its noise."""
        output: WindowOutput | None = None
        noises: list[DepthNoise] = []
        filled = np.zeros(len(wanted), bool)
        for k in self._folder.holding(wanted):
            piece = read_piece(self._folder.files[k])
            where = np.flatnonzero(np.isin(wanted, piece.frames))
            rows = np.searchsorted(piece.frames, wanted[where])
            K = piece.intrinsics[rows]
            part = WindowOutput(piece.T_world_cam[rows], piece.depth[rows], piece.confidence[rows], K[:, :2], K[:, 2:])
            if output is None:
                output = _unknown(len(wanted), part.depth.shape[1:])
            if output.depth.shape[1:] != part.depth.shape[1:]:
                raise OptionError(f"{self._folder.files[k]}: depth images of another size than in the files before it")
            shared, scale = filled[where], 1.0
            if self._folder.manifest.length is not None and filled.any():
                S = self._between(output, where[shared], part, shared, k)
                part, scale = regauged(part, S), float(S.scale)
            fresh = where[~shared]
            for target, source in zip(output.arrays(), part.arrays(), strict=True):
                target[fresh] = source[~shared]
            filled[fresh] = True
            if piece.depth_noise is not None:
                noises.append(DepthNoise(*piece.depth_noise.tolist()).scaled(scale))
        if output is None:
            raise TrackingError(f"{self._path} holds none of the frames {wanted[0]} to {wanted[-1]}")
        return output, _roughest(noises)

    def _between(
        self, output: WindowOutput, where: NDArray[np.int64], part: WindowOutput, shared: NDArray[np.bool_], k: int
    ) -> Sim3:
        """From the gauge of file `k` to that of the files before it, by the frames they share."""
        try:
            return between(output.part(where), part.part(shared))
        except DegenerateError:
            raise TrackingError(
                f"{self._folder.files[k]} shares no posed frame with the files before it; give --chunk and --overlap "
                "as it was made with"
            ) from None


def _roughest(noises: Sequence[DepthNoise]) -> DepthNoise | None:
    """Noise that is at least that of any file; None where no file states it."""
    if not noises:
        return None
    return DepthNoise(*(max(values) for values in zip(*(astuple(n) for n in noises), strict=True)))


def _unknown(count: int, size: tuple[int, ...]) -> WindowOutput:
    """Return an output without any values."""
    return WindowOutput(
        np.full((count, 4, 4), np.nan),
        np.zeros((count, *size), np.float32),
        np.zeros((count, *size), np.float32),
        np.full((count, 2), np.nan),
        np.full((count, 2), np.nan),
    )

"""The program with a cache of reconstructions in a folder.

    LIST3R_KEPT=FOLDER python benchmarks/kept.py build VIDEO -m MEMORY --reconstruction sfm ...

Plane sweeps are most of the time of a build from colour; experiments with later steps need them once. One folder is for
one video with one camera. Frames and the reconstruction's code are not compared: after a change take another.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np

from list3r.cli import main
from list3r.frames.base import Camera, Frame
from list3r.memory.core.records import ChunkResult
from list3r.pipeline import session as session_stage
from list3r.pipeline.chunks import chunk as chunk_stage
from list3r.reconstruction.base import Around, DepthNoise, PosedOnly, Reconstruction, Reconstructor
from list3r.reconstruction.registry import ModelOptions, make_reconstructor

_PLAIN = ("frame_indices", "posed", "T_chunk_cam", "depth", "confidence", "keyframes")


class Kept:
    """A model with cached answers, by their first and last frame and how many there are."""

    def __init__(self, model: Reconstructor, folder: Path) -> None:
        self._model, self._folder = model, folder
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """As the model does."""
        return self._kept("one", frames, lambda: [self._model(frames, camera)])[0]

    def parts(
        self,
        frames: Sequence[Frame],
        camera: Camera,
        around: Around | None = None,
        deep: Collection[int] | None = None,
    ) -> Sequence[Reconstruction]:
        """The model's own, where it has one."""
        parts = getattr(self._model, "parts", None)
        if parts is None:
            return [self(frames, camera)]
        kind = "parts" if deep is None else f"parts-{len(deep)}"
        return self._kept(kind, frames, lambda: parts(frames, camera, around, deep))

    def placed(self, frames: Sequence[Frame], camera: Camera, T_map_cam: Mapping[int, Any]) -> Reconstruction:
        """As the model does with a chunk of a video that was mapped as a whole; the map is not kept."""
        placed = self._model.placed  # type: ignore[attr-defined]
        return self._kept("placed", frames, lambda: [placed(frames, camera, T_map_cam)])[0]

    def _kept(self, kind: str, frames: Sequence[Frame], make: Any) -> Sequence[Reconstruction]:
        path = self._folder / f"{kind}-{frames[0].index:06d}-{frames[-1].index:06d}-{len(frames)}.npz"
        if not path.exists():
            _write(path, make())
        return list(read_kept(path))


def _write(path: Path, parts: Sequence[Reconstruction]) -> None:
    arrays: dict[str, Any] = {}
    for k, part in enumerate(parts):
        arrays |= {f"{name}.{k}": getattr(part, name) for name in _PLAIN}
        arrays[f"camera.{k}"] = np.array([*astuple(part.camera.pinhole())[:6]], np.float64)
        arrays[f"scale_kind.{k}"] = np.array(part.scale_kind)
        if part.depth_noise is not None:
            arrays[f"depth_noise.{k}"] = np.array(astuple(part.depth_noise))
        if part.movers is not None:
            arrays[f"moving.{k}"] = part.movers
        if part.between is not None:
            arrays |= {f"between_{name}.{k}": value for name, value in vars(part.between).items()}
    unfinished = path.with_suffix(f".{os.getpid()}")
    with unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    unfinished.replace(path)


def read_kept(path: Path) -> Iterator[Reconstruction]:
    """The parts of a chunk that a file holds."""
    with np.load(path, allow_pickle=False) as held:
        for k in range(sum(name.startswith("camera.") for name in held.files)):
            width, height, *lens = held[f"camera.{k}"].tolist()
            made = Reconstruction(
                camera=Camera(int(width), int(height), *lens),
                scale_kind=str(held[f"scale_kind.{k}"]),
                **{name: held[f"{name}.{k}"] for name in _PLAIN},
            )
            if f"depth_noise.{k}" in held:
                made = replace(made, depth_noise=DepthNoise(*held[f"depth_noise.{k}"].tolist()))
            if f"between_posed.{k}" in held:
                names = ("frame_indices", "posed", "T_chunk_cam")
                made = replace(made, between=PosedOnly(*(held[f"between_{name}.{k}"] for name in names)))
            yield replace(made, movers=held[f"moving.{k}"]) if f"moving.{k}" in held else made


def _make(name: str, options: ModelOptions) -> Reconstructor:
    return Kept(make_reconstructor(name, options), Path(os.environ["LIST3R_KEPT"]))


if "LIST3R_KEPT" in os.environ:  # also in the processes of a build, which import this file for `process_parts`
    chunk_stage.make_reconstructor = _make  # type: ignore[attr-defined]


def process_parts(task: chunk_stage.ChunkTask) -> tuple[ChunkResult, ...]:
    """As in `chunk_stage`."""
    return chunk_stage.process_parts(task)


if __name__ == "__main__":
    if sys.argv[1:] in (["--help"], ["-h"]):
        print(__doc__)
    else:
        session_stage.process_parts = importlib.import_module("kept").process_parts  # type: ignore[attr-defined]
        main()

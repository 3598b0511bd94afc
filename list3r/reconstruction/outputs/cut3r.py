"""The folder that the programs of CUT3R and TTT3R write: `depth/`, `conf/` and `camera/`, one file a frame.

`depth/N.npy` (h, w) is z in the picture's own camera, `conf/N.npy` is 1 + exp(x), and `camera/N.npz` has `pose` (4,
4), camera to world with OpenCV axes, and `intrinsics` (3, 3), whose principal point is (w // 2, h // 2) with pixel
centres at whole numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from list3r.memory.core.errors import SourceError
from list3r.reconstruction.feedforward.network import sigmoid_of_expp1
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.outputs.base import OutputOptions, ProgramOutput, Views
from list3r.reconstruction.precomputed_files import Manifest, Piece, read_array, read_arrays


class Cut3rReader:
    """The saved frames of CUT3R or TTT3R."""

    name = "the output folder of CUT3R or TTT3R (depth, conf, camera)"

    def recognises(self, path: Path) -> bool:
        return all((path / name).is_dir() for name in ("depth", "conf", "camera"))

    def read(self, path: Path, options: OutputOptions) -> ProgramOutput:
        names = sorted(p.stem for p in (path / "camera").glob("*.npz"))
        if not names:
            raise SourceError(f"{path / 'camera'} holds no .npz files")

        def pieces() -> Iterator[Piece]:
            for position, name in enumerate(names):
                camera = read_arrays(path / "camera" / f"{name}.npz", ("pose", "intrinsics"))
                if len(camera) < 2:
                    raise SourceError(f"{path / 'camera' / name}.npz has no pose and intrinsics")
                depth = np.asarray(read_array(path / "depth" / f"{name}.npy"), np.float32)
                sure = sigmoid_of_expp1(np.asarray(read_array(path / "conf" / f"{name}.npy"), np.float32))
                T, K = (np.asarray(camera[k], np.float64)[None] for k in ("pose", "intrinsics"))
                size = depth.shape[:2] if depth.ndim == 2 else (1, 1)
                placement = options.placement(CutSize(512), (size[0], size[1]))
                frames = np.array([options.every * position])
                yield Views(T, K, depth[None], sure[None]).piece(frames, placement, path)

        return ProgramOutput(Manifest("relative", "cut3r"), pieces())

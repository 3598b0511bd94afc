"""Predictions that VGGT and Depth Anything 3 save become a folder that `precomputed` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from list3r.memory.errors import ExportError, SourceError
from list3r.reconstruction.precomputed import open_folder
from list3r.reconstruction.precomputed_files import read_piece
from list3r.reconstruction.predictions import convert_predictions
from tests.rgbd_scenes import walk


def save(path: Path, program: str, poses: np.ndarray) -> Path:
    count, T_cam_world = len(poses), np.linalg.inv(poses)
    K = np.tile(np.array([[50.0, 0, 16.0], [0, 51.0, 12.0], [0, 0, 1]]), (count, 1, 1))
    depth, confidence = np.full((count, 24, 32), 2.0, np.float32), np.full((count, 24, 32), 1.25, np.float32)
    depth[0, 0, 0] = np.nan
    if program == "vggt":
        arrays = {"extrinsic": T_cam_world[:, :3], "intrinsic": K, "depth": depth[..., None], "depth_conf": confidence}
    else:
        arrays = {"extrinsics": T_cam_world, "intrinsics": K, "depth": depth, "conf": confidence}
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("program", ["vggt", "da3"])
def test_what_was_saved_is_read(program: str, tmp_path: Path) -> None:
    poses = walk(6)
    assert convert_predictions(save(tmp_path / "p.npz", program, poses), tmp_path / "out", every=3) == 6
    folder = open_folder(tmp_path / "out")
    piece = read_piece(folder.files[0])
    assert folder.manifest.model == program and folder.manifest.scale == "relative"
    assert piece.frames.tolist() == [0, 3, 6, 9, 12, 15] and np.allclose(piece.T_world_cam, poses)
    assert piece.intrinsics[0].tolist() == [50.0, 51.0, 15.5, 11.5]
    assert piece.depth[0, 0, 0] == piece.confidence[0, 0, 0] == 0
    assert piece.confidence[1].mean() == pytest.approx(0.2, abs=1e-3)


def test_what_is_none_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", depth=np.ones((2, 3, 4)))
    with pytest.raises(SourceError, match="predictions of VGGT or DA3"):
        convert_predictions(tmp_path / "other.npz", tmp_path / "out")
    np.savez(
        tmp_path / "short.npz", depth=np.ones((2, 3, 4)), extrinsic=np.ones((1, 3, 4)), intrinsic=np.ones((2, 3, 3))
    )
    with pytest.raises(SourceError, match="do not fit"):
        convert_predictions(tmp_path / "short.npz", tmp_path / "out")
    with pytest.raises(SourceError, match="does not exist"):
        convert_predictions(tmp_path / "none.npz", tmp_path / "out")
    (tmp_path / "out").mkdir()
    with pytest.raises(ExportError, match="exists"):
        convert_predictions(save(tmp_path / "p.npz", "da3", walk(3)), tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other.npz", "out", "p.npz", "short.npz"]

"""What networks' own programs save becomes a folder that `precomputed` reads: known geometry, program by program."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.memory.core.errors import ExportError, FrameError, SourceError
from list3r.reconstruction.feedforward.pictures import CutSize, WidthSize
from list3r.reconstruction.outputs.base import OutputOptions
from list3r.reconstruction.outputs.registry import convert_predictions
from list3r.reconstruction.precomputed import open_folder
from list3r.reconstruction.precomputed_files import Piece, read_piece
from tests.recordings import exr
from tests.rgbd_scenes import walk

HEIGHT, WIDTH = 24, 32
K = np.array([[50.0, 0, 15.5], [0, 51.0, 11.5], [0, 0, 1]])
"""Pixel centres at whole numbers."""
CORNER = K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
Saver = Callable[[Path, np.ndarray], Path]


def depth(count: int) -> np.ndarray:
    """A tilted plane, another one in each picture, with one unknown pixel."""
    z = 2.0 + 0.1 * np.arange(count)[:, None, None] + 0.01 * np.arange(WIDTH)[None, None] + np.zeros((1, HEIGHT, 1))
    z[0, 0, 0] = np.nan
    return z.astype(np.float32)


def points(count: int) -> np.ndarray:
    """The same in each camera."""
    x, y = (np.arange(WIDTH) - K[0, 2]) / K[0, 0], (np.arange(HEIGHT) - K[1, 2]) / K[1, 1]
    return depth(count)[..., None] * np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1)


def sure(count: int) -> np.ndarray:
    return np.full((count, HEIGHT, WIDTH), 1.25, np.float32)


def save_vggt(path: Path, T: np.ndarray) -> Path:
    cam = np.linalg.inv(T)[:, :3]
    n = len(T)
    K_all = np.tile(CORNER, (n, 1, 1))
    np.savez(path.with_suffix(".npz"), extrinsic=cam, intrinsic=K_all, depth=depth(n)[..., None], depth_conf=sure(n))
    return path.with_suffix(".npz")


def save_da3(path: Path, T: np.ndarray) -> Path:
    n = len(T)
    K_all = np.tile(CORNER, (n, 1, 1))
    np.savez(path.with_suffix(".npz"), extrinsics=np.linalg.inv(T), intrinsics=K_all, depth=depth(n), conf=sure(n))
    return path.with_suffix(".npz")


def save_cut3r(path: Path, T: np.ndarray) -> Path:
    for name in ("depth", "conf", "camera"):
        (path / name).mkdir(parents=True)
    for n, (z, c) in enumerate(zip(depth(len(T)), sure(len(T)), strict=True)):
        np.save(path / "depth" / f"{n:06d}.npy", z)
        np.save(path / "conf" / f"{n:06d}.npy", c)
        np.savez(path / "camera" / f"{n:06d}.npz", pose=T[n], intrinsics=K)
    return path


def save_chunks(path: Path, T: np.ndarray, arrays: Callable[[np.ndarray, slice], dict[str, np.ndarray]]) -> Path:
    (path / "_tmp_results_unaligned").mkdir(parents=True)
    (path / "base_config.yaml").write_text("Model:\n  chunk_size: 4 # frames\n  overlap: 2\n")
    for k in range(2):
        part = slice(2 * k, 2 * k + 4)
        np.savez(path / "_tmp_results_unaligned" / f"chunk_{k}.npz", **arrays(T[part], part))
    return path


def save_vggt_long(path: Path, T: np.ndarray) -> Path:
    def arrays(T: np.ndarray, part: slice) -> dict[str, np.ndarray]:
        z, c = depth(6)[part], sure(6)[part]
        K_all = np.tile(CORNER, (len(T), 1, 1))
        return {"extrinsic": T, "intrinsic": K_all, "depth": z[..., None], "depth_conf": c, "images": c}

    return save_chunks(path, T, arrays)


def save_vggt_long_with_pi3(path: Path, T: np.ndarray) -> Path:
    def arrays(T: np.ndarray, part: slice) -> dict[str, np.ndarray]:
        world = np.einsum("nij,nhwj->nhwi", T[:, :3, :3], points(6)[part]) + T[:, None, None, :3, 3]
        return {"extrinsic": T, "world_points": world, "world_points_conf": 0 * sure(6)[part] + 0.2}

    return save_chunks(path, T, arrays)


def save_pi_long(path: Path, T: np.ndarray) -> Path:
    def arrays(T: np.ndarray, part: slice) -> dict[str, np.ndarray]:
        confidence = 0 * sure(6)[part][..., None] + 0.2
        return {"camera_poses": T, "local_points": points(6)[part], "conf": confidence, "points": points(6)[part]}

    return save_chunks(path, T, arrays)


def save_scal3r(path: Path, T: np.ndarray) -> Path:
    (path / "depths").mkdir(parents=True)
    scaled = T.copy()
    scaled[:, :3, :3] *= np.linspace(0.5, 2.0, len(T))[:, None, None]
    np.savetxt(path / "mat.txt", scaled.reshape(len(T), 16), fmt="%.9f")
    lines = ["%YAML:1.0", "---", "names:", *(f'  - "{n:06d}"' for n in range(len(T)))]
    for n in range(len(T)):
        data = ", ".join(f"{v:.10f}" for v in (2 * CORNER).ravel())  # of pictures of twice the size
        lines += [f"K_{n:06d}: !!opencv-matrix", "  rows: 3", "  cols: 3", "  dt: d", f"  data: [{data}]"]
        lines += [f"H_{n:06d}: 48.0", f"D_{n:06d}: !!opencv-matrix", "  data: [0.0, 0.0]"]
    (path / "intri.yml").write_text("\r\n".join(lines))
    for n, z in enumerate(depth(len(T))):
        (path / "depths" / f"{n:06d}.exr").write_bytes(exr(z))
    return path


SAVERS: dict[str, tuple[Saver, str]] = {
    "vggt": (save_vggt, "vggt"),
    "da3": (save_da3, "da3"),
    "cut3r": (save_cut3r, "cut3r"),
    "vggt-long": (save_vggt_long, "chunks"),
    "vggt-long with pi3": (save_vggt_long_with_pi3, "chunks"),
    "pi-long": (save_pi_long, "chunks"),
    "scal3r": (save_scal3r, "scal3r"),
}


def pieces(folder: Path) -> list[Piece]:
    return [read_piece(file) for file in open_folder(folder).files]


@pytest.mark.parametrize("program", SAVERS)
def test_what_was_saved_is_read_in_our_conventions(program: str, tmp_path: Path) -> None:
    T, (save, model) = walk(6), SAVERS[program]
    path = save(tmp_path / "saved", T)
    assert convert_predictions(path, tmp_path / "out", OutputOptions(every=3)) == 6
    manifest = open_folder(tmp_path / "out").manifest
    assert (manifest.model, manifest.scale) == (model, "relative")
    assert (manifest.length, manifest.overlap) == ((12, 6) if model == "chunks" else (None, None))
    for piece in pieces(tmp_path / "out"):
        at = piece.frames // 3
        assert np.allclose(piece.T_world_cam, T[at], atol=1e-6)
        assert np.allclose(piece.intrinsics, (50.0, 51.0, 15.5, 11.5), atol=1e-3)
        true = np.nan_to_num(depth(6)[at])
        assert np.allclose(piece.depth, true, rtol=2e-3) and (piece.confidence[true == 0] == 0).all()
        expected = 1.0 if program == "scal3r" else 0.2
        assert piece.confidence[true > 0].mean() == pytest.approx(expected, abs=1e-3)
    assert {int(f) for p in pieces(tmp_path / "out") for f in p.frames} == {0, 3, 6, 9, 12, 15}


def test_what_a_loader_cut_off_is_unknown_and_nothing_is_shifted(tmp_path: Path) -> None:
    """A frame of 60 x 44 becomes 32 x 24 by no loader; with 512 x 341 one of 512 x 336 by that of CUT3R."""
    path = save_cut3r(tmp_path / "saved", walk(2))
    with pytest.raises(SourceError, match="--frame-size"):
        convert_predictions(path, tmp_path / "out", OutputOptions(frame_size=(44, 60)))
    place = CutSize(512).place(1000, 1500)
    assert (place.inner, place.size, place.top, place.left) == ((341, 512), (336, 512), -2, 0)
    z = np.random.default_rng(0).random((2, 336, 512)).astype(np.float32)
    assert np.array_equal(place.whole(z)[:, 2:338], z)
    assert not place.whole(z)[:, :2].any() and not place.whole(z)[:, 338:].any()
    portrait = WidthSize(518).place(1920, 1080)
    assert (portrait.inner, portrait.size, portrait.top) == ((924, 518), (518, 518), -203)


def test_masks_of_entitysam_are_things_throughout_the_video(tmp_path: Path) -> None:
    path, masks = save_da3(tmp_path / "saved", walk(3)), tmp_path / "pan_pred"
    masks.mkdir()
    for n in range(3):
        picture = np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
        picture[10:20, 10 + n : 30 + n] = (200, 1, 0)
        picture[30:40, 40:60] = (0, 0, 7) if n else 0
        cv2.imwrite(str(masks / f"frame{n:03d}.png"), picture[..., ::-1])
    convert_predictions(path, tmp_path / "out", OutputOptions(masks=masks))
    (piece,) = pieces(tmp_path / "out")
    assert piece.masks is not None and piece.features is None
    assert [np.unique(m).tolist() for m in piece.masks] == [[0, 1], [0, 1, 2], [0, 1, 2]]
    assert (piece.masks[2, 5:10, 7:16] == 1).all() and (piece.masks[1, 15:20, 20:30] == 2).all()
    (masks / "frame002.png").unlink()
    with pytest.raises(SourceError, match="none of frame 2"):
        convert_predictions(path, tmp_path / "again", OutputOptions(masks=masks))
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("damage", [lambda data: data[:200], lambda data: b"RIFF" + data[4:], lambda data: data[:-900]])
def test_a_damaged_depth_image_of_scal3r_is_refused(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = save_scal3r(tmp_path / "saved", np.tile(np.eye(4), (3, 1, 1)))
    image = path / "depths" / "000001.exr"
    image.write_bytes(damage(image.read_bytes()))
    with pytest.raises(FrameError, match=r"000001\.exr"):
        convert_predictions(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


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
    (tmp_path / "long" / "_tmp_results_unaligned").mkdir(parents=True)
    with pytest.raises(SourceError, match=r"chunk_N\.npy"):
        convert_predictions(tmp_path / "long", tmp_path / "out")
    (tmp_path / "out").mkdir()
    with pytest.raises(ExportError, match="exists"):
        convert_predictions(save_da3(tmp_path / "p", walk(3)), tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["long", "other.npz", "out", "p.npz", "short.npz"]

"""The .npz layout: what is read is what was written, and what lies is refused."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame
from list3r.instances.geometric.features import color_feature
from list3r.instances.library import build_library
from list3r.instances.registry import check_choice, make_discoverer
from list3r.instances.settings import InstanceSettings
from list3r.memory.core.errors import OptionError, TrackingError
from list3r.memory.core.geometry import Sim3
from list3r.reconstruction.base import DepthNoise
from list3r.reconstruction.precomputed_files import (
    Manifest,
    Piece,
    read_frames,
    read_manifest,
    read_piece,
    write_manifest,
    write_piece,
)
from list3r.reconstruction.registry import ModelOptions, make_reconstructor

CAMERA = Camera(112, 84, 999.0, 999.0, 0.0, 0.0)


def piece(count: int = 10, first: int = 0, seed: int = 0) -> Piece:
    """Frames of cameras that look at tilted planes."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.2, (count, 3))).as_matrix()
    T[:, :3, 3] = rng.normal(0, 0.5, (count, 3))
    depth = 2.0 + rng.random((count, 1, 1)) + 0.01 * np.arange(56)[None, None] + np.zeros((count, 42, 56))
    return Piece(
        np.arange(first, first + count),
        T,
        np.tile([50.0, 51.0, 30.0, 20.0], (count, 1)),
        depth.astype(np.float32),
        np.full((count, 42, 56), 0.75, np.float32),
    )


def rows(whole: Piece, start: int, stop: int, S: Sim3 | None = None) -> Piece:
    """Some frames of a piece, in another gauge."""
    T, scale = whole.T_world_cam[start:stop].copy(), 1.0
    if S is not None:
        T[:, :3, :3] = S.rotation @ T[:, :3, :3]
        T[:, :3, 3] = S.apply(whole.T_world_cam[start:stop, :3, 3])
        scale = float(S.scale)
    return Piece(
        whole.frames[start:stop],
        T,
        whole.intrinsics[start:stop],
        whole.depth[start:stop] * np.float32(scale),
        whole.confidence[start:stop],
    )


def frames(first: int, stop: int, **more: object) -> list[Frame]:
    blank = np.zeros((84, 112, 3), np.uint8)
    return [Frame(k, k / 30, blank, None, None, **more) for k in range(first, stop)]  # type: ignore[arg-type]


def reader(folder: Path, **more: str) -> object:
    return make_reconstructor("precomputed", ModelOptions(weights=str(folder), **more))  # type: ignore[arg-type]


def test_round_trip(tmp_path: Path) -> None:
    whole = piece()
    extra = Piece(
        whole.frames,
        whole.T_world_cam,
        whole.intrinsics,
        whole.depth,
        whole.confidence,
        np.ones((10, 42, 56), np.int32),
        np.eye(3, dtype=np.float32),
        np.array([0.01, 0.02, 0.03]),
    )
    write_piece(tmp_path / "a.npz", extra)
    back = read_piece(tmp_path / "a.npz")
    assert np.array_equal(back.frames, whole.frames) and np.array_equal(back.T_world_cam, whole.T_world_cam)
    assert np.allclose(back.depth, whole.depth, rtol=1e-3) and np.allclose(back.confidence, 0.75)
    assert back.masks is not None and back.features is not None and back.features.shape == (3, 3)
    assert back.depth_noise is not None and back.depth_noise.tolist() == [0.01, 0.02, 0.03]
    assert np.array_equal(read_frames(tmp_path / "a.npz"), whole.frames)
    manifest = Manifest("metric", "m", 100, 30)
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
    write_manifest(tmp_path, Manifest())
    assert read_manifest(tmp_path) == Manifest()


def test_a_chunk_is_read_back_in_our_conventions(tmp_path: Path) -> None:
    whole = piece()
    write_piece(tmp_path / "a.npz", whole)
    write_manifest(tmp_path, Manifest("metric", "m", 10, 3))
    made = reader(tmp_path)(frames(0, 10), CAMERA)  # type: ignore[operator]
    assert made.scale_kind == "metric" and made.posed.all()
    camera = made.camera
    assert np.allclose((camera.fx, camera.fy, camera.cx, camera.cy), (100.0, 102.0, 60.5, 40.5))
    assert np.allclose(made.T_chunk_cam, np.linalg.inv(whole.T_world_cam[0]) @ whole.T_world_cam, atol=1e-9)
    assert made.depth.shape == (10, 84, 112)
    assert np.allclose(np.median(made.depth, axis=(1, 2)), np.median(whole.depth, axis=(1, 2)), rtol=2e-3)


def test_files_of_their_own_gauge_are_joined_by_the_frames_they_share(tmp_path: Path) -> None:
    whole = piece(12)
    S = Sim3(np.asarray(0.4), Rotation.from_rotvec([0.5, 1.0, -0.3]).as_matrix(), np.array([3.0, 1.0, -2.0]))
    write_piece(tmp_path / "b.npz", rows(whole, 0, 8))
    write_piece(tmp_path / "a.npz", rows(whole, 4, 12, S))
    write_manifest(tmp_path, Manifest("relative", "m", 8, 4))
    made = reader(tmp_path)(frames(2, 11), CAMERA)  # type: ignore[operator]
    truth = np.linalg.inv(whole.T_world_cam[2]) @ whole.T_world_cam[2:11]
    assert np.allclose(made.T_chunk_cam, truth, atol=2e-3)
    assert np.allclose(np.median(made.depth, axis=(1, 2)), np.median(whole.depth[2:11], axis=(1, 2)), rtol=2e-3)
    one = reader(tmp_path)(frames(4, 8), CAMERA)  # type: ignore[operator]
    assert np.allclose(one.T_chunk_cam, np.linalg.inv(whole.T_world_cam[4]) @ whole.T_world_cam[4:8], atol=1e-9)


def test_noise_of_computed_depth_is_in_the_units_of_the_depth(tmp_path: Path) -> None:
    whole, said = piece(), np.array([0.01, 0.004, 0.03])
    write_manifest(tmp_path, Manifest("relative", "", 6, 2))
    S = Sim3(np.asarray(2.0), np.eye(3), np.zeros(3))
    write_piece(tmp_path / "a.npz", rows(whole, 0, 6))
    write_piece(tmp_path / "b.npz", replace(rows(whole, 4, 10, S), depth_noise=said))
    alone, both = (reader(tmp_path)(frames(first, 10), CAMERA) for first in (4, 0))  # type: ignore[operator]
    assert alone.depth_noise == DepthNoise(*said)
    in_units_of_a = both.depth_noise.sigma(np.array([1.5], np.float32))
    assert in_units_of_a == pytest.approx(DepthNoise(*said).sigma(np.array([3.0], np.float32)) / 2, rel=1e-3)
    assert both.depth_noise.half_share == 0.03
    write_piece(tmp_path / "b.npz", rows(whole, 4, 10, S))
    assert reader(tmp_path)(frames(4, 10), CAMERA).depth_noise is None  # type: ignore[operator]


def test_files_of_one_world_need_no_common_frames(tmp_path: Path) -> None:
    whole = piece(6)
    for k in range(6):
        write_piece(tmp_path / f"frame-{k:06d}.npz", rows(whole, k, k + 1))
    write_manifest(tmp_path, Manifest("metric"))
    made = reader(tmp_path)(frames(0, 8), CAMERA)  # type: ignore[operator]
    assert made.posed.tolist() == [True] * 6 + [False] * 2
    assert np.allclose(made.T_chunk_cam[:6], np.linalg.inv(whole.T_world_cam[0]) @ whole.T_world_cam, atol=1e-9)
    assert (made.depth[6:] == 0).all()


def test_gauges_without_a_common_frame_are_refused(tmp_path: Path) -> None:
    whole = piece(8)
    write_piece(tmp_path / "a.npz", rows(whole, 0, 4))
    write_piece(tmp_path / "b.npz", rows(whole, 4, 8))
    write_manifest(tmp_path, Manifest("relative", "m", 4, 1))
    with pytest.raises(TrackingError, match="shares no posed frame"):
        reader(tmp_path)(frames(0, 8), CAMERA)  # type: ignore[operator]


def test_frames_that_no_file_holds_are_not_posed(tmp_path: Path) -> None:
    write_piece(tmp_path / "a.npz", piece(4))
    write_manifest(tmp_path, Manifest())
    read = reader(tmp_path)
    with pytest.raises(TrackingError, match="none of the frames 20 to 23"):
        read(frames(20, 24), CAMERA)  # type: ignore[operator]
    with pytest.raises(TrackingError, match="too little of frames 3 to 6"):
        read(frames(3, 7), CAMERA)  # type: ignore[operator]


def damaged(path: Path, **change: object) -> None:
    """A file with some arrays replaced, or left out where None."""
    whole = piece(4)
    arrays: dict[str, object] = {
        "frames": whole.frames,
        "T_world_cam": whole.T_world_cam,
        "intrinsics": whole.intrinsics,
        "depth": whole.depth,
        "confidence": whole.confidence,
    }
    arrays.update(change)
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": None}, "has no array depth"),
        ({"frames": np.array([3, 2, 1, 0])}, "must ascend"),
        ({"frames": np.array([0.5, 1, 2, 3])}, "whole numbers"),
        ({"frames": np.zeros((0,), int)}, "list of whole numbers"),
        ({"depth": np.zeros((3, 42, 56), np.float32)}, r"depth has shape \(3, 42, 56\)"),
        ({"confidence": np.zeros((4, 42, 55), np.float32)}, "confidence has shape"),
        ({"T_world_cam": np.zeros((4, 3, 4))}, "T_world_cam has shape"),
        ({"depth": np.zeros((4, 42, 56), np.int32)}, "depth must be real numbers"),
        ({"masks": np.zeros((4, 42, 56), np.float32)}, "masks must be whole numbers"),
        ({"features": np.zeros(3, np.float32)}, "features has shape"),
        ({"depth_noise": np.array([0.1, -0.1, 0.0])}, "depth_noise must be three finite numbers"),
        ({"depth": np.array([{"a": 1}], dtype=object)}, "only numbers are read"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change: dict[str, object], words: str, tmp_path: Path) -> None:
    damaged(tmp_path / "a.npz", **change)
    with pytest.raises(OptionError, match=words) as caught:
        read_piece(tmp_path / "a.npz")
    assert "a.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_lying_headers_take_no_memory(tmp_path: Path) -> None:
    lie = io.BytesIO()
    np.lib.format.write_array_header_1_0(lie, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)})
    path = tmp_path / "a.npz"
    damaged(path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("masks.npy", lie.getvalue())
    with pytest.raises(OptionError, match="claims shape"):
        read_piece(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("depth.npy", b"x" * 100)
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"PK\x01\x02", b"PK\x01\x02", 1)[: len(whole) // 2])
    with pytest.raises(OptionError, match="cannot be read"):
        read_piece(path)
    path.write_bytes(b"no archive")
    with pytest.raises(OptionError, match="cannot be read"):
        read_frames(path)


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '{"format": "list3r-precomputed", "version": 2, "scale": "metric"}', "\xff\xfe"],
)
def test_manifests_that_make_no_sense_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "precomputed.json").write_text(text, encoding="latin-1")
    with pytest.raises(OptionError, match=r"precomputed\.json"):
        read_manifest(tmp_path)


def test_manifest_fields_are_checked(tmp_path: Path) -> None:
    good = Manifest().as_json()
    for wrong in ({"scale": "feet"}, {"chunk_length": 0}, {"chunk_overlap": True}, {"chunk_length": "9"}):
        (tmp_path / "precomputed.json").write_text(json.dumps(good | wrong))
        with pytest.raises(OptionError, match=next(iter(wrong))):
            read_manifest(tmp_path)


def test_a_folder_must_be_given_and_be_one(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="needs a folder: --weights DIR"):
        make_reconstructor("precomputed", ModelOptions())
    with pytest.raises(OptionError, match="no such folder"):
        reader(tmp_path / "nothing")
    write_manifest(tmp_path, Manifest())
    with pytest.raises(OptionError, match=r"holds no \.npz files"):
        reader(tmp_path)


def with_things(whole: Piece, features: np.ndarray | None) -> Piece:
    """Two things beside each other; the first leaves the view at frame 6."""
    masks = np.zeros(whole.depth.shape, np.int32)
    masks[:6, 10:30, 5:20] = 1
    masks[:, 10:30, 30:50] = 2
    return Piece(whole.frames, whole.T_world_cam, whole.intrinsics, whole.depth, whole.confidence, masks, features)


def test_masks_become_candidates_that_know_what_they_are(tmp_path: Path) -> None:
    features = np.array([[3.0, 4.0], [0.0, 2.0]], np.float32)
    write_piece(tmp_path / "a.npz", with_things(piece(), features))
    write_manifest(tmp_path, Manifest("relative", "some model", 10, 3))
    made = reader(tmp_path)(frames(0, 10), CAMERA)  # type: ignore[operator]
    settings = InstanceSettings()
    check_choice("precomputed", "reprojection", "own")
    find = make_discoverer("precomputed", "own", (("discovery/precomputed", str(tmp_path)),), "cpu", settings)
    assert find.feature_space == "precomputed-some-model@1/2"
    both, one = find(frames(0, 10), made, 2), find(frames(0, 10), made, 8)
    assert both.labels.shape == (84, 112) and both.labels[40, 20] == 1 and both.labels[40, 80] == 2
    assert np.allclose(both.features, [[0.6, 0.8], [0.0, 1.0]])
    assert one.identity is not None and both.identity is not None
    assert one.identity.tolist() == both.identity.tolist()[1:]
    library = build_library(frames(0, 10), made, settings, find)
    assert len(library.instances) == 2 and library.feature_space == find.feature_space
    lengths = sorted(len(i.track.frames) for i in library.instances)
    assert lengths[1] == 10
    outside = find(frames(0, 10), replace(made, frame_indices=made.frame_indices + 50), 0)
    assert len(outside.score) == 0


def test_things_without_features_are_known_by_their_colours(tmp_path: Path) -> None:
    write_piece(tmp_path / "a.npz", with_things(piece(), None))
    write_manifest(tmp_path, Manifest("relative", "some model", 10, 3))
    made = reader(tmp_path)(frames(0, 10), CAMERA)  # type: ignore[operator]
    folders = (("discovery/precomputed", str(tmp_path)),)
    find = make_discoverer("precomputed", "own", folders, "cpu", InstanceSettings())
    assert find.feature_space == "precomputed-some-model-colors@1/36"
    both = find(frames(0, 10), made, 2)
    color = frames(0, 10)[2].color
    assert np.allclose(both.features, [color_feature(color[both.labels == n]) for n in (1, 2)], atol=1e-6)


@pytest.mark.parametrize("things", [False, True])
def test_masks_that_are_missing_or_have_too_few_features_are_refused(things: bool, tmp_path: Path) -> None:
    one = with_things(piece(), np.eye(1, dtype=np.float32)) if things else piece()
    write_piece(tmp_path / "a.npz", one)
    write_manifest(tmp_path, Manifest())
    with pytest.raises(OptionError, match="features has 1 rows" if things else "has no masks"):
        make_discoverer("precomputed", "own", (("discovery/precomputed", str(tmp_path)),), "cpu", InstanceSettings())
    with pytest.raises(OptionError, match="--weights discovery=DIR"):
        make_discoverer("precomputed", "own", (), "cpu", InstanceSettings())

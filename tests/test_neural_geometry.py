"""Feed-forward networks: conventions against known geometry, windows, memory, weights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera
from list3r.memory.core.errors import DegenerateError, OptionError, TrackingError
from list3r.memory.core.geometry import Sim3
from list3r.models.cards import MemoryFigures
from list3r.models.device import MemoryBudget, is_out_of_memory, pictures_that_fit
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.feedforward.network import inverted, sigmoid_of_expp1
from list3r.reconstruction.feedforward.output import (
    WindowOutput,
    to_reconstruction,
    with_given_poses,
)
from list3r.reconstruction.feedforward.pictures import LANCZOS, CutSize, PictureSize, pictures
from list3r.reconstruction.feedforward.points import pinhole
from list3r.reconstruction.feedforward.windows import between, join, regauged, run_windows
from list3r.reconstruction.networks.pi3 import read
from list3r.reconstruction.networks.vggt import decode_poses
from list3r.reconstruction.registry import ModelOptions, make_reconstructor
from tests import neural_scenes
from tests.rgbd_scenes import CAMERA, pose_errors

NAMES = tuple(neural_scenes.CLASSES)


@pytest.fixture
def upstream(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    neural_scenes.use_upstream(monkeypatch)
    yield
    neural_scenes.forget_upstream()


def made_with(name: str, folder: Path, **more: object) -> Reconstruction:
    """A reconstruction of the film by a network that knows it."""
    frames = neural_scenes.film()
    path = neural_scenes.weights(name, folder, frames)
    options = ModelOptions(device="cpu", weights=str(path), **more)  # type: ignore[arg-type]
    return make_reconstructor(name, options)(neural_scenes.rgb_only(frames), CAMERA)


def small(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of 160 x 112 for networks after DUSt3R, cut from 160 x 120."""
    adapter = import_module(f"list3r.reconstruction.networks.{name}")
    if isinstance(adapter.NETWORK.loader, CutSize):
        monkeypatch.setattr(adapter, "NETWORK", replace(adapter.NETWORK, loader=CutSize(longest=160)))


def check_true(made: Reconstruction, *, focal_share: float = 0.01) -> float:
    """Poses, depth and focal length are the film's, at one scale; the scale."""
    frames = neural_scenes.film()
    truth = np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None])
    depth = np.stack([f.depth for f in frames if f.depth is not None])
    known = made.depth > 0
    assert made.posed.all() and known.mean() > 0.85
    scale = float(np.median(made.depth[known] / depth[known]))
    T = made.T_chunk_cam.copy()
    T[:, :3, 3] /= scale
    shift, turn = pose_errors(T, truth)
    assert shift.max() < 2e-3 and turn.max() < 0.05
    assert np.allclose(made.T_chunk_cam[0], np.eye(4), atol=1e-6)
    error = np.abs(made.depth[known] / scale / depth[known] - 1)
    assert np.median(error) < 1e-3 and np.quantile(error, 0.9) < 0.03
    assert abs(made.camera.fx / CAMERA.fx - 1) < focal_share and abs(made.camera.fy / CAMERA.fy - 1) < focal_share
    assert (made.camera.cx, made.camera.cy) == pytest.approx((159.5, 119.5), abs=0.6)
    return scale


@pytest.mark.parametrize("name", NAMES)
def test_each_network_gives_the_known_geometry_back(
    name: str, upstream: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small(name, monkeypatch)
    made = made_with(name, tmp_path / "weights", camera_known=False)
    # Height and width are rounded to whole patches on their own, so that the picture is stretched by a percent or two.
    check_true(made, focal_share=0.025)
    assert made.scale_kind == "relative" and made.depth.dtype == np.float32 and made.confidence.dtype == np.float16
    assert len(made.keyframes) >= 2 and made.confidence.max() <= 1.0


@pytest.mark.parametrize("name", ["pi3x", "mapanything"])
def test_known_intrinsics_are_told_to_networks_that_listen(name: str, upstream: None, tmp_path: Path) -> None:
    made_with(name, tmp_path / "weights", camera_known=True)
    told = neural_scenes.upstream(name).told.cpu().numpy()
    place = import_module(f"list3r.reconstruction.networks.{name}").NETWORK.loader.place(240, 320)
    (tall, wide), (height, width) = place.inner, place.size
    assert np.allclose(told[0, 0], CAMERA.fx * wide / 320) and np.allclose(told[1, 1], CAMERA.fy * tall / 240)
    first_centre = 0.5 if name == "pi3x" else 0.0  # what the package calls the centre of the first pixel
    assert np.allclose(told[:2, 2], ((width - 1) / 2 + first_centre, (height - 1) / 2 + first_centre))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pi3", "vggt", "da3"])
def test_out_of_memory_is_met_with_shorter_windows(name: str, upstream: None, tmp_path: Path) -> None:
    frames = neural_scenes.film()
    path = neural_scenes.weights(name, tmp_path / "weights", frames)
    counted = neural_scenes.upstream(name)
    counted = getattr(__import__("sys").modules[counted.__module__], "Inner", counted)
    counted.most = 6
    model = make_reconstructor(name, ModelOptions(device="cpu", weights=str(path), camera_known=False))
    made = model(neural_scenes.rgb_only(frames), CAMERA)
    check_true(made, focal_share=0.025)
    assert counted.largest_pass == 6
    failed = counted.passes
    model(neural_scenes.rgb_only(frames), CAMERA)
    assert counted.passes - failed < failed, "the second chunk begins with what fitted the first"


def test_a_machine_that_holds_no_window_is_refused(upstream: None, tmp_path: Path) -> None:
    frames = neural_scenes.film()
    path = neural_scenes.weights("pi3", tmp_path / "weights", frames)
    neural_scenes.upstream("pi3").most = 2
    model = make_reconstructor("pi3", ModelOptions(device="cpu", weights=str(path)))
    with pytest.raises(OptionError, match="do not fit into the memory"):
        model(neural_scenes.rgb_only(frames), CAMERA)


def test_given_poses_make_it_metric(upstream: None, tmp_path: Path) -> None:
    frames = neural_scenes.film()
    path = neural_scenes.weights("pi3", tmp_path / "weights", frames)
    model = make_reconstructor("pi3", ModelOptions(poses="given", device="cpu", weights=str(path)))
    made = model(frames, CAMERA)
    assert made.scale_kind == "metric"
    truth = np.stack([f.T_source_cam for f in frames])  # type: ignore[misc]
    depth = np.stack([f.depth for f in frames])  # type: ignore[misc]
    assert np.allclose(made.T_chunk_cam, truth)
    known = made.depth > 0
    assert abs(np.median(made.depth[known] / depth[known]) - 1) < 1e-3


def test_given_poses_that_stand_still_leave_the_scale_open() -> None:
    frames = list(neural_scenes.film(4))
    still = [type(f)(f.index, f.time_s, f.color, None, np.eye(4)) for f in frames]
    one = window(4)
    same = replace(one, T_window_cam=np.tile(np.eye(4), (4, 1, 1)))
    made = to_reconstruction(still, Camera(56, 42, 50, 50, 27.5, 20.5), same)
    with pytest.raises(TrackingError, match="does not move"):
        with_given_poses(made, still)


def window(count: int = 8, seed: int = 0, size: tuple[int, int] = (42, 56)) -> WindowOutput:
    """A hand-made answer: tilted planes seen by moving cameras."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    T[:, :3, 3] = rng.normal(0, 0.5, (count, 3))
    depth = 2.0 + rng.random((count, 1, 1)) + 0.01 * np.arange(size[1])[None, None] + np.zeros((count, *size))
    return WindowOutput(
        T,
        depth.astype(np.float32),
        np.full((count, *size), 0.9, np.float32),
        np.full((count, 2), 50.0),
        np.tile([(size[1] - 1) / 2, (size[0] - 1) / 2], (count, 1)),
    )


def test_pi3_outputs_made_by_hand_are_read_in_our_conventions() -> None:
    height, width, fx, fy = 42, 70, 61.0, 58.0
    truth = window(5, size=(height, width))
    x = (np.arange(width) - (width - 1) / 2) / fx
    y = (np.arange(height) - (height - 1) / 2) / fy
    z = truth.depth
    local = np.stack([z * x, z * y[:, None], z], axis=-1)
    logits = np.full((1, 5, height, width, 1), 2.0, np.float32)
    logits[..., :7, :] = -8.0
    output = read(
        {
            "local_points": torch.from_numpy(local[None]).float(),
            "conf": torch.from_numpy(logits),
            "camera_poses": torch.from_numpy(truth.T_window_cam[None]),
        }
    )
    assert np.allclose(output.focal, (fx, fy), rtol=1e-4)
    assert np.allclose(output.confidence[:, :, 8:], 1 / (1 + np.exp(-2.0)), atol=1e-6)
    frames = neural_scenes.film(5)
    made = to_reconstruction(frames, Camera(140, 84, 1.0, 1.0, 0.0, 0.0), output)
    first = truth.T_window_cam[0]
    assert np.allclose(made.T_chunk_cam, np.linalg.inv(first) @ truth.T_window_cam, atol=1e-6)
    assert np.isclose(made.camera.fx, 2 * fx, rtol=1e-4) and np.isclose(made.camera.fy, 2 * fy, rtol=1e-4)
    assert (made.depth[:, :, :12] == 0).all() and (made.confidence[:, :, :12] == 0).all()
    # A point of the picture's middle, seen by a camera, is where the network put it.
    points = np.einsum("ij,nj->ni", first[:3, :3], made.T_chunk_cam[:, :3, 3]) + first[:3, 3]
    assert np.allclose(points, truth.T_window_cam[:, :3, 3], atol=1e-6)


def test_pinholes_survive_noise_and_ignore_what_is_not_believed() -> None:
    rng = np.random.default_rng(3)
    height, width = 84, 112
    z = rng.uniform(1, 4, (height, width))
    x = z * (np.arange(width) - 55.5) / 90.0 + rng.normal(0, 0.01, z.shape)
    y = z * (np.arange(height) - 41.5)[:, None] / 85.0 + rng.normal(0, 0.01, z.shape)
    points = np.stack([x, y, z], axis=-1).astype(np.float32)
    weights = np.ones((height, width), np.float32)
    points[:10], weights[:10] = rng.normal(0, 9, (10, width, 3)), 0.0
    assert np.allclose(pinhole(points, weights), (90.0, 85.0, 55.5, 41.5), rtol=0.01)
    assert np.isnan(pinhole(points, weights * 0)).all()


@pytest.mark.parametrize("shared", [1, 2, 5])
def test_windows_join_into_the_gauge_of_the_first(shared: int) -> None:
    whole = window(12)
    S = Sim3(np.asarray(2.3), Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))
    after = regauged(whole.part(slice(7 - shared, None)), S)
    joined = join(whole.part(slice(0, 7)), after, shared)
    assert np.allclose(joined.T_window_cam, whole.T_window_cam, atol=1e-5)
    assert np.allclose(joined.depth, whole.depth, rtol=1e-5)


def test_windows_without_a_common_valid_frame_cannot_be_joined() -> None:
    one, two = window(3), window(3)
    lost = replace(two, T_window_cam=two.T_window_cam * np.nan)
    with pytest.raises(DegenerateError, match="share no frame"):
        between(one, lost)


def test_frames_that_the_network_cannot_pose_are_left_out() -> None:
    output = window(4)
    T = output.T_window_cam.copy()
    T[2] = np.nan
    focal = output.focal.copy()
    focal[1] = 1e9
    frames = neural_scenes.film(4)
    made = to_reconstruction(frames, Camera(56, 42, 1, 1, 0, 0), replace(output, T_window_cam=T, focal=focal))
    assert made.posed.tolist() == [True, False, False, True]
    assert np.isfinite(made.T_chunk_cam).all() and (made.depth[2] == 0).all()
    with pytest.raises(TrackingError, match="no usable pose"):
        to_reconstruction(frames, CAMERA, replace(output, T_window_cam=T * np.nan))


def test_windows_are_halved_until_they_fit() -> None:
    asked: list[tuple[int, int]] = []
    whole = window(20)

    def run(start: int, stop: int) -> WindowOutput:
        asked.append((start, stop))
        if stop - start > 5:
            raise torch.OutOfMemoryError("CUDA out of memory")
        gauge = Sim3(np.asarray(1.0 + start), Rotation.from_rotvec([0, 0.1 * start, 0]).as_matrix(), np.ones(3) * start)
        return regauged(whole.part(slice(start, stop)), gauge)

    out = run_windows(20, MemoryBudget(None, None, 1), run)
    assert [stop - start for start, stop in asked[:3]] == [20, 10, 5]
    assert len(out.depth) == 20 and np.allclose(out.depth, whole.depth, rtol=1e-4)
    assert np.allclose(out.T_window_cam, whole.T_window_cam, atol=1e-4)


def test_other_errors_are_not_taken_for_want_of_memory() -> None:
    def run(start: int, stop: int) -> WindowOutput:
        raise RuntimeError("shapes do not match")

    with pytest.raises(RuntimeError, match="shapes"):
        run_windows(8, MemoryBudget(None, None, 1), run)
    assert is_out_of_memory(RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"))
    assert is_out_of_memory(MemoryError())


def test_budget_follows_published_figures_then_what_was_measured() -> None:
    figures = MemoryFigures(3658, 212, "published")
    pixels = 364 * 504
    assert abs(figures.needed_mb(1024, pixels) - 43667) / 43667 < 0.05, "the published peak at 1,024 pictures"
    assert pictures_that_fit(24_000, figures, pixels) == int((0.9 * 24_000 - 3658) // (212 * pixels / 1e6))
    assert pictures_that_fit(3000, figures, pixels) == 0
    budget = MemoryBudget(figures, 24_000, pixels)
    before = budget.limit(10_000)
    budget.measured(100, 3658 + 100 * 80, 3658)
    assert budget.limit(10_000) == int((0.9 * 24_000 - 3658) // 80) < before
    budget.failed(budget.limit(10_000))
    assert budget.limit(10_000) <= before // 2
    assert MemoryBudget(None, None, pixels).limit(500) == 500


def test_picture_sizes_are_whole_patches_and_keep_the_aspect() -> None:
    for height, width in ((480, 640), (1080, 1920), (1920, 1080), (2160, 3840), (97, 201)):
        for size in (PictureSize(max_pixels=255_000), PictureSize(longest=518), PictureSize(longest=504)):
            h, w = size.of(height, width)
            assert h % 14 == 0 and w % 14 == 0
            assert abs(w / h / (width / height) - 1) < 0.06
            assert size.max_pixels is None or h * w <= size.max_pixels
            assert size.longest is None or max(h, w) == size.longest
    assert PictureSize(max_pixels=255_000).of(480, 640) == (434, 574)
    place = PictureSize(longest=28).place(48, 64)
    assert pictures([np.zeros((48, 64, 3), np.uint8)], place, LANCZOS).shape == (1, 28, 28, 3)


def test_vggt_poses_decode() -> None:
    T = window(3).T_window_cam
    quat = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    fov = 2 * np.arctan([[70 / 2 / 80, 98 / 2 / 90]])
    encoding = np.concatenate([T[:, :3, 3], 2 * quat, np.repeat(fov, 3, axis=0)], axis=1)
    decoded, focal = decode_poses(encoding, 70, 98)
    assert np.allclose(decoded, T[:, :3]) and np.allclose(focal, (90, 80))
    assert np.allclose(inverted(decoded) @ T, np.eye(4), atol=1e-9)
    encoding[1, 4] = np.nan
    assert np.isnan(decode_poses(encoding, 70, 98)[0][1]).all()


def test_confidence_after_dust3r_is_a_sigmoid() -> None:
    x = np.linspace(-4, 4, 9)
    assert np.allclose(sigmoid_of_expp1(1 + np.exp(x)), 1 / (1 + np.exp(-x)), atol=1e-6)


def test_missing_package_names_what_installs_it(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(2)}, tmp_path / "model.safetensors")
    for name, line in (("pi3", "pip install git"), ("da3", "Depth-Anything-3")):
        model = make_reconstructor(name, ModelOptions(device="cpu", weights=str(tmp_path)))
        with pytest.raises(OptionError, match=line):
            model(neural_scenes.rgb_only(neural_scenes.film(3)), CAMERA)


def test_wrong_and_damaged_weights_are_one_line(upstream: None, tmp_path: Path) -> None:
    frames = neural_scenes.rgb_only(neural_scenes.film(3))
    good = neural_scenes.weights("pi3", tmp_path / "good", neural_scenes.film(3)) / "model.safetensors"
    from safetensors.torch import load_file, save_file

    def fails(path: Path, words: str) -> None:
        model = make_reconstructor("pi3", ModelOptions(device="cpu", weights=str(path)))
        with pytest.raises(OptionError, match=words) as caught:
            model(frames, CAMERA)
        assert "\n" not in str(caught.value)

    short = tmp_path / "short"
    short.mkdir()
    (short / "model.safetensors").write_bytes(good.read_bytes()[:-100])
    fails(short, "cut off")
    fails(short / "model.safetensors", "cut off")
    (short / "model.safetensors").write_bytes(b"<html>not found</html>")
    fails(short, "cut off")
    other = tmp_path / "other.safetensors"
    save_file({"encoder.weight": torch.zeros(3, 3)}, other)
    fails(other, "other weights than Pi3 needs: 4 of 4 tensors are missing")
    save_file({**load_file(good), "pose_seen": torch.zeros(2, 5, 5)}, other)
    fails(other, "cannot be loaded as Pi3")
    pickled = tmp_path / "evil.pt"
    torch.save({"x": neural_scenes.film}, pickled)
    fails(pickled, "cannot be loaded|not a checkpoint")
    empty = tmp_path / "empty"
    empty.mkdir()
    fails(empty, "holds no weights")
    with pytest.raises(OptionError, match="no such file or folder"):
        make_reconstructor("pi3", ModelOptions(device="cpu", weights=str(tmp_path / "nothing")))


def test_a_state_dict_in_one_file_is_read(upstream: None, tmp_path: Path) -> None:
    film = neural_scenes.film(2)
    neural_scenes.upstream("pi3")
    cls = neural_scenes.upstream("pi3")
    torch.save({"model": cls().state_dict()}, tmp_path / "pi3.pt")
    model = make_reconstructor("pi3", ModelOptions(device="cpu", weights=str(tmp_path / "pi3.pt")))
    made = model(neural_scenes.rgb_only(film), CAMERA)
    assert made.depth.shape == (2, 240, 320)


def test_a_device_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="cuda:7"):
        make_reconstructor("vggt", ModelOptions(device="cuda:7", weights=str(tmp_path)))

"""The geometry networks' own packages, where they can be imported: small random networks through the whole pipeline.

Continuous runs have none of them, and skip; the interfaces that the packages in tests/upstream stand in for are
checked here against the real ones. With a package installed, or its checkout on the path:

    PYTHONPATH=FOLDER_OF_THE_PACKAGE python -m pytest -q -rs tests/test_upstream_packages.py
"""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import list3r
from list3r.cli.app import run
from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory, read_tum
from list3r.memory.core.errors import OptionError
from list3r.models.upstream import quiet, upstream_class
from list3r.pipeline import session as session_stage
from list3r.pipeline.chunks import chunk as chunk_stage
from list3r.reconstruction.feedforward.network import Network
from list3r.reconstruction.feedforward.pictures import CutSize, PictureSize
from tests import neural_scenes, upstream_networks
from tests.rgbd_scenes import CAMERA
from tests.upstream_networks import Truth

PACKAGES = {
    "pi3": "pi3",
    "pi3x": "pi3",
    "vggt": "vggt",
    "mapanything": "mapanything",
    "da3": "depth_anything_3",
    "dust3r": "dust3r",
    "mast3r": "mast3r",
    "cut3r": "dust3r",
    "ttt3r": "dust3r",
    "fast3r": "fast3r",
}
NAMES = [name for name, package in PACKAGES.items() if find_spec(package) is not None]
if not NAMES:
    pytest.skip("no geometry network's own package is installed (docs/models.md)", allow_module_level=True)


def small(network: Network) -> Network:
    """The network with pictures of 140 x 98 or 140 x 112, in patches of 16 of 128 x 96."""
    cuts = isinstance(network.loader, CutSize)
    return replace(network, loader=CutSize(longest=128) if cuts else PictureSize(longest=140))


@dataclass(frozen=True)
class Real:
    """A network of a real package."""

    name: str
    network: Network
    weights: Path

    def load(self) -> Any:
        """With its random weights."""
        return self.network.load(self.weights, torch.device("cpu"))


@pytest.fixture(scope="module", params=NAMES)
def real(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Real]:
    adapter = import_module(f"list3r.reconstruction.networks.{request.param}")
    network = small(adapter.NETWORK)
    folder = tmp_path_factory.mktemp(request.param)
    with pytest.MonkeyPatch.context() as patch:
        try:
            cls = upstream_class(network.card, network.module, network.class_name)
        except OptionError as error:
            pytest.skip(str(error))
        told = upstream_networks.cut_down(request.param, patch)
        with quiet(), getattr(adapter, "_backbones_of_the_package", quiet)():
            upstream_networks.save(cls, told, folder / "weights")
        patch.setattr(adapter, "NETWORK", network)
        yield Real(request.param, network, folder / "weights")
    shutil.rmtree(folder)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    return neural_scenes.write_pictures(tmp_path / "pictures", neural_scenes.film())


@pytest.fixture
def taught(real: Real, monkeypatch: pytest.MonkeyPatch) -> Truth:
    """What the film shows, told to every network that is loaded."""
    truth = Truth(neural_scenes.film(), CAMERA)
    plain: Callable[..., Any] = real.network.load_class

    def load(cls: Any, path: Path, device: torch.device) -> Any:
        model = plain(cls, path, device)
        upstream_networks.TEACHERS[real.name](model, truth)
        return model

    adapter = import_module(f"list3r.reconstruction.networks.{real.name}")
    monkeypatch.setattr(adapter, "NETWORK", replace(real.network, load_class=load))
    return truth


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Chunks are made here, where the networks are small and taught, and no network is kept for the next test."""
    monkeypatch.setattr(session_stage, "OrderedPool", Here)
    chunk_stage._model.cache_clear()
    yield
    chunk_stage._model.cache_clear()


class Here:
    """A pool of no processes."""

    def __init__(self, work: Callable[[Any], Any], workers: int) -> None:
        self.map = functools.partial(map, work)

    def start(self, ready: Callable[..., None], *given: Any) -> None:
        """Get ready, as processes would."""
        ready(*given)

    def keep(self, count: int) -> None:
        """There is nothing to end."""

    def ask(self, work: Callable[[Any], Any], question: Any) -> Any:
        """What a function makes of its argument."""
        return work(question)

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def build(real: Real, tmp_path: Path, *more: str) -> list[str]:
    memory = ["-m", str(tmp_path / "m.l3r"), "--reconstruction", real.name, "--weights", str(real.weights)]
    return ["build", str(tmp_path / "pictures"), *memory, "--device", "cpu", "--json", *more]


def check_trajectory(memory: Path) -> None:
    truth = np.stack([f.T_source_cam for f in neural_scenes.film() if f.T_source_cam is not None])
    out = memory.with_suffix(".txt")
    assert run(["export", str(memory), "--to", "tum", "--out", str(out)]) == 0
    errors = evaluate_trajectory(Trajectory(np.arange(len(truth)) / 30.0, truth), read_tum(out))
    assert errors.ate_sim3_m.rmse < 0.02 and errors.rpe_rotation_deg.rmse < 1.0


def test_known_geometry_becomes_a_memory(
    real: Real, taught: Truth, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(build(real, tmp_path, "--chunk", "8", "--overlap", "4")) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["matches"][0]["posed"] == 12, "packages print; standard output is for results"
    assert "warn" not in printed.err.lower()
    with list3r.open(tmp_path / "m.l3r") as scene:
        chunks = scene.store.chunks.all()
        assert len(chunks) == 2 and len({c.component for c in chunks}) == 1
        assert all(c.scale_kind == "relative" for c in chunks)
    check_trajectory(tmp_path / "m.l3r")


def test_memory_that_runs_out_makes_shorter_windows(
    real: Real, taught: Truth, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taught.most = 6
    assert run(build(real, tmp_path, "--chunk", "12")) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["posed"] == 12 and taught.passes >= 4
    check_trajectory(tmp_path / "m.l3r")


def test_random_weights_are_refused_in_one_line_or_give_a_memory(
    real: Real, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = run(build(real, tmp_path))
    printed = capsys.readouterr()
    assert status == 0 or (status == 2 and printed.err.count("error:") == 1 and "own weights?" in printed.err)


def test_weights_that_lack_a_layer_are_refused(
    real: Real, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(real.weights, tmp_path / "weights")
    file = tmp_path / "weights" / "model.safetensors"
    tensors = load_file(file)
    lost = sorted(tensors)[len(tensors) // 2]
    save_file({k: v for k, v in tensors.items() if k != lost}, file)
    assert run(build(replace(real, weights=tmp_path / "weights"), tmp_path)) == 2
    error = capsys.readouterr().err
    assert lost in error and "holds other weights than" in error and error.count("error:") == 1


def half_as_on_a_gpu(patch: pytest.MonkeyPatch) -> None:
    """Where the packages switch half precision off on a GPU, switch it off here."""
    for module in (torch.amp, torch.cuda.amp):
        patch.setattr(module, "autocast", lambda *_, **given: torch.autocast("cpu", enabled=given["enabled"]))


@pytest.mark.parametrize("told", [False, True])
def test_answers_have_their_shapes_in_half_precision(real: Real, told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    half_as_on_a_gpu(monkeypatch)
    film = neural_scenes.film()[:3]
    height, width = real.network.loader.place(CAMERA.height, CAMERA.width).size
    stack = torch.stack([torch.from_numpy(f.color).permute(2, 0, 1) / 255.0 for f in film])
    stack = torch.nn.functional.interpolate(stack, size=(height, width), mode="bilinear")
    K = torch.tensor([[115.0, 0, width / 2], [0, 115.0, height / 2], [0, 0, 1]]).repeat(3, 1, 1) if told else None
    model = real.load()
    for half in (False, True) if real.network.half else (False,):
        with quiet(), torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=half):
            said = real.network.answer(model, stack, K)
        assert said.T_window_cam.shape == (3, 4, 4) and said.focal.shape == (3, 2)
        assert said.depth.shape == said.confidence.shape == (3, height, width)
        assert said.depth.dtype == said.confidence.dtype == np.float32
        assert np.isfinite(said.depth).all() and (said.depth > 0).mean() > 0.4
        assert said.confidence.min() >= 0 and said.confidence.max() <= 1
        R = said.T_window_cam[:, :3, :3]
        assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 2e-2


def test_told_intrinsics_are_the_rays_of_the_pixels(real: Real) -> None:
    if real.name not in ("pi3x", "mapanything"):
        pytest.skip(f"{real.name} cannot be told the intrinsics")
    model, seen = real.load(), []
    if real.name == "pi3x":
        model.ray_embed.register_forward_pre_hook(lambda _module, inputs: seen.append(inputs[0][0].permute(1, 2, 0)))
    else:
        encode = model._encode_n_views

        def look(views: Any) -> Any:
            rays = views[0]["ray_directions_cam"][0]
            seen.append(rays[..., :2] / rays[..., 2:])
            return encode(views)

        model._encode_n_views = look
    K = torch.tensor([[115.0, 0, 68.0], [0, 117.0, 50.0], [0, 0, 1]])
    with quiet(), torch.inference_mode():
        real.network.answer(model, torch.rand(2, 3, 98, 140), K.repeat(2, 1, 1))
    x, y = (torch.arange(140) - 68.0) / 115.0, (torch.arange(98) - 50.0) / 117.0
    expected = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    torch.testing.assert_close(seen[0].float(), expected, atol=1e-5, rtol=1e-5)


def test_pi3x_without_poses_needs_no_mask_over_all_tokens(real: Real) -> None:
    if real.name != "pi3x":
        pytest.skip("a matter of pi3x alone")
    torch.manual_seed(1)
    pictures = torch.rand(1, 3, 3, 98, 140)
    own = upstream_class(real.network.card, real.network.module, real.network.class_name)
    K = torch.tensor([[115.0, 0, 70.0], [0, 115.0, 49.0], [0, 0, 1]]).expand(1, 3, 3, 3)
    with quiet(), torch.inference_mode():
        theirs = own.from_pretrained(str(real.weights)).eval()
        everywhere = torch.ones(1, 3, dtype=torch.bool)
        before = theirs(imgs=pictures, intrinsics=K, mask_add_ray=everywhere)
        after = real.load()(imgs=pictures, intrinsics=K, mask_add_ray=everywhere)
    for key in ("local_points", "conf", "camera_poses"):
        torch.testing.assert_close(before[key], after[key])

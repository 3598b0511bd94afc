"""Networks through the whole pipeline: a folder of pictures to a memory, by every command that takes one."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import list3r
from list3r.association.revisits.joint_source import JointSourceReconstructor
from list3r.cli.app import run
from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory, read_tum
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.models.device import Gpu
from list3r.pipeline import choice
from list3r.pipeline.choice import settings_asked
from list3r.pipeline.chunks.chunk import ChunkTask, joint_model, process_parts
from list3r.pipeline.chunks.joint_windows import joint_windows
from list3r.pipeline.request import BuildRequest
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.workers import OrderedPool
from tests import neural_models, neural_scenes


@pytest.fixture
def upstream(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    neural_scenes.use_upstream(monkeypatch)
    yield
    neural_scenes.forget_upstream()


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    return neural_scenes.write_pictures(tmp_path / "pictures", neural_scenes.film())


def arguments(tmp_path: Path, name: str, *more: str) -> list[str]:
    return [
        "build",
        str(tmp_path / "pictures"),
        "-m",
        str(tmp_path / "m.l3r"),
        "--reconstruction",
        name,
        "--weights",
        str(tmp_path / "weights"),
        "--device",
        "cpu",
        *more,
    ]


def check_trajectory(memory: Path) -> None:
    """The cameras lie as in the film, at one scale."""
    truth = np.stack([f.T_source_cam for f in neural_scenes.film() if f.T_source_cam is not None])
    out = memory.with_suffix(".txt")
    assert run(["export", str(memory), "--to", "tum", "--out", str(out)]) == 0
    placed = read_tum(out)
    assert len(placed.time_s) == len(truth)
    errors = evaluate_trajectory(Trajectory(np.arange(len(truth)) / 30.0, truth), placed)
    assert errors.ate_sim3_m.rmse < 0.01 and errors.rpe_rotation_deg.rmse < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pi3", "mapanything"])
def test_pictures_become_a_memory(name: str, upstream: None, pictures: Path, tmp_path: Path) -> None:
    neural_scenes.weights(name, tmp_path / "weights", neural_scenes.film())
    workers = ["--workers", "1" if name == "pi3" else "0"]
    assert run(arguments(tmp_path, name, "--chunk", "8", "--overlap", "4", "--json", *workers)) == 0
    with list3r.open(tmp_path / "m.l3r") as scene:
        chunks = scene.store.chunks.all()
        assert len(chunks) == 2 and all(c.scale_kind == "relative" for c in chunks)
        assert len({c.component for c in chunks}) == 1
        assert scene.store.facts.scale_kind in ("relative", "guessed") and scene.units == "unit"
        said = scene.store.sessions.all()[0].settings
        assert said["weights"] == str((tmp_path / "weights").resolve())
        assert len(scene.store.instances.all(structure=False)) >= 2
    check_trajectory(tmp_path / "m.l3r")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vggt", "da3", "pi3x"])
def test_a_chunk_goes_through_every_stage(name: str, upstream: None, pictures: Path, tmp_path: Path) -> None:
    weights = neural_scenes.weights(name, tmp_path / "weights", neural_scenes.film())
    settings = BuildSettings(reconstruction=name, device="cpu", weights=str(weights))
    result = process_parts(ChunkTask(str(pictures), SourceOptions(), ChunkSpan(0, 0, 12), settings))[-1]
    assert result.posed.all() and result.scale_kind == "relative"
    assert len(result.keyframes) >= 2 and len(result.samples.points) > 1000
    assert len(result.library.instances) >= 3
    assert abs(result.intrinsics[0] / 262.0 - 1) < 0.03, "the focal length is the network's, not the guess"


@pytest.mark.slow
def test_geometry_written_in_one_place_is_built_in_another(
    upstream: None, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    neural_scenes.weights("pi3", tmp_path / "weights", neural_scenes.film())
    common = ["--reconstruction", "pi3", "--weights", str(tmp_path / "weights"), "--device", "cpu"]
    out = ["precompute", str(pictures), "--out", str(tmp_path / "files"), *common, "--chunk", "8", "--overlap", "4"]
    assert run([*out, "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)["matches"]
    assert (report["files"], report["frames"], report["posed"]) == (2, 12, 12)
    neural_scenes.forget_upstream()
    before = (tmp_path / "files" / "chunk-0000.npz").stat().st_mtime_ns
    build = ["build", str(pictures), "-m", str(tmp_path / "m.l3r"), "--reconstruction", "precomputed"]
    assert run([*build, "--weights", str(tmp_path / "files"), "--workers", "0"]) == 0
    assert (tmp_path / "files" / "chunk-0000.npz").stat().st_mtime_ns == before
    with list3r.open(tmp_path / "m.l3r") as scene:
        assert len(scene.store.chunks.all()) == 2, "cut as the files are"
    assert run([*out[:-4], "--chunk", "6", "--overlap", "3"]) == 2
    assert "holds files of another model or of other chunks" in capsys.readouterr().err


def test_errors_are_one_line(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "weights").mkdir()
    for name, more, said in (
        ("pi3", [], "pi3 needs the package pi3: pip install"),
        ("pi3", ["--licence", "permissive"], "--licence permissive does not allow --reconstruction pi3"),
        ("precomputed", [], "has no precomputed.json"),
        ("pi4", [], "--reconstruction pi4 is not known"),
        ("da3", ["--preset", "nope"], "--preset nope is not known"),
    ):
        weights_asked = arguments(tmp_path, name, *more)
        if "--licence" in more:
            where = weights_asked.index("--weights")
            del weights_asked[where : where + 2]
        assert run(weights_asked) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("error:") == 1
        assert not (tmp_path / "m.l3r").exists()


def test_explicit_options_win_over_the_preset(pictures: Path) -> None:
    info = open_source(pictures).info
    settings, told = settings_asked(BuildRequest(preset="cpu"), info, "research")
    assert (settings.reconstruction, settings.discovery, settings.features) == ("auto", "learned", "geometric")
    assert told == ["preset cpu: nothing to fetch"] and settings.chunks == ChunkSettings()
    settings, told = settings_asked(BuildRequest(preset="cpu", discovery="eomt", chunk=50), info, "research")
    assert (settings.discovery, settings.features, settings.chunks) == ("eomt", "own", ChunkSettings(50, 15))
    assert settings.instance_weights == (("discovery/eomt", "tue-mps/coco_panoptic_eomt_large_640"),)
    assert "as asked" in told[0]


def test_chunks_are_as_long_as_the_gpu_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    def length(free_mb: float, **given: object) -> ChunkSettings:
        monkeypatch.setattr(choice, "find_gpu", lambda name="auto": Gpu("a GPU", free_mb, free_mb))
        things: Any = given.pop("instance_weights", ())
        settings = BuildSettings(reconstruction=str(given.pop("name", "pi3")), instance_weights=things)
        return choice._cut(settings, given.get("chunk"), None)  # type: ignore[arg-type]

    assert length(80_000) == ChunkSettings(240, 30)
    assert length(8_000) == ChunkSettings(65, 20)
    assert length(80_000, name="vggt") == ChunkSettings(240, 30)
    assert length(24_000, name="vggt").length < 100
    things = (("discovery/eomt", "x"), ("tracking/sam3", "y"))
    assert length(8_000, instance_weights=things).length < length(8_000).length - 30
    assert length(8_000, name="da3").length > 16, "its first weights are small ones"
    assert length(1_000, chunk=40) == ChunkSettings(40, 12)
    with pytest.raises(OptionError, match=r"pi3 needs about .* GB for 16 frames and a GPU has 3\.9 GB free"):
        length(4_000)


@pytest.mark.slow
def test_windows_of_two_places_are_made_by_the_chunks_own_network(
    upstream: None, pictures: Path, tmp_path: Path
) -> None:
    weights = neural_scenes.weights("pi3", tmp_path / "weights", neural_scenes.film())
    settings = BuildSettings(reconstruction="pi3", device="cpu", weights=str(weights))
    task = ChunkTask(str(pictures), SourceOptions(), ChunkSpan(0, 0, 12), settings)

    def store_of(source: Path) -> Store:
        opened = stack.enter_context(Store.create(tmp_path / f"{source.name}.l3r"))
        with opened.transaction():
            opened.sessions.add(str(source), "", {}, 12)
        return opened

    joint = JointSourceReconstructor({1: str(pictures)}, {1: SourceOptions()}, joint_model(task))
    made = joint(1, [0, 1, 2, 3], 1, [8, 9, 10, 11])
    assert made is not None and made.scale_kind == "relative"
    with contextlib.ExitStack() as stack:
        pool = stack.enter_context(OrderedPool(process_parts, 1))
        there = joint_windows(store_of(pictures), 1, task, pool)(1, [0, 1, 2, 3], 1, [8, 9, 10, 11])
        with pytest.raises(SourceError):
            joint_windows(store_of(tmp_path / "gone"), 1, task, pool)(1, [0, 1], 1, [8, 9])
    assert there is not None
    for one, other in ((made.u, there.u), (made.v, there.v)):
        np.testing.assert_array_equal(one.camera_frames, other.camera_frames)
        np.testing.assert_allclose(one.points, other.points, rtol=1e-5)
    assert set(made.u.camera_frames) == {0, 1, 2, 3} and set(made.v.camera_frames) == {8, 9, 10, 11}


@pytest.mark.slow
def test_an_update_and_a_resumed_build_take_the_same_options(
    upstream: None, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    neural_scenes.weights("pi3", tmp_path / "weights", neural_scenes.film())
    assert run(arguments(tmp_path, "pi3", "--json", "--workers", "0")) == 0
    assert run(arguments(tmp_path, "pi3", "--json", "--resume", "--workers", "0")) == 0
    again = neural_scenes.write_pictures(tmp_path / "again", neural_scenes.film()[2:])
    options = ["--reconstruction", "pi3", "--weights", str(tmp_path / "weights"), "--device", "cpu", "--json"]
    capsys.readouterr()
    assert run(["update", str(tmp_path / "m.l3r"), str(again), *options, "--workers", "0"]) == 0
    (report,) = json.loads(capsys.readouterr().out)["matches"]
    assert report["posed"] == 10


@pytest.mark.slow
def test_every_part_can_be_a_network(
    upstream: None, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    neural_scenes.weights("da3", tmp_path / "weights", neural_scenes.film())
    parts = {"discovery": "eomt", "tracking": "sam2", "features": "dinov2"}
    options = ["--chunk", "12"]
    for part, name in parts.items():
        folder = neural_models.save(f"{part}/{name}", tmp_path / part)
        options += [f"--{part}", name, "--weights", f"{part}={folder}"]
    assert run(arguments(tmp_path, "da3", *options, "--json", "--workers", "0")) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["posed"] == 12
    with list3r.open(tmp_path / "m.l3r") as scene:
        said = scene.store.sessions.all()[0].settings
        assert [said[part] for part in parts] == list(parts.values())
        assert [name for name, _ in said["instance_weights"]] == ["discovery/eomt", "features/dinov2", "tracking/sam2"]  # type: ignore[attr-defined]

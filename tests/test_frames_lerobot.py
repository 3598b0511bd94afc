"""Episodes of LeRobot: the right frames of the right camera, depth on the wall that was filmed, no silent guess."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import List3rError, OptionError, SourceError
from tests.recordings import COUNT, K, off_plane, put, shots
from tests.recordings_robots import BEFORE, DEPTH, FRONT, WRIST, write_depth_video, write_lerobot
from tests.test_frames_recordings import world_points

pytest.importorskip("pyarrow", reason="the extra parquet is not installed")

FRONT_OF_1 = SourceOptions(episode=1, topics=(("color", FRONT),), intrinsics=K)


def frames_of(path: Path, options: SourceOptions) -> list[Frame]:
    source = open_source(path, options)
    found = list(source.read(0, source.info.frame_count))
    assert all(isinstance(f, Frame) for f in found)
    return [f for f in found if isinstance(f, Frame)]


@pytest.mark.parametrize("coded", [True, False])
def test_depth_of_an_episode_lies_on_the_wall(coded: bool, tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set", coded=coded)
    info = open_source(path, FRONT_OF_1).info
    assert info.kind == "lerobot" and info.has_depth and not info.has_poses and info.frame_count == COUNT
    assert any("observation.state" in note for note in info.notes)
    for k, (frame, shot) in enumerate(zip(frames_of(path, FRONT_OF_1), shots(), strict=True)):
        assert frame.index == k and frame.time_s == pytest.approx(k / 30, abs=1e-3)
        assert np.abs(frame.color.astype(int) - shot.color).mean() < 25
        off = off_plane(world_points(replace(frame, T_source_cam=shot.T_world_cam), info.camera))
        assert len(off) == frame.color.shape[0] * frame.color.shape[1] and off.max() < 0.002


def test_a_range_is_counted_within_the_episode(tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set")
    whole = frames_of(path, FRONT_OF_1)
    first = replace(FRONT_OF_1, every=2, sharpest=False)
    for options in (replace(first, start=1), replace(first, start_s=1 / 30), replace(first, start=1, sharpest=True)):
        part = frames_of(path, options)
        assert [f.index for f in part] == ([2, 3] if options.sharpest else [1, 3])
        assert all((f.depth == whole[f.index].depth).all() for f in part)
    assert open_source(path, FRONT_OF_1).position(2) == 2
    assert len(frames_of(path, replace(FRONT_OF_1, episode=0))) == BEFORE
    prints = {open_source(path, replace(FRONT_OF_1, episode=n)).info.fingerprint for n in (0, 1)}
    assert len(prints) == 2


def test_a_camera_without_depth_is_colour_alone(tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set")
    info = open_source(path, SourceOptions(episode=1, topics=(("color", WRIST),))).info
    assert not info.has_depth and info.scale_kind == "relative" and any(DEPTH in note for note in info.notes)


def test_what_has_to_be_chosen_is_asked_for(tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set")
    with pytest.raises(OptionError, match="2 episodes; choose one by --episode"):
        open_source(path, replace(FRONT_OF_1, episode=None))
    with pytest.raises(OptionError, match=f"several cameras .*{WRIST}"):
        open_source(path, SourceOptions(episode=1))
    with pytest.raises(OptionError, match="episodes 0 to 1"):
        open_source(path, replace(FRONT_OF_1, episode=7))
    with pytest.raises(OptionError, match="no poses"):
        open_source(path, replace(FRONT_OF_1, topics=(("pose", "observation.state"),)))


def _cut_video(root: Path) -> None:
    write_depth_video(root / f"videos/{DEPTH}/chunk-000/file-000.mp4", [np.ones((120, 160), np.float32)], coded=True)


def _change_info(**changes: object) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        said = json.loads((root / "meta/info.json").read_text())
        put(root / "meta/info.json", json.dumps(said | changes))

    return change


def _code(**changes: object) -> Callable[[Path], None]:
    depth = {"dtype": "video", "info": {"is_depth_map": True, **changes}}
    return _change_info(features={FRONT: {"dtype": "video"}, DEPTH: depth})


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "an older version": (_change_info(codebase_version="v2.1"), "convert"),
    "videos elsewhere": (_change_info(video_path="{video_key:999999999}"), "v3.0"),
    "no rate": (_change_info(fps=0), "fps"),
    "another rate": (_change_info(fps=10), "as the table says"),
    "pictures in tables": (_change_info(features={FRONT: {"dtype": "image"}}), "convert them to video"),
    "codes of nothing": (_code(**{"video.depth_min": 3.0, "video.depth_max": 1.0}), "coded from 3.0 to 1.0"),
    "12 bits without a meaning": (_code(), "12 bits a pixel without saying"),
    "no table": (lambda root: (root / "meta/episodes/chunk-000/file-000.parquet").unlink(), "no episodes"),
    "a table of noise": (lambda root: put(root / "meta/episodes/chunk-000/file-000.parquet", "noise"), "no table"),
    "a video that is missing": (lambda root: (root / f"videos/{FRONT}/chunk-000/file-000.mp4").unlink(), "missing"),
    "depth that ends early": (_cut_video, "ends after 1 of 7"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_clear_line(name: str, tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set")
    spoil, said = WRONG[name]
    spoil(path)
    with pytest.raises(List3rError, match=said) as caught:
        open_source(path, FRONT_OF_1)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_an_episode_is_of_a_data_set(tmp_path: Path) -> None:
    put(tmp_path / "walk/a.jpg", b"x")
    with pytest.raises(OptionError, match="--episode is for LeRobot data sets"):
        open_source(tmp_path / "walk", SourceOptions(episode=1))
    with pytest.raises(SourceError, match="codebase_version"):
        put(tmp_path / "set/meta/info.json", "{}")
        (tmp_path / "set/data").mkdir()
        open_source(tmp_path / "set")

"""convert: what is written reads back as the same frames, in every layout, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from list3r.frames.convert import LAYOUTS, convert
from list3r.frames.decoding.decode import read_raw_depth
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.frames.writers.base import png16
from list3r.memory.core.errors import ExportError, OptionError, SourceError
from tests.recordings import COUNT, off_plane, put, shots, write_colmap, write_nerfstudio, write_record3d
from tests.test_frames_recordings import frames_of, world_points

KINDS = {"tum": "tum", "transforms": "nerfstudio", "colmap": "colmap", "replica": "replica", "r3d": "record3d"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_is_written_reads_back(layout: str, tmp_path: Path) -> None:
    report = convert(write_record3d(tmp_path / "a"), layout, tmp_path / "b")
    path = tmp_path / "b" / "walk.r3d" if layout == "r3d" else tmp_path / "b"
    info = open_source(path).info
    assert (info.kind, report.frames, report.posed) == (KINDS[layout], COUNT, COUNT)
    assert report.with_depth == (COUNT if LAYOUTS[layout].depth else 0)
    for frame, shot in zip(frames_of(path), shots(), strict=True):
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)
        assert np.abs(frame.color.astype(int) - shot.color).mean() < 12  # noise is what JPEG keeps worst
        if LAYOUTS[layout].depth:
            off = off_plane(world_points(frame, info.camera))
            assert np.median(off) < 0.002 and np.quantile(off, 0.95) < 0.012


def test_what_a_layout_does_not_hold_is_said(tmp_path: Path) -> None:
    source = write_record3d(tmp_path / "a")
    assert any("no depth" in note for note in convert(source, "colmap", tmp_path / "b").notes)


def test_frames_without_a_pose_are_kept_or_counted(tmp_path: Path) -> None:
    poses = [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]] * (COUNT - 1)
    source = write_record3d(tmp_path / "a", poses=[*poses, [np.nan] * 7])
    assert convert(source, "tum", tmp_path / "tum").posed == COUNT - 1
    left = convert(source, "replica", tmp_path / "replica")
    assert left.frames == COUNT - 1 and any("without a pose" in note for note in left.notes)
    again = convert(source, "r3d", tmp_path / "r3d")
    assert (again.frames, again.posed) == (COUNT, COUNT - 1)
    assert open_source(tmp_path / "r3d/walk.r3d").info.frame_count == COUNT


def test_nothing_is_left_where_nothing_could_be_written(tmp_path: Path) -> None:
    source = write_record3d(tmp_path / "a")
    with pytest.raises(OptionError, match="choose one of: tum"):
        convert(source, "gaussian", tmp_path / "b")
    with pytest.raises(ExportError, match="does not exist"):
        convert(source, "tum", tmp_path / "no/such")
    (tmp_path / "b").mkdir()
    with pytest.raises(ExportError, match="exists"):
        convert(source, "tum", tmp_path / "b")
    flat = write_nerfstudio(tmp_path / "d", frames=[{"file_path": "images/frame_00001.jpg"}])
    with pytest.raises(SourceError, match="no poses"):
        convert(flat, "replica", tmp_path / "e", SourceOptions(kind="nerfstudio"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "d"]


def test_depth_too_far_for_a_layout_is_unknown(tmp_path: Path) -> None:
    put(tmp_path / "far.png", png16(np.array([[1.0, 65.0, 66.0]], np.float32), 1000.0))
    assert read_raw_depth(tmp_path / "far.png").tolist() == [[1000, 65000, 0]]


def test_a_model_of_colmap_keeps_its_unit(tmp_path: Path) -> None:
    source = write_colmap(tmp_path / "a")
    convert(source, "tum", tmp_path / "b")
    for frame, shot in zip(frames_of(tmp_path / "b"), shots(), strict=True):
        assert np.allclose(frame.T_source_cam[:3, 3], 3 * shot.T_world_cam[:3, 3], atol=1e-5)

"""The paper's sequences: they are found where their data sets put them, and Neural RGB-D is read in our conventions."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.simulation.dataset import WalkSettings, write_walk
from tests.rgbd_scenes import walk

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import sequences

AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV's camera axes from OpenGL's."""


@pytest.mark.parametrize(
    ("data", "folders", "expected"),
    [
        ("tum", ["rgbd_dataset_freiburg2_desk", "rgbd_dataset_freiburg2_desk_with_person", "other"], 2),
        ("7scenes", ["chess/seq-03", "chess/seq-01", "redkitchen/seq-12"], 2),
        ("eth3d", ["kidnap_1", "ceiling_1", "cables_1"], 2),
        ("bonn", ["rgbd_bonn_balloon", "rgbd_bonn_crowd"], 2),
    ],
)
def test_the_papers_sequences_are_found_and_missing_ones_named(
    data: str, folders: list[str], expected: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in folders:
        (tmp_path / name).mkdir(parents=True)
    found = sequences.find_scenes(tmp_path, sequences.DATA_SETS[data].scenes)
    assert len(found) == len({p for _, p in found}) == expected
    assert all(tmp_path / name == path for name, path in found)
    missing = capsys.readouterr().out.count("left out")
    assert missing == len(sequences.DATA_SETS[data].scenes) - (1 if data == "bonn" else expected)


@pytest.mark.slow
def test_eth3d_and_bonn_are_built_and_evaluated_from_their_layouts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """ETH3D: a list of associations and a file of intrinsics; BONN: neither, its intrinsics are the benchmark's."""
    eth3d, bonn = tmp_path / "eth3d" / "plant_scene_3", tmp_path / "bonn" / "rgbd_bonn_crowd"
    write_walk(eth3d, WalkSettings(seed=3, frames=8, size=(640, 480), focal=542.7))
    shutil.copytree(eth3d, bonn)
    (bonn / "calibration.txt").unlink()
    rows = [line.split() for line in (eth3d / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    paired = [f"{t} {name} {t} {name.replace('rgb', 'depth')}" for t, name in rows]
    (eth3d / "associated.txt").write_text("\n".join(paired) + "\n")
    for data, folder in (("eth3d", eth3d), ("bonn", bonn)):
        out = tmp_path / f"{data}.json"
        words = ["sequences.py", data, "--root", str(folder.parent), "--json", str(out), "--", "--workers", "0"]
        monkeypatch.setattr(sys, "argv", words)
        sequences.main()
        (row,) = json.loads(out.read_text())["scenes"]
        assert row["scene"] == folder.name and row["posed"] == row["frames"] == 8
        assert row["ate_se3_m"] < 0.02 and row["scale"] == pytest.approx(1.0, abs=0.1)
        assert ("cloud" in row) == (data == "eth3d")
    assert "kidnap_1: left out" in capsys.readouterr().out


def test_neural_rgbd_is_read_with_its_poses_and_depth(tmp_path: Path) -> None:
    T = walk(12)
    folder = tmp_path / "kitchen"
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for n in range(12):
        cv2.imwrite(str(folder / "images" / f"img{n}.png"), np.full((48, 64, 3), 10 * n, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"depth{n}.png"), np.full((48, 64), 1000 + n, np.uint16))
    (folder / "focal.txt").write_text("55.5\n")
    opengl = T @ AXES
    opengl[3] = np.nan
    (folder / "poses.txt").write_text("\n".join(" ".join(map(str, row)) for row in opengl.reshape(-1, 4)))
    out = sequences.from_nrgbd(folder, tmp_path / "out")
    source = open_source(str(out), SourceOptions())
    assert source.info.camera is not None and source.info.has_depth
    assert (source.info.camera.fx, source.info.camera.cx, source.info.camera.cy) == (55.5, 31.5, 23.5)
    frames = [f for f in source.read(0, 12) if hasattr(f, "color")]
    for n in (0, 2, 10, 11):
        assert frames[n].color.mean() == pytest.approx(10 * n, abs=1)
        assert np.allclose(frames[n].T_source_cam, T[n], atol=1e-6)
        assert frames[n].depth.max() == pytest.approx(1.0 + n / 1000)
    posed = [f for f in json.loads((out / "transforms.json").read_text())["frames"] if "transform_matrix" in f]
    assert len(posed) == 11
    assert sequences.from_nrgbd(folder, out) == out


def test_the_table_has_every_row_and_their_mean() -> None:
    rows = [
        {"scene": "a", "posed": 9, "frames": 10, "ate_m": 0.1, "rte_m": 0.02, "rre_deg": 1.0},
        {"scene": "b", "posed": 5, "frames": 5, "ate_m": 0.3, "rte_m": 0.04, "rre_deg": 2.0},
    ]
    lines = sequences.table(rows).splitlines()
    assert lines[2] == "| a | 9 of 10 | 0.100 | 0.020 | 1.000 |"
    assert lines[-1] == "| mean of 2 | | 0.200 | 0.030 | 1.500 |"

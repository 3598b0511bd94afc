"""Aria: poses at the pictures' times in a world with z up, and, where the test data is at hand, depth that agrees.

The real files are facebookresearch/projectaria_tools, data/gen1/aria_digital_twin_test_data; LIST3R_ADT names a folder
that holds video.vrs, depth_images.vrs and aria_trajectory.csv.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.recordings.aria_trajectory import read_trajectory
from list3r.frames.recordings.axes import quarter_turns
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError
from tests.recordings import put
from tests.test_frames_recordings import world_points

NAMES = "graph_uid,tracking_timestamp_us,utc,tx_{w},ty_{w},tz_{w},qx_{w},qy_{w},qz_{w},qw_{w}"
GRAVITY = ",gravity_x_world,gravity_y_world,gravity_z_world"
TIMES = np.array([1.0, 1.05, 2.0])
installed = importlib.util.find_spec("projectaria_tools") is not None


def poses() -> list[tuple[float, np.ndarray]]:
    """Times in seconds and T_world_device in a world with z up, twenty a second."""
    out = []
    for k in range(30):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [2 * k, -k, 3 * k], degrees=True).as_matrix()
        T[:3, 3] = 0.1 * k, -0.05 * k, 1.5
        out.append((0.8 + 0.05 * k, T))
    return out


def write_trajectory(path: Path, down: tuple[float, float, float], uid: str = "a", world: str = "world") -> Path:
    """Poses in a world in which gravity points `down`."""
    R, _ = Rotation.align_vectors([down], [[0.0, 0.0, -1.0]])
    lines = [NAMES.format(w=f"{world}_device") + GRAVITY.replace("world", world)]
    for time_s, T in poses():
        rotation, place = R * Rotation.from_matrix(T[:3, :3]), R.apply(T[:3, 3])
        numbers = [*place, *rotation.as_quat(), *(9.81 * v for v in down)]
        lines.append(f"{uid},{round(1e6 * time_s)},-1," + ",".join(f"{v:.9f}" for v in numbers))
    put(path, "\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("down", [(0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, -0.8)])
def test_poses_stand_upright_whatever_world_they_are_in(down: tuple[float, float, float], tmp_path: Path) -> None:
    found = read_trajectory(write_trajectory(tmp_path / "t.csv", down), TIMES)
    assert found.upright and not found.drifts
    true = dict((round(t, 6), T) for t, T in poses())
    seen = [(T, true[round(float(t), 6)]) for T, t in zip(found.T_world_device, TIMES, strict=True)]
    assert all(T is not None and T[2, 3] == pytest.approx(1.5, abs=1e-6) for T, _ in seen)
    turn = seen[0][0] @ np.linalg.inv(seen[0][1])  # the same for all, and about the vertical
    assert np.allclose(turn[2], [0, 0, 1, 0], atol=1e-6) and np.allclose(turn[:3, 2], [0, 0, 1], atol=1e-6)
    assert all(np.allclose(T, turn @ expected, atol=1e-6) for T, expected in seen)


def test_a_pose_between_two_rows_lies_between_them(tmp_path: Path) -> None:
    path = write_trajectory(tmp_path / "t.csv", (0.0, 0.0, -1.0))
    middle = read_trajectory(path, np.array([1.025])).T_world_device[0]
    first, second = (T for t, T in poses() if round(t, 6) in (1.0, 1.05))
    assert middle is not None and np.allclose(middle[:3, 3], (first[:3, 3] + second[:3, 3]) / 2, atol=1e-6)


def test_an_open_loop_drifts_and_graphs_are_not_mixed(tmp_path: Path) -> None:
    drifting = read_trajectory(write_trajectory(tmp_path / "o.csv", (0, 0, -1), world="odometry"), TIMES)
    assert drifting.drifts and drifting.upright
    path = write_trajectory(tmp_path / "t.csv", (0, 0, -1))
    lines = path.read_text().splitlines()
    put(path, "\n".join([*lines[:15], *(line.replace("a,", "b,", 1) for line in lines[15:])]))
    found = read_trajectory(path, TIMES)
    assert [T is not None for T in found.T_world_device] == [True, True, False] and found.elsewhere == 1


WRONG = {
    "not a trajectory": ("a,b\n1,2\n", "not a trajectory of Aria"),
    "empty": ("", "not a trajectory of Aria"),
    "cut off": (None, "line 31 is not a row"),
    "of another recording": (
        NAMES.format(w="world_device") + "\na,9000000000,0,0,0,0,0,0,0,nan\n",
        "no pose at the time",
    ),
    "back in time": (
        NAMES.format(w="world_device") + "\na,900000,0,0,0,0,0,0,0,1\na,800000,0,0,0,0,0,0,0,1\n",
        "goes back in time",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_clear_line(name: str, tmp_path: Path) -> None:
    text, said = WRONG[name]
    path = write_trajectory(tmp_path / "t.csv", (0, 0, -1))
    put(path, path.read_text()[:-60] if text is None else text)
    with pytest.raises(SourceError, match=said) as caught:
        read_trajectory(path, np.array([1.0, 60.0]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("turns", range(4))
def test_pictures_are_turned_until_up_is_up(turns: int) -> None:
    level = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    rolled = np.eye(4)
    rolled[:3, :3] = Rotation.from_euler("z", 90 * turns, degrees=True).as_matrix()
    assert quarter_turns([level @ rolled]) == turns


@pytest.mark.skipif(installed, reason="the extra aria is installed")
def test_the_extra_is_named(tmp_path: Path) -> None:
    put(tmp_path / "walk.vrs", b"x")
    with pytest.raises(OptionError, match=r"pip install .*\[aria\]"):
        open_source(tmp_path / "walk.vrs")


@pytest.mark.skipif(not installed, reason="the extra aria is not installed")
def test_noise_is_one_clear_line(tmp_path: Path) -> None:
    put(tmp_path / "walk.vrs", b"\x89" * 500)
    with pytest.raises(SourceError, match="not a recording in VRS"):
        open_source(tmp_path / "walk.vrs")
    with pytest.raises(OptionError, match="states its own cameras"):
        open_source(tmp_path / "walk.vrs", SourceOptions(intrinsics=(600, 600, 700, 700)))


@pytest.mark.skipif(not (installed and "LIST3R_ADT" in os.environ), reason="LIST3R_ADT names no Digital Twin files")
def test_depth_of_the_digital_twin_agrees_between_frames() -> None:
    source = open_source(os.environ["LIST3R_ADT"])
    info, frames = source.info, list(source.read(0, 2))
    assert info.kind == "aria" and info.has_depth and info.has_poses and info.z_up and info.camera is not None
    a, b = frames
    assert isinstance(a, Frame) and isinstance(b, Frame) and b.depth is not None and b.T_source_cam is not None
    world = world_points(a, info.camera)[::97]
    seen = (world - b.T_source_cam[:3, 3]) @ b.T_source_cam[:3, :3]
    k = info.camera
    column, row = np.rint(seen[:, :2] / seen[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy)).astype(int).T
    inside = (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    off = np.abs(b.depth[row[inside], column[inside]] - seen[inside, 2])
    assert len(off) > 5000 and np.median(off) < 0.002
    assert abs(np.quantile(world[:, 2], 0.02)) < 0.02  # the floor

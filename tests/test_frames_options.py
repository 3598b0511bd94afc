"""Words of the command line become numbers, or one clear line."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.options import SourceOptions, parse_distortion, parse_intrinsics, parse_range, parse_transform
from list3r.memory.core.errors import OptionError
from list3r.pipeline.workers import OrderedPool


def test_intrinsics_are_four_numbers() -> None:
    assert parse_intrinsics("525, 526 320;240") == (525.0, 526.0, 320.0, 240.0)


@pytest.mark.parametrize(
    "text", ["", "525", "525,525,320", "525,525,320,240,1", "a,b,c,d", "0,525,320,240", "nan,1,1,1"]
)
def test_malformed_intrinsics_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(OptionError) as caught:
        parse_intrinsics(text)
    assert "\n" not in str(caught.value)


def test_distortion_is_filled_with_zeros_and_empty_when_zero() -> None:
    assert parse_distortion("-0.025") == (-0.025, 0.0, 0.0, 0.0, 0.0)
    assert parse_distortion("0,0") == ()


def test_all_forms_of_one_transform_agree() -> None:
    rotation = Rotation.from_euler("xyz", [10, -20, 30], degrees=True)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = rotation.as_matrix(), [0.1, -0.2, 0.3]
    x, y, z, w = rotation.as_quat()
    texts = [",".join(f"{v:.9f}" for v in expected.ravel()), ",".join(f"{v:.9f}" for v in expected[:3].ravel())]
    found = [parse_transform(text) for text in texts]
    found.append(parse_transform(f"0.1,-0.2,0.3,{x},{y},{z},{w}"))
    found.append(parse_transform(f"0.1,-0.2,0.3,{w},{x},{y},{z}", quaternion="wxyz"))
    for rows in found:
        np.testing.assert_allclose(rows, expected, atol=1e-7)


def test_a_transform_may_stand_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    np.savetxt(path, np.eye(4))
    np.testing.assert_allclose(parse_transform(str(path)), np.eye(4))


@pytest.mark.parametrize("text", ["1,2", "0,0,0,0,0,0,0", "2,0,0,0,0,2,0,0,0,0,2,0,0,0,0,1", "x", "missing-file.txt"])
def test_what_is_no_rigid_transform_is_refused(text: str) -> None:
    with pytest.raises(OptionError):
        parse_transform(text)


def test_ranges() -> None:
    assert parse_range("3:9") == (3, 9)
    assert parse_range(":9") == (None, 9)
    assert parse_range("3:") == (3, None)
    for text in ("3", "9:3", "a:b", "-1:3"):
        with pytest.raises(OptionError):
            parse_range(text)


@pytest.mark.parametrize(
    "bad",
    [
        {"kind": "kinect"},
        {"every": 0},
        {"start": -1},
        {"start": 5, "stop": 5},
        {"depth_scale": 0.0},
        {"fps": float("nan")},
        {"max_depth_m": -1.0},
        {"intrinsics": (1.0, 1.0, 1.0)},
        {"T_color_depth": np.diag([2.0, 2.0, 2.0, 1.0])},
        {"registered": True, "depth_intrinsics": (1.0, 1.0, 1.0, 1.0)},
    ],
)
def test_values_without_sense_are_refused(bad: dict) -> None:
    with pytest.raises(OptionError):
        SourceOptions(**bad)


def test_options_survive_the_way_to_another_process() -> None:
    options = SourceOptions(intrinsics=(5, 5, 2, 2), T_color_depth=np.eye(4), distortion=(0.1,))
    with OrderedPool[SourceOptions, str](repr, 1) as pool:
        assert list(pool.map([options])) == [repr(options)]
    assert hash(options) == hash(copy.deepcopy(options))

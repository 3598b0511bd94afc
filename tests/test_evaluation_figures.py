"""Pictures: every kind is written, the same twice, and bad names are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from list3r.evaluation.covisibility import Covisibility
from list3r.evaluation.figures import (
    UPRIGHT,
    check_ending,
    cloud_figure,
    instances_figure,
    page_axes,
    revisits_figure,
    save,
    trajectory_figure,
)
from list3r.evaluation.revisits import Candidates, judge
from list3r.evaluation.trajectory import Trajectory
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import OrientedBox, rotation_exp


def looking(up: tuple[float, float, float], count: int = 30) -> np.ndarray:
    """Poses of level cameras in a world with this direction up, along a line."""
    y = -np.asarray(up, float) / np.linalg.norm(up)
    z = np.cross(y, [0.3, 0.5, 0.81])
    z /= np.linalg.norm(z)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    poses[:, :3, 3] = np.arange(count)[:, None] * [0.02, 0.01, 0.015]
    return poses


def trajectory() -> object:
    truth = Trajectory(np.arange(30) / 10, looking((0, 0, 1)))
    rows = np.array([k for k in range(30) if not 10 <= k < 16])
    errors = np.linspace(0, 0.05, len(rows))
    return trajectory_figure(truth, truth.time_s[rows], truth.positions()[rows] + 0.01, errors, "a path")


def cloud() -> object:
    p = np.random.default_rng(0).uniform(0, 1, (500, 3))
    return cloud_figure((p, p + 0.01), (np.full(500, 0.01), np.full(500, 0.2)), 0.1, "a cloud", UPRIGHT)


def instances() -> object:
    boxes = {k: (OrientedBox(np.array([k, 0, 0.0]), np.ones(3), np.eye(3)), f"thing {k}") for k in (1, 2, 3)}
    return instances_figure(boxes, {7: boxes[1], 8: boxes[3]}, [(1, 7, 1.0)], "things")


def revisits() -> object:
    found = Covisibility(np.arange(8), np.arange(8.0), np.eye(8, dtype=np.float32))
    candidates = Candidates(np.array([[1, 2]]), np.array([[0, 7]]), np.array([True]), {})
    judged = judge(candidates, found, {1: (0, 3), 2: (4, 7)})
    return revisits_figure(found.frame, found.share, judged, "loops")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
@pytest.mark.parametrize("draw", [trajectory, cloud, instances, revisits])
def test_every_picture_is_written_and_the_same_twice(draw: Callable[[], object], ending: str, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(draw(), tmp_path / f"{name}.{ending}")  # type: ignore[arg-type]
    first = (tmp_path / f"a.{ending}").read_bytes()
    assert first == (tmp_path / f"b.{ending}").read_bytes()
    if ending == "png":
        picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
        assert len(np.unique(picture.astype(int) @ [1, 256, 256**2])) > 20


def test_perfect_and_short_results_are_drawn_too(tmp_path: Path) -> None:
    truth = Trajectory(np.arange(3.0), looking((0, 0, 1), 3))
    save(trajectory_figure(truth, truth.time_s, truth.positions(), np.zeros(3), ""), tmp_path / "a.png")
    save(instances_figure({}, {}, [], "nothing"), tmp_path / "b.png")
    for name in ("a.png", "b.png"):
        width, height = Image.open(tmp_path / name).size
        assert min(width, height) > 200


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.txt", "png"])
def test_other_endings_are_refused(name: str) -> None:
    with pytest.raises(OptionError, match=r"\.png, \.pdf or \.svg"):
        check_ending(name)
    assert check_ending("A.PNG") == Path("A.PNG")


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0.2, 0.1, 1), (1, 1, 1)])
def test_the_page_is_right_handed_and_looks_down(up: tuple[float, float, float]) -> None:
    axes, note = page_axes(looking(up))
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    towards = np.cross(*axes)
    assert towards @ np.asarray(up) / np.linalg.norm(up) > 0.86
    assert ("mean" in note) == (up == (1, 1, 1))


def test_cameras_that_look_every_way_give_the_worlds_own_page() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = rotation_exp(np.array([np.pi, 0, 0]))
    assert page_axes(poses)[1] == "seen along -z"

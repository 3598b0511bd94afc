"""Computed depth: what lies in a wall within the doubt of its depth is wall, unless the pictures show a border."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.planes import find_planes
from list3r.instances.learned.cut import CloudCut
from list3r.instances.learned.depth_errors import DepthErrorSettings, rim_steps, without_depth_bends, without_slivers
from list3r.instances.learned.graph import ChunkSurface, Surroundings
from list3r.instances.learned.verdicts import SegmentVerdicts

HEIGHT, WIDTH, VOXEL = 60, 90, 0.02
PATCH = (slice(20, 40), slice(30, 60))


def wall(bend_m: float, tone: float) -> tuple[ChunkSurface, CloudCut]:
    """A wall two metres before the camera, one voxel a pixel, and a patch that stands out and has another tone."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    labels = np.zeros((HEIGHT, WIDTH), np.int32)
    labels[PATCH] = 1
    z = np.where(labels == 1, 2.0 - bend_m, 2.0)
    points = np.stack([VOXEL * columns, VOXEL * rows, z], axis=2).reshape(-1, 3).astype(np.float32)
    count = len(points)
    lab = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    lab[..., 0] = 40.0 + tone * labels
    toward = np.tile(np.float32([0, 0, -1]), (count, 1))
    one = np.full(count, 0.004, np.float32)
    index = np.arange(count, dtype=np.int32).reshape(HEIGHT, WIDTH)
    grey = np.full((count, 3), 120.0, np.float32)
    cloud = Cloud(np.arange(count), points, toward, grey, one, one, np.ones(count, np.float32), VOXEL, (index,))
    around = Surroundings(np.array([0.0, -1.0, 0.0]), 1.0, 0.0, True)
    none = np.zeros(0, np.int64)
    surface = ChunkSurface(cloud, (), around, (none, none), lab.reshape(-1, 3), (lab,))
    told = SegmentVerdicts(np.float32([0.99, 0.01]), np.float32([0.1, 0.9]), np.ones((2, 1), np.float32))
    return surface, CloudCut(labels.ravel(), told)


@pytest.mark.parametrize(("bend_m", "tone", "things"), [(0.06, 1.0, 1), (0.06, 12.0, 2), (0.30, 1.0, 2)])
def test_a_bent_patch_without_a_border_is_wall(bend_m: float, tone: float, things: int) -> None:
    surface, cut = wall(bend_m, tone)
    planes = [p for p in find_planes(surface.cloud, 0.2, 1.0) if len(p.members) > 2000]
    doubt = np.full(len(cut.labels), 0.05, np.float32)
    left = without_depth_bends(surface, cut, planes, doubt, DepthErrorSettings())
    assert len(left.verdicts.structure) == things and (left.labels >= 0).all()


def test_the_step_across_a_rim_is_that_of_the_pictures() -> None:
    surface, cut = wall(0.06, 12.0)
    steps = rim_steps(surface, cut, DepthErrorSettings().reach_px)
    assert steps[1] == pytest.approx(12.0) and np.isinf(steps[0])


@pytest.mark.parametrize(("doubt_m", "whole"), [(0.02, 0.9), (0.5, 0.3)])
def test_what_is_narrower_than_its_doubt_is_seldom_whole(doubt_m: float, whole: float) -> None:
    surface, cut = wall(0.06, 12.0)
    doubt = np.full(len(cut.labels), doubt_m, np.float32)
    found = without_slivers(surface.cloud, cut, doubt, DepthErrorSettings(), 0.3)
    assert found.verdicts.whole[1] == pytest.approx(whole) and found.verdicts.whole[0] == pytest.approx(0.1)

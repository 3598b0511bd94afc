"""Borders of things in computed depth, told by colour."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.instances.geometric.cuts import Segment, Segmentation
from list3r.instances.rules.snapping import _elected, snap_things, snapped, without_segments

TABLE, MUG, OTHER = 1, 2, 3
THING = np.array([False, False, True, True])
WOOD, RED, WHITE = (190, 150, 100), (110, 15, 20), (225, 225, 220)


def picture() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A white mug on a wooden table before a red wall, with a little noise, and where the mug is."""
    rgb = np.full((120, 160, 3), RED, np.float64)
    rgb[50:] = WOOD
    mug = np.zeros((120, 160), bool)
    mug[34:62, 70:94] = True
    rgb[mug] = WHITE
    rgb += np.random.default_rng(101).normal(0.0, 4.0, rgb.shape)
    return np.clip(rgb, 0, 255).astype(np.uint8), mug


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_what_depth_made_too_wide_gets_its_own_width_back() -> None:
    rgb, mug = picture()
    wide = cv2.dilate(mug.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    labels = np.where(wide, MUG, np.where(np.arange(120)[:, None] >= 50, TABLE, 0)).astype(np.int32)
    labels[50:54, 94:150] = MUG  # a strip of the table's edge that hangs on it
    labels[58:62, 70:94] = TABLE  # its foot is within the table's tolerance
    found = snapped(rgb, labels, THING)
    assert iou(labels == MUG, mug) < 0.65
    assert iou(found == MUG, mug) > 0.95
    assert (found[~wide & (labels == TABLE)] == TABLE).all()


def test_a_thing_of_the_colour_of_what_is_around_it_stays_as_it_is() -> None:
    rgb = np.clip(np.random.default_rng(101).normal(120.0, 5.0, (120, 160, 3)), 0, 255).astype(np.uint8)
    labels = np.full((120, 160), TABLE, np.int32)
    labels[40:70, 60:100] = MUG
    assert iou(snapped(rgb, labels, THING) == MUG, labels == MUG) > 0.95


def test_a_thing_takes_nothing_from_another_thing_nor_from_afar() -> None:
    rgb, mug = picture()
    labels = np.where(mug, MUG, np.where(np.arange(120)[:, None] >= 50, TABLE, 0)).astype(np.int32)
    rgb[34:62, 94:110] = WHITE
    labels[34:62, 94:110] = OTHER
    rgb[90:110, 70:94] = WHITE  # as white as the mug, but not beside it
    found = snapped(rgb, labels, THING)
    assert not (found[labels == OTHER] == MUG).any() and not (found[mug] == OTHER).any()
    assert (found[90:110, 70:94] == TABLE).all()


def test_surfaces_keep_their_borders() -> None:
    rgb, mug = picture()
    labels = np.where(mug, MUG, TABLE).astype(np.int32)
    assert np.array_equal(snapped(rgb, labels, np.zeros(4, bool)), labels)


@pytest.mark.parametrize("votes, expected", [((2, 2, 1), 2), ((1, 2), 1), ((2, 1), 1), ((), 1), ((0, 0, 1), 0)])
def test_most_views_decide_and_a_draw_changes_nothing(votes: tuple[int, ...], expected: int) -> None:
    code = np.array([0 * 4 + v for v in votes], np.int64)
    assert _elected(np.array([1], np.int32), code, 4).tolist() == [expected]


def test_what_is_left_out_leaves_the_others_in_order() -> None:
    segments = tuple(Segment("thing", None, False, score) for score in (0.1, 0.2, 0.3))
    cut = Segmentation(np.array([0, 1, 2, 3, 2], np.int32), segments, np.array([0.0, 0.0, 1.0]))
    kept = without_segments(cut, np.array([True, False, True]))
    assert kept.labels.tolist() == [0, 1, 0, 2, 0]
    assert [s.score for s in kept.segments] == [0.1, 0.3]


def test_a_surface_of_which_a_thing_took_all_is_left_out() -> None:
    rgb, mug = picture()
    strip = np.zeros_like(mug)
    strip[36:60, 94] = True
    rgb[strip] = WHITE
    labels = np.where(strip, 3, np.where(mug, MUG, TABLE)).ravel().astype(np.int32)
    segments = tuple(Segment(kind, None, False, 0.5) for kind in ("surface", "thing", "surface"))
    views = SimpleNamespace(anchors=[0], view=lambda position: SimpleNamespace(rgb=rgb))
    cloud = SimpleNamespace(index=[np.arange(rgb[..., 0].size).reshape(mug.shape)])
    cut = snap_things(views, cloud, Segmentation(labels, segments, np.array([0.0, 0.0, 1.0])), least=20)  # type: ignore[arg-type]
    assert [s.kind for s in cut.segments] == ["surface", "thing"]
    assert set(np.unique(cut.labels)) <= {0, 1, 2} and (cut.labels[mug.ravel() | strip.ravel()] == 2).mean() > 0.9

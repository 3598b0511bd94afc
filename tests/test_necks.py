"""Things that touch by a neck are parted by their colours."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.cuts import Segment, Segmentation
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.rules.necks import part_necks

RED, GREY, WOOD = (170, 30, 35), (150, 155, 160), (190, 150, 100)
BOX, PAD, GAP = (slice(60, 150), slice(60, 150)), (slice(80, 130), slice(170, 230)), slice(150, 170)


def scene(
    neck_px: int, pad: tuple[int, int, int] = RED, seen: tuple[int, ...] = ()
) -> tuple[ChunkViews, Cloud, Segmentation]:
    """A grey box and a pad 20 px beside it, of one label, in views of 320 px; a neck of some width joins them, and of
    each view in `seen` one of another width."""
    voxel = np.arange(240 * 320).reshape(240, 320)
    rgb = np.full((240, 320, 3), WOOD, np.uint8)
    rgb[BOX], rgb[PAD] = GREY, pad
    views = []
    for width in (neck_px, *seen):
        mask = np.zeros((240, 320), bool)
        mask[BOX] = mask[PAD] = True
        mask[105 - width // 2 : 105 + (width + 1) // 2, GAP] = True
        views.append(np.where(mask, voxel, -1).astype(np.int32))
    labels = (np.max(views, axis=0) >= 0).ravel().astype(np.int32)
    v, u = np.mgrid[:240, :320]
    points = 0.005 * np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3)
    cloud = SimpleNamespace(
        keys=voxel.ravel(),
        points=points.astype(np.float32),
        rgb=rgb.reshape(-1, 3).astype(np.float32),
        index=tuple(views),
    )
    shown = SimpleNamespace(anchors=list(range(len(views))), view=lambda position: SimpleNamespace(rgb=rgb), unit=1.0)
    cut = Segmentation(labels, (Segment("thing", None, False, 0.5),), np.array([0.0, 0.0, 1.0]))
    return shown, cloud, cut  # type: ignore[return-value]


def labels_of(cut: Segmentation) -> NDArray[np.int32]:
    return cut.labels.reshape(240, 320)


def test_two_colours_that_touch_by_a_neck_are_two_things() -> None:
    cut = part_necks(*scene(8), least=50)
    assert [s.kind for s in cut.segments] == ["thing", "thing"]
    found = labels_of(cut)
    assert (found[BOX] == 1).all() and (found[PAD] == 2).all() and (found[105, GAP] > 0).all()


@pytest.mark.parametrize("neck_px, pad", [(8, GREY), (16, RED)])
def test_what_is_of_one_colour_or_broadly_joined_stays_one(neck_px: int, pad: tuple[int, int, int]) -> None:
    views, cloud, cut = scene(neck_px, pad)
    assert np.array_equal(part_necks(views, cloud, cut, least=50).labels, cut.labels)


def test_most_views_decide() -> None:
    assert len(part_necks(*scene(8, seen=(8, 30)), least=50).segments) == 2
    assert len(part_necks(*scene(8, seen=(30, 30)), least=50).segments) == 1


def test_small_pieces_and_what_bounds_the_room_stay() -> None:
    views, cloud, cut = scene(8)
    assert len(part_necks(views, cloud, cut, least=5000).segments) == 1
    wall = replace(cut, segments=(Segment("surface", None, True, 0.9),))
    assert len(part_necks(views, cloud, wall, least=50).segments) == 1
    lid = replace(cut, segments=(Segment("surface", np.array([0.0, 0.0, 1.0, 0.0]), False, 0.9),))
    assert [s.kind for s in part_necks(views, cloud, lid, least=50).segments] == ["surface", "thing"]

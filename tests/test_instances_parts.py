"""Laws of the parts under the local instance library."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from list3r.instances.geometric.cloud import neighbour_pairs, pack, unpack
from list3r.instances.geometric.features import mean_feature, object_feature
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.library import InstanceSettings
from list3r.instances.tracking.reprojection import encode_labels
from list3r.memory.core.masks import decode_mask, encode_mask
from list3r.reconstruction.base import Reconstruction
from tests.test_instances_library import SCENE, walk

UP = np.array([0.0, 0.0, 1.0])


@given(hnp.arrays(np.int64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.integers(-500_000, 500_000)))
def test_keys_come_back(cells: np.ndarray) -> None:
    assert np.array_equal(unpack(pack(cells)), cells)


def test_neighbours_are_symmetric_and_complete() -> None:
    cells = np.array([[i, j, 0] for i in range(4) for j in range(4)])
    keys = np.sort(pack(cells))
    left, right = neighbour_pairs(keys, 1)
    away = np.abs(unpack(keys)[left] - unpack(keys)[right]).max(axis=1)
    assert away.max() == 1
    assert len(left) == 2 * 4 * 3 + 2 * 3 * 3


@settings(max_examples=40)
@given(hnp.arrays(np.int32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 3)))
def test_label_images_are_coded_like_their_masks(labels: np.ndarray) -> None:
    shape = (2 * labels.shape[0], 2 * labels.shape[1] - 1)
    full = np.repeat(np.repeat(labels, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]
    coded = encode_labels(labels, 2, shape)
    assert set(coded) == {int(v) - 1 for v in np.unique(full) if v > 0}
    for instance, (runs, area, box, center) in coded.items():
        mask = full == instance + 1
        assert np.array_equal(decode_mask(runs, shape), mask)
        assert np.array_equal(runs, encode_mask(mask))
        rows, columns = np.nonzero(mask)
        assert area == mask.sum()
        assert box[1] == rows.min() and box[3] == rows.max() + 1
        assert box[0] <= columns.min() and box[2] >= columns.max() + 1
        assert rows.min() <= center[1] <= rows.max()


def _cylinder(rgb: tuple[int, int, int], start: float, stop: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(start, stop, 2000), rng.uniform(0.0, 0.1, 2000)
    points = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), height], axis=1).astype(np.float32)
    colors = np.clip(np.array(rgb) + rng.normal(0, 6, (2000, 3)), 0, 255).astype(np.uint8)
    return points, colors


def test_features_agree_for_two_sides_of_a_thing_and_differ_by_colour() -> None:
    one = object_feature(*_cylinder((220, 220, 225), 0.0, 3.3), UP, 1.0)
    two = object_feature(*_cylinder((205, 205, 208), 2.5, 5.8), UP, 1.0)
    red = object_feature(*_cylinder((180, 30, 35), 0.0, 3.3), UP, 1.0)
    assert one.shape == (64,) and np.isclose(np.linalg.norm(one), 1.0)
    assert one @ two > 0.9
    assert one @ red < 0.8
    assert np.isclose(np.linalg.norm(mean_feature(np.stack([one, red]), np.ones(2, np.float32))), 1.0)


def test_features_do_not_depend_on_the_heading() -> None:
    points, colors = _cylinder((90, 140, 60), 0.0, 3.3)
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    assert object_feature(points, colors, UP, 1.0) @ object_feature(turned, colors, UP, 1.0) > 0.999


def test_anchors_laid_on_one_another_undo_drift() -> None:
    frames, true = walk(SCENE, 24)
    drift = true.T_chunk_cam.copy()
    drift[12:, :3, 3] += np.array([0.0, 0.015, 0.01])
    bent = Reconstruction(
        true.frame_indices, true.posed, drift, true.camera, true.depth, true.confidence, "metric", true.keyframes
    )
    views = ChunkViews(frames, bent, InstanceSettings(anchor_step=6))
    given = [drift[p] @ np.linalg.inv(true.T_chunk_cam[p]) for p in views.anchors]
    found = [views.pose(p) @ np.linalg.inv(true.T_chunk_cam[p]) for p in views.anchors]
    before = np.linalg.norm(given[-1][:3, 3] - given[0][:3, 3])
    after = np.linalg.norm((np.linalg.inv(found[0]) @ found[-1])[:3, 3])
    assert after < 0.5 * before

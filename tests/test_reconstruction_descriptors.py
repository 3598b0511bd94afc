"""Frame descriptors: unit length, the same place is more alike than another, nothing in gives nothing out."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.association.revisits.frame_search import CLASSICAL
from list3r.reconstruction.features.local import detect, match
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.features.vlad import Vocabulary, describe_frame
from tests.rgbd_scenes import CAMERA, frames_along, walk

LENGTH = Vocabulary.built_in().words.size


def described(start: float, seed: int) -> np.ndarray:
    frame = frames_along(walk(1, start=start), seed=seed)[0]
    assert frame.depth is not None
    return describe_frame(detect(frame.color, frame.depth, CAMERA, FeatureSettings()).descriptors)


def test_the_same_place_is_more_alike_than_another() -> None:
    here, again, other = described(0.0, 0), described(0.4, 0), described(0.0, 9)
    assert here.shape == (LENGTH,)
    assert np.linalg.norm(here) == pytest.approx(1.0, abs=1e-5)
    assert here @ again > here @ other + 0.1
    assert np.array_equal(here, described(0.0, 0))


def test_features_of_a_smaller_picture_lie_where_they_do_in_the_picture() -> None:
    frame = frames_along(walk(1))[0]
    assert frame.depth is not None
    large, small = (detect(frame.color, frame.depth, CAMERA, FeatureSettings(width=w)) for w in (0, 160))
    pairs = match(large.descriptors, small.descriptors, 0.7)
    off = small.xy[pairs[:, 1]] - large.xy[pairs[:, 0]]
    assert len(pairs) > 20
    assert np.abs(np.median(off, axis=0) - 0.25).max() < 0.1  # OpenCV's own places lie a quarter of a px off
    assert np.median(np.linalg.norm(off, axis=1)) < 0.8


def test_a_frame_without_features_has_a_finite_descriptor() -> None:
    blank = describe_frame(np.zeros((0, 128), np.uint8))
    assert blank.shape == (LENGTH,)
    assert np.isfinite(blank).all()


def test_thresholds_are_known_for_the_vocabulary() -> None:
    assert LENGTH in CLASSICAL
    vocabulary = Vocabulary.built_in()
    assert vocabulary.mean.shape == (128,)
    assert vocabulary.axes.shape[1] == vocabulary.words.shape[1]

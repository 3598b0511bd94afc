"""Frame descriptors: unit length, the same place is more alike than another, nothing in gives nothing out."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.association.revisits.frame_search import CLASSICAL
from list3r.reconstruction.features.descriptor import FrameDescriptor, WordsDescriptor
from list3r.reconstruction.features.local import FeatureSettings, detect
from list3r.reconstruction.features.vlad import VladDescriptor, Vocabulary
from tests.rgbd_scenes import CAMERA, frames_along, walk

KINDS: tuple[FrameDescriptor, ...] = (VladDescriptor(), WordsDescriptor())


def described(kind: FrameDescriptor, start: float, seed: int) -> np.ndarray:
    frame = frames_along(walk(1, start=start), seed=seed)[0]
    assert frame.depth is not None
    return kind(frame.color, detect(frame.color, frame.depth, CAMERA, FeatureSettings()).descriptors)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_place_is_more_alike_than_another(kind: FrameDescriptor) -> None:
    here, again, other = described(kind, 0.0, 0), described(kind, 0.4, 0), described(kind, 0.0, 9)
    assert here.shape == (kind.length,)
    assert np.linalg.norm(here) == pytest.approx(1.0, abs=1e-5)
    assert here @ again > here @ other + 0.1
    assert np.array_equal(here, described(kind, 0.0, 0))


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_without_features_has_a_finite_descriptor(kind: FrameDescriptor) -> None:
    blank = kind(np.full((48, 64, 3), 127, np.uint8), np.zeros((0, 128), np.uint8))
    assert blank.shape == (kind.length,)
    assert np.isfinite(blank).all()


def test_thresholds_are_known_for_every_kind() -> None:
    assert {kind.length for kind in KINDS} == set(CLASSICAL)
    vocabulary = Vocabulary.built_in()
    assert vocabulary.mean.shape == (128,)
    assert vocabulary.axes.shape[1] == vocabulary.words.shape[1]

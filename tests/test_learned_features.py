"""Learned local features with their published weights on real pictures, and their way into a memory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.sift import nearest_pairs
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError
from list3r.reconstruction.features.detectors import make_detector
from list3r.reconstruction.features.learned import LEARNED_WIDTH, as_bytes
from list3r.reconstruction.features.local import match
from list3r.reconstruction.keyframe_record import KeyframeNetworks, make_keyframes
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor

FILE = "aliked/aliked-t16.pth"


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> Path:
    folder = shared_data.parent / "weights"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder


@pytest.fixture(scope="module")
def picture(shared_data: Path) -> np.ndarray:
    frame = next(iter(open_source(shared_data / "redkitchen").read(300, 301)))
    return np.ascontiguousarray(frame.color)


@pytest.mark.data
def test_features_follow_a_known_warp(weights: Path, picture: np.ndarray) -> None:
    detector = make_detector("aliked", weights / FILE)
    turn = cv2.getRotationMatrix2D((320, 240), 6, 0.9)
    warped = cv2.warpAffine(picture, turn, (640, 480), borderMode=cv2.BORDER_REFLECT)
    a, b = detector(picture, 1000), detector(warped, 1000)
    np.testing.assert_allclose(np.linalg.norm(a.descriptors, axis=1), 1.0, rtol=1e-4)
    assert (np.diff(a.score) <= 1e-6).all()
    rows = nearest_pairs(a.descriptors, b.descriptors, 0.95)
    truth = a.xy[rows[:, 0]] @ turn[:, :2].T + turn[:, 2]
    right = np.linalg.norm(truth - b.xy[rows[:, 1]], axis=1) < 3.0
    assert right.sum() > 120 and right.mean() > 0.4
    as_stored = match(as_bytes(a.descriptors), as_bytes(b.descriptors), 0.85)
    truth = a.xy[as_stored[:, 0]] @ turn[:, :2].T + turn[:, 2]
    assert (np.linalg.norm(truth - b.xy[as_stored[:, 1]], axis=1) < 3.0).sum() > 0.8 * right.sum()
    again = detector(picture, 1000)
    np.testing.assert_array_equal(a.xy, again.xy)


@pytest.mark.data
def test_pictures_without_anything_have_no_features(weights: Path) -> None:
    detector = make_detector("aliked", weights / FILE)
    for size in ((480, 640), (97, 131)):
        found = detector(np.zeros((*size, 3), np.uint8), 200)
        assert found.xy.shape == (len(found.score), 2)
        assert as_bytes(found.descriptors).shape == (len(found.score), LEARNED_WIDTH)


@pytest.mark.data
def test_keyframes_keep_them(weights: Path, shared_data: Path) -> None:
    source = open_source(shared_data / "redkitchen")
    frames = list(source.read(0, 3))
    reconstruction = RgbdReconstructor()(frames, source.info.camera)
    detector = make_detector("aliked", weights / FILE)
    (first, *_) = make_keyframes(frames, reconstruction, False, networks=KeyframeNetworks(detector))
    assert first.keypoint_descriptors.shape == (len(first.keypoints_xy), LEARNED_WIDTH)
    plain = make_keyframes(frames, reconstruction, False)[0]
    np.testing.assert_array_equal(first.descriptor, plain.descriptor)
    assert len(match(first.keypoint_descriptors, plain.keypoint_descriptors, 0.85)) == 0


def test_bytes_keep_the_order_of_likeness() -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(size=(60, 128))
    near = base + 0.5 * rng.normal(size=base.shape)
    a, b = ((x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32) for x in (base, near))
    rows = match(as_bytes(a), as_bytes(b), 0.85)
    np.testing.assert_array_equal(rows[:, 0], rows[:, 1])
    assert len(rows) == 60


def test_wrong_weights_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="not known"):
        make_detector("magic", tmp_path)
    with pytest.raises(OptionError, match="do not exist"):
        make_detector("aliked", tmp_path / "none.pth")
    (tmp_path / "junk.pth").write_bytes(b"junk" * 100)
    with pytest.raises(OptionError, match="junk"):
        make_detector("aliked", tmp_path / "junk.pth")


def test_wrong_words_for_local_features_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from list3r.cli.app import run

    (tmp_path / "walk").mkdir()
    cv2.imwrite(str(tmp_path / "walk" / "a.png"), np.zeros((48, 64, 3), np.uint8))
    for words, said in (("magic", "choose sift"), ("aliked", "needs its weights"), ("aliked=none.pth", "do not exist")):
        options = ["-m", str(tmp_path / "m.l3r"), "--intrinsics", "60,60,32,24", "--local-features", words]
        assert run(["build", str(tmp_path / "walk"), *options]) == 2
        assert said in capsys.readouterr().err

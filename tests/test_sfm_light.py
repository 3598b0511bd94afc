"""Light that changes, and lenses: what the camera does by itself while it is carried."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest

from list3r.frames.base import Camera
from list3r.reconstruction.sfm.calibration import _agreeing, _Estimate, _parted
from list3r.reconstruction.sfm.settings import CameraCalibrationSettings, CornerSettings
from list3r.reconstruction.sfm.tracks import as_bright, follow_corners, smoothed, values_at


def wall(count: int = 24) -> list[np.ndarray]:
    """Grey pictures of a wall of soft blots that the camera passes at 3 px a frame."""
    noise = np.random.default_rng(101).integers(20, 160, (40, 80), dtype=np.uint8)
    whole = cv2.resize(noise, (640, 320), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(whole[20:260, 3 * k : 3 * k + 320]) for k in range(count)]


def life(pictures: list[np.ndarray], **settings: float) -> float:
    """Frames in which a corner is seen, on average."""
    tracks = follow_corners(pictures, CornerSettings(**settings))  # type: ignore[arg-type]
    return float(np.bincount(np.concatenate(tracks.ids)).mean())


def test_corners_live_as_long_when_the_exposure_swings() -> None:
    steady = wall()
    gains = 1.0 + 0.45 * np.sin(np.arange(len(steady)) * 0.5)
    swinging = [np.clip(g * p + 3, 0, 255).astype(np.uint8) for g, p in zip(gains, steady, strict=True)]
    assert life(swinging) > 0.9 * life(steady)
    assert life(swinging, least_brightening=256.0) < 0.7 * life(steady)


def around(*seen: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Grey values of pictures around places in them."""
    return tuple(values_at(smoothed(picture), xy) for picture, xy in seen)


def test_nothing_is_done_to_pictures_of_one_exposure() -> None:
    first, *_, last = wall(6)
    assert as_bright(first, last) is first
    xy = np.random.default_rng(102).uniform(20, 200, (80, 2)).astype(np.float32)
    assert as_bright(first, last, values=around((first, xy + np.float32([15, 0])), (last, xy))) is first
    black = np.zeros_like(first)
    assert as_bright(black, first) is black and as_bright(first, black) is first


@pytest.mark.parametrize(("gain", "offset"), [(1.5, 0.0), (0.6, 12.0), (1.0, 40.0)])
def test_brightness_and_contrast_are_told_by_places_that_show_the_same(gain: float, offset: float) -> None:
    old = wall(1)[0]
    new = np.clip(gain * old + offset, 0, 255).astype(np.uint8)
    rng = np.random.default_rng(103)
    xy = rng.uniform(8, [310, 230], (120, 2)).astype(np.float32)
    there = xy.copy()
    there[:20] = rng.uniform(8, [310, 230], (20, 2))  # wrongly followed
    made = as_bright(old, new, values=around((old, xy), (new, there))).astype(float)
    assert np.abs(made - new)[(new > 10) & (new < 245)].mean() < 4.0


def test_windows_that_most_others_bear_out_are_believed() -> None:
    def kept(*focals: float) -> list[bool]:
        found: list[bool] = _agreeing(np.array(focals), CameraCalibrationSettings()).tolist()
        return found

    assert kept(500) == [True] and kept(500, 520, 480, 900) == [True, True, True, False]
    assert kept(500, 1000) == [True, False]
    assert kept(250, 990, 500, 1010, 2000) == [False, True, False, True, False]


def test_a_zoom_is_told_of_and_windows_that_are_a_little_off_are_not() -> None:
    camera, settings = Camera(640, 480, 500.0, 500.0, 319.5, 239.5), CameraCalibrationSettings()
    assert _parted(_Estimate([], camera, 0.0, ((140, 690.0, 0.0), (180, 890.0, 0.26)), 100), 1.0, settings) == ()
    (said,) = _parted(_Estimate([], camera, 0.0, ((140, 690.0, 0.0), (210, 950.0, 0.0)), 100), 2.0, settings)
    assert "1900 px from frame 210 on" in said and "690" not in said and "1380" not in said
    assert _parted(_Estimate([], camera, 0.0, ((140, 690.0, 0.0), (210, 950.0, 0.0)), 60), 2.0, settings) == ()


def test_a_process_that_is_ended_says_nothing_of_its_own() -> None:
    code = (
        "import os, signal, time\n"
        "def told(*_):\n    raise KeyboardInterrupt\n"
        "signal.signal(signal.SIGTERM, told)\n"
        "import list3r.reconstruction.sfm.calibration\n"
        "try:\n    os.kill(os.getpid(), signal.SIGTERM)\n    time.sleep(5)\n"
        "except KeyboardInterrupt:\n    print('told')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "told\n", "")

"""A short film of the textured room as RGB, its truth, and networks that know it, under their upstream names."""

from __future__ import annotations

import os
import sys
from functools import lru_cache
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import Camera, Frame
from tests.rgbd_scenes import CAMERA, render

UPSTREAM = Path(__file__).parent / "upstream"
CLASSES = {
    "pi3": ("pi3.models.pi3", "Pi3"),
    "pi3x": ("pi3.models.pi3x", "Pi3X"),
    "vggt": ("vggt.models.vggt", "VGGT"),
    "mapanything": ("mapanything.models", "MapAnything"),
    "da3": ("depth_anything_3.api", "DepthAnything3"),
    "dust3r": ("dust3r.model", "AsymmetricCroCo3DStereo"),
    "mast3r": ("mast3r.model", "AsymmetricMASt3R"),
    "cut3r": ("dust3r.model", "ARCroco3DStereo"),
    "ttt3r": ("dust3r.model", "ARCroco3DStereo"),
    "fast3r": ("fast3r.models.fast3r", "Fast3R"),
}


@lru_cache(maxsize=2)
def film(count: int = 12) -> tuple[Frame, ...]:
    """Frames along a walk that turns far enough to tell all pictures apart."""
    from tests.rgbd_scenes import walk

    return tuple(render(T, index=k, noise=False) for k, T in enumerate(walk(count, speed=6.0)))


def rgb_only(frames: tuple[Frame, ...]) -> list[Frame]:
    """The frames without depth and poses."""
    return [Frame(f.index, f.time_s, f.color, None, None) for f in frames]


def write_pictures(folder: Path, frames: tuple[Frame, ...]) -> Path:
    """The pictures alone, as files."""
    folder.mkdir(parents=True, exist_ok=True)
    for f in frames:
        assert cv2.imwrite(str(folder / f"{f.index:04d}.png"), cv2.cvtColor(f.color, cv2.COLOR_RGB2BGR))
    return folder


def use_upstream(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the packages importable, here and in processes that are started."""
    monkeypatch.syspath_prepend(str(UPSTREAM))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(UPSTREAM), os.environ.get("PYTHONPATH", "")]))


def upstream(name: str) -> type:
    """The class that stands in for a network's own; fresh figures of its passes."""
    module, attribute = CLASSES[name]
    cls: type = getattr(import_module(module), attribute)
    counted = getattr(import_module(module), "Inner", cls)
    counted.most, counted.largest_pass, counted.passes = 10_000, 0, 0
    return cls


def forget_upstream() -> None:
    """Drop the packages again, so that other tests see a machine without them."""
    for name in [n for n in sys.modules if n.split(".")[0] in {m.split(".")[0] for m, _ in CLASSES.values()}]:
        del sys.modules[name]
    sys.modules.pop("remembered", None)


def weights(name: str, folder: Path, frames: tuple[Frame, ...], camera: Camera = CAMERA) -> Path:
    """Weights of a network that knows the frames; the folder."""
    teach = import_module("remembered").teach
    depth = np.stack([f.depth for f in frames if f.depth is not None])
    poses = np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None])
    colors = np.stack([f.color for f in frames])
    made: Path = teach(upstream(name), folder, colors, depth, poses, camera.fx)
    return made

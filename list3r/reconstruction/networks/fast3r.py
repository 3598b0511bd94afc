"""Reconstruction `fast3r` (Yang et al., "Fast3R: Towards 3D Reconstruction of 1000+ Images in One Forward Pass").

Pictures in [-1, 1], the longer side 512, cut to whole patches of 16. For each come back `pts3d_in_other_view` (1, h, w,
3) in the camera of the first picture with `conf` = 1 + exp(x), and from its second head `pts3d_local` in the picture's
own camera. There are no poses: the focal length is that of the first picture, whose points are in its own camera, and a
picture's pose is the one that projects its points to their pixels, as in its authors' own evaluation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network, numpy, sigmoid_of_expp1
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.feedforward.points import camera_of, from_points, in_camera, pinhole, views
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; known intrinsics replace those of the first picture's points."""
    said = model(views(pictures))
    points = np.concatenate([numpy(s["pts3d_in_other_view"]) for s in said])
    confidence = sigmoid_of_expp1(np.concatenate([numpy(s["conf"]) for s in said]))
    first = pinhole(points[0], confidence[0])
    lenses = [first] * len(points) if K is None else [k[[0, 1, 0, 1], [0, 1, 2, 2]] for k in numpy(K)]
    T = np.stack([camera_of(p, c, lens) for p, c, lens in zip(points, confidence, lenses, strict=True)])
    return from_points(T, np.stack([in_camera(t, p) for t, p in zip(T, points, strict=True)]), confidence)


NETWORK = Network("fast3r", "fast3r.models.fast3r", "Fast3R", CutSize(longest=512), answer, half=False)

"""Reconstruction `pi3` and `pi3x`: the paper's model (Wang et al., "Permutation-Equivariant Visual Geometry Learning").

Pictures (1, n, 3, h, w) in [0, 1], sides multiples of 14, at most 255,000 pixels, aspect ratio kept: a square picture
changes the camera that the network sees. Out come `local_points` (1, n, h, w, 3) in each camera, `conf` as logits and
`camera_poses`, camera to world with OpenCV axes. There is no frame of reference (the first pose is not the identity),
no scale (pi3x: about metres, which is not relied on), and no intrinsics: they follow from the points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network, numpy
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import PictureSize
from list3r.reconstruction.feedforward.points import from_points
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch

PIXEL_LIMIT = 255_000
"""Most pixels of a picture, as its authors' loader has it."""


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; the network takes no intrinsics."""
    return read(model(pictures[None]))


def read(output: dict[str, torch.Tensor]) -> WindowOutput:
    """Return the network's outputs in our terms."""
    import torch

    points = numpy(output["local_points"][0])
    confidence = numpy(torch.sigmoid(output["conf"][0, ..., 0].float()))
    return from_points(numpy(output["camera_poses"][0]).astype(np.float64), points, confidence)


NETWORK = Network("pi3", "pi3.models.pi3", "Pi3", PictureSize(max_pixels=PIXEL_LIMIT), answer)

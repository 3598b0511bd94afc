"""Reconstruction `da3` (Lin et al., "Depth Anything 3: Recovering the Visual Space from Any Views").

Pictures (1, n, 3, h, w) normalised as for DINOv2, the longer side 504, scaled twice by area as its loader does. Out
come `depth` (1, n, h, w), `depth_conf` = 1 + exp(x), `extrinsics` (1, n, 3 or 4, 4), camera *from* world with OpenCV
axes, and `intrinsics` (1, n, 3, 3), px, from the picture's corner. The nested weights are about metric; taken as
relative like the others. Weights without cameras (mono, metric) are refused.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.memory.core.errors import OptionError
from list3r.models.images import normalised
from list3r.reconstruction.feedforward.network import (
    FeedforwardReconstructor,
    Network,
    inverted,
    numpy,
    sigmoid_of_expp1,
)
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import PictureSize, by_area
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; without poses the network takes no intrinsics."""
    # The inner network: the outer one chooses half precision by asking CUDA, which a CPU has not got.
    output = model.model(normalised(pictures)[None], export_feat_layers=[])
    if "extrinsics" not in output or "depth_conf" not in output:
        raise OptionError("these weights of da3 do not predict cameras; give any-view weights, such as DA3-BASE")
    shape = (len(pictures), *pictures.shape[-2:])
    K_found = numpy(output["intrinsics"][0]).astype(np.float64)
    return WindowOutput(
        T_window_cam=inverted(numpy(output["extrinsics"][0])),
        depth=numpy(output["depth"]).reshape(shape).astype(np.float32),
        confidence=sigmoid_of_expp1(numpy(output["depth_conf"]).reshape(shape)),
        focal=K_found[:, [0, 1], [0, 1]],
        principal=K_found[:, :2, 2] - 0.5,
    )


LONGEST = 504
"""Longer side of a picture, px."""

NETWORK = Network(
    "da3",
    "depth_anything_3.api",
    "DepthAnything3",
    PictureSize(longest=LONGEST, resample=partial(by_area, LONGEST)),
    answer,
)

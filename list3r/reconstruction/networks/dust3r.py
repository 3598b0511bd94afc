"""Reconstruction `dust3r` (Wang et al., "DUSt3R: Geometric 3D Vision Made Easy", CVPR 2024): pairs brought into chunks.

Two views of pictures in [-1, 1], the longer side 512, cut to whole patches of 16, go in; `pts3d` of the first and
`pts3d_in_other_view` of the second, both in the first's camera and at a scale of their own, come out, with `conf` = 1
+ exp(x). Here pictures that are 1, 2, 4, ... apart are paired, in both orders (`pairs`). The same serves `mast3r`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network, numpy, sigmoid_of_expp1
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pairs import PairPoints, join_pairs, pair_plan
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch

AT_ONCE = 4
"""Pairs that go through the network together."""


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; the network takes no intrinsics."""
    plan, found = pair_plan(len(pictures)), []
    for start in range(0, len(plan), AT_ONCE):
        rows = plan[start : start + AT_ONCE]
        one, two = (_view(pictures, rows[:, k]) for k in (0, 1))
        first, second = model(one, two)
        points = np.stack([numpy(first["pts3d"]), numpy(second["pts3d_in_other_view"])], axis=1)
        sure = np.stack([sigmoid_of_expp1(numpy(s["conf"])) for s in (first, second)], axis=1)
        found += [PairPoints(int(i), int(j), p, c) for (i, j), p, c in zip(rows, points, sure, strict=True)]
    return join_pairs(found, len(pictures))


def _view(pictures: torch.Tensor, rows: np.ndarray) -> dict[str, Any]:
    """Return some pictures as one view of as many pairs; unique names mark that no pair is another one reversed."""
    import torch

    shape = torch.tensor([pictures.shape[-2:]], dtype=torch.int32).expand(len(rows), 2)
    names = [f"{place} of a pair" for place in range(len(rows))]
    return {"img": pictures[rows] * 2 - 1, "true_shape": shape, "idx": rows.tolist(), "instance": names}


NETWORK = Network("dust3r", "dust3r.model", "AsymmetricCroCo3DStereo", CutSize(longest=512), answer, half=False)

"""Discovery by a query-based segmenter of `transformers` (EoMT or Mask2Former): mask, query embedding and name.

The manner of the paper's EntitySAM (A.1): each learned query represents one object of the picture, and its embedding is
the object feature z. Instances of objects and regions of stuff come from one panoptic checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.views import chunk_views
from list3r.instances.neural.candidates import SoftMasks, choose_candidates
from list3r.instances.settings import InstanceSettings
from list3r.models.images import InputShape, network_input, to_picture
from list3r.models.pretrained import load_named, space_name
from list3r.reconstruction.base import Reconstruction

if TYPE_CHECKING:
    import torch

CLASSES = {"eomt": "EomtForUniversalSegmentation", "mask2former": "Mask2FormerForUniversalSegmentation"}
MASK2FORMER_SIZE = (800, 1088)
"""Height and width for Mask2Former: its shorter side in training, multiples of 32, about 4:3."""


class QuerySegmenter:
    """Discoverer: one forward pass for each anchor frame."""

    def __init__(
        self,
        model: str,
        folder: Path,
        device: str = "auto",
        settings: InstanceSettings | None = None,
    ) -> None:
        """`model` is eomt or mask2former, `folder` holds its configuration and weights. Raises `OptionError`."""
        exact = model == "mask2former"  # its deformable attention gives NaN in bfloat16
        self._network, self._device = load_named(CLASSES, "discovery", model, folder, device, exact=exact)
        self._settings = settings or InstanceSettings()
        config = self._network.config
        height, width = _sides(config.image_size) if model == "eomt" else MASK2FORMER_SIZE
        self._shape = InputShape(height, width, keep_aspect=True, black=model == "eomt")
        self._names: dict[int, str] = {int(k): str(v) for k, v in config.id2label.items()}
        self._queries = int(config.num_queries)
        width = config.hidden_size if model == "eomt" else config.hidden_dim
        self._space = space_name(model, folder, int(width))

    @property
    def feature_space(self) -> str:
        """Query embeddings of this network, `model@revision/dim`."""
        return self._space

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Candidates on the frame at `position`."""
        views = chunk_views(frames, reconstruction, self._settings)
        return choose_candidates(self.segment(frames[position].color), views, position, self._settings.candidates)

    def segment(self, color: NDArray[np.uint8]) -> SoftMasks:
        """Return the network's masks of one picture (H, W, 3), without empty queries."""
        import torch

        with torch.inference_mode():
            picture = network_input(color, self._shape, self._device, self._network.dtype)
            out = self._network(pixel_values=picture)
            chance = out.class_queries_logits[0].float().softmax(dim=-1)[:, :-1]
            score, kind = chance.max(dim=-1)
            keep = torch.nonzero(score >= self._settings.candidates.min_score)[:, 0]
            probability = to_picture(out.masks_queries_logits[0][keep], self._shape, *color.shape[:2]).sigmoid()
            features = self._embedding(out)[keep].float()
        names = tuple(self._names.get(k, f"class {k}") for k in kind[keep].tolist())
        return SoftMasks(probability.cpu().numpy(), score[keep].cpu().numpy(), features.cpu().numpy(), names)

    def _embedding(self, out: Any) -> torch.Tensor:
        """Return the final embedding of each query. Shape (Q, D)."""
        if hasattr(out, "transformer_decoder_last_hidden_state"):
            states: torch.Tensor = out.transformer_decoder_last_hidden_state
            return states[0] if states.shape[0] == 1 else states[:, 0]
        last: torch.Tensor = out.last_hidden_state
        return last[0, : self._queries]


def _sides(size: Any) -> tuple[int, int]:
    """Height and width of a size as configurations have it."""
    return (int(size), int(size)) if isinstance(size, int) else (int(size[0]), int(size[1]))

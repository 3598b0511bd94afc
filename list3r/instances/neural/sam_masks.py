"""Discovery by prompting SAM 2 or SAM 3 with a grid of points: every mask that is sure and stable, without names.

The rule of the automatic mask generators: predicted quality, stability of the mask under another threshold, and no
two masks that are nearly one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.views import chunk_views
from list3r.instances.neural.candidates import SoftMasks, choose_candidates
from list3r.instances.settings import InstanceSettings
from list3r.models.images import network_input, sam_input, to_picture
from list3r.models.pretrained import load_named, space_name
from list3r.reconstruction.base import Reconstruction

if TYPE_CHECKING:
    import torch

CLASSES = {"sam2": "Sam2Model", "sam3": "Sam3TrackerModel"}


class SamMasks:
    """Discoverer: masks of everything, with the mean of the image embedding inside each as its feature."""

    def __init__(
        self,
        model: str,
        folder: Path,
        device: str = "auto",
        settings: InstanceSettings | None = None,
    ) -> None:
        """`model` is sam2 or sam3, `folder` holds its configuration and weights. Raises `OptionError`."""
        self._network, self._device = load_named(CLASSES, "discovery", model, folder, device)
        self._settings = settings or InstanceSettings()
        self._sam = self._settings.sam
        self._shape = sam_input(model, int(self._network.prompt_encoder.input_image_size))
        self._space = space_name(model, folder, int(self._network.config.mask_decoder_config.hidden_size))

    @property
    def feature_space(self) -> str:
        """Means of the image embedding inside the masks, `model@revision/dim`."""
        return self._space

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Candidates on the frame at `position`."""
        views = chunk_views(frames, reconstruction, self._settings)
        return choose_candidates(self.segment(frames[position].color), views, position, self._sam.candidates)

    def segment(self, color: NDArray[np.uint8]) -> SoftMasks:
        """All good masks of one picture (H, W, 3)."""
        import torch

        with torch.inference_mode():
            picture = network_input(color, self._shape, self._device, self._network.dtype)
            embeddings = self._network.get_image_embeddings(picture)
            logits, quality = self._prompt(embeddings)
            order = torch.argsort(quality, descending=True, stable=True)
            chosen = _distinct(logits[order] > 0, self._sam.max_iou)
            logits, quality = logits[order][chosen], quality[order][chosen]
            features = _pool(embeddings[-1][0].float(), logits)
            probability = to_picture(logits, self._shape, *color.shape[:2]).sigmoid()
        return SoftMasks(probability.cpu().numpy(), quality.cpu().numpy(), features.cpu().numpy())

    def _prompt(self, embeddings: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits (N, h, w) and quality (N,) of the masks that pass, over the grid of points."""
        import torch

        size, side = self._shape.height, self._sam.points_per_side
        at = (torch.arange(side, device=self._device) + 0.5) * size / side
        grid = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
        found_logits, found_quality = [], []
        step, done = self._sam.points_at_once, 0
        while done < len(grid):
            points = grid[done : done + step][None, :, None, :]  # whole pixels are lost in half precision
            try:
                out = self._network(image_embeddings=list(embeddings), input_points=points, multimask_output=True)
            except torch.OutOfMemoryError:
                if step == 1:
                    raise
                step = max(1, step // 2)
                torch.cuda.empty_cache()
                continue
            done += step
            logits = out.pred_masks[0].float().flatten(0, 1)
            quality = out.iou_scores[0].float().flatten()
            good = (quality >= self._sam.min_quality) & (_stability(logits) >= self._sam.min_stability)
            found_logits.append(logits[good])
            found_quality.append(quality[good].clamp(0.0, 1.0))
        return torch.cat(found_logits), torch.cat(found_quality)


def _stability(logits: torch.Tensor) -> torch.Tensor:
    inner = (logits > 1.0).flatten(1).sum(dim=1)
    outer = (logits > -1.0).flatten(1).sum(dim=1)
    return inner / outer.clamp(min=1)


def _distinct(masks: torch.Tensor, max_iou: float) -> torch.Tensor:
    """Positions of masks (N, h, w), best first, that overlap no better one that stays by more than `max_iou`."""
    import torch

    flat = masks.flatten(1).float()
    area = flat.sum(dim=1)
    kept: list[int] = []
    for n in range(len(flat)):
        if area[n] == 0:
            continue
        shared = flat[kept] @ flat[n] if kept else flat.new_zeros(0)
        union = area[kept] + area[n] - shared if kept else shared
        if not bool((shared > max_iou * union).any()):
            kept.append(n)
    return torch.tensor(kept, dtype=torch.long, device=masks.device)


def _pool(embedding: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    """Mean of an embedding (D, h, w) inside each mask (N, H, W). Shape (N, D)."""
    from torch.nn import functional

    if len(logits) == 0:
        return logits.new_zeros((0, embedding.shape[0]))
    weight = functional.interpolate((logits > 0).float()[None], size=embedding.shape[-2:], mode="area")[0].flatten(1)
    pooled = weight @ embedding.flatten(1).T
    return pooled / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)

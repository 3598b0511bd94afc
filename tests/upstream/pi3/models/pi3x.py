"""Pi3X: as Pi3, can be told intrinsics, and says a metric scale."""

from __future__ import annotations

import torch

from pi3.models.pi3 import Pi3


class Pi3X(Pi3):
    """What it was told is kept, for tests to look at."""

    told: torch.Tensor | None = None

    def forward(  # type: ignore[override]
        self,
        imgs: torch.Tensor,
        depths: torch.Tensor | None = None,
        intrinsics: torch.Tensor | None = None,
        rays: torch.Tensor | None = None,
        poses: torch.Tensor | None = None,
        with_prior: bool = True,
        mask_add_depth: torch.Tensor | None = None,
        mask_add_ray: torch.Tensor | None = None,
        mask_add_pose: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        assert (intrinsics is None) == (mask_add_ray is None)
        if intrinsics is not None and mask_add_ray is not None:
            assert intrinsics.shape == (1, imgs.shape[1], 3, 3) and mask_add_ray.dtype == torch.bool
            type(self).told = intrinsics[0, 0]
        out = super().forward(imgs)
        return {**out, "metric": torch.ones(1)}

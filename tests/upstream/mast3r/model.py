"""MASt3R: what DUSt3R says, and descriptors."""

from __future__ import annotations

from typing import Any

from dust3r.model import AsymmetricCroCo3DStereo


class AsymmetricMASt3R(AsymmetricCroCo3DStereo):
    """Pairs of pictures."""

    def forward(self, view1: dict[str, Any], view2: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        first, second = super().forward(view1, view2)
        return tuple(s | {"desc": None, "desc_conf": s["conf"]} for s in (first, second))  # type: ignore[return-value]

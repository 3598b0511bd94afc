"""Semantic labels of prims: class, the names of COCO, material."""

from __future__ import annotations

import re

from pxr import Sdf, Usd

from list3r.memory.core.description.coco import COCO_80
from list3r.memory.core.records import Instance


def set_labels(prim: Usd.Prim, instance: Instance) -> None:
    """Set the semantic label in the taxonomy `class`, and in `coco` where the label is one of its 80."""
    set_token(prim, "class", class_token(instance))
    if (instance.label or "").lower() in COCO_80:
        set_token(prim, "coco", str(instance.label).lower())


def set_token(prim: Usd.Prim, taxonomy: str, token: str) -> None:
    """Set one label; by hand where this build of USD has no `UsdSemantics`."""
    try:
        from pxr import UsdSemantics
    except ImportError:
        prim.AddAppliedSchema(f"SemanticsLabelsAPI:{taxonomy}")
        name = f"semantics:labels:{taxonomy}"
        prim.CreateAttribute(name, Sdf.ValueTypeNames.TokenArray, custom=False).Set([token])
        return
    UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([token])


def class_token(instance: Instance) -> str:
    """Return label, else kind of structure, else the words of the description before its first comma, as one token."""
    words = instance.label or instance.structure or instance.description.split(",")[0]
    return re.sub(r"\W+", "_", words.strip().lower()).strip("_") or "unknown"

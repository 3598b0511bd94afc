"""The instances of a memory on coarse grids seen from above, as language models are asked to imagine them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from list3r.exporters.prompt.scene_text import name_of
from list3r.memory.core.records import Instance

GRIDS = (10, 20)
"""Cells along a side."""


def cognitive_maps(instances: Sequence[Instance], units: str) -> dict[str, Any]:
    """Return the grids of every part of a memory that shares one frame of reference, as plain JSON values.

    A grid is a square that holds the centres of all instances; cells are [column, row], counted from 0 along +x and +y.
    `objects` gives the cells by name and `instances` by id.
    """
    placed = [i for i in instances if i.structure is None and np.isfinite(i.center).all()]
    parts = sorted({i.component for i in placed})
    grids = [_grid([i for i in placed if i.component == part], part, cells) for part in parts for cells in GRIDS]
    return {
        "format": "list3r-cognitive-map",
        "version": 1,
        "units": units,
        "axes": "column along +x, row along +y, both from 0; z is up",
        "grids": grids,
    }


def _grid(shown: Sequence[Instance], part: int, cells: int) -> dict[str, Any]:
    centers = np.array([i.center[:2] for i in shown])
    low, high = centers.min(axis=0), centers.max(axis=0)
    side = float((high - low).max()) or 1.0
    origin = (low + high) / 2 - side / 2
    at = np.clip(np.floor((centers - origin) / side * cells), 0, cells - 1).astype(int)
    objects: dict[str, list[list[int]]] = {}
    for i, cell in zip(shown, at.tolist(), strict=True):
        objects.setdefault(name_of(i), []).append(cell)
    return {
        "part": part,
        "cells": cells,
        "cell_size": round(side / cells, 6),
        "origin": [round(float(v), 6) for v in origin],
        "objects": objects,
        "instances": {str(i.id): cell for i, cell in zip(shown, at.tolist(), strict=True)},
    }

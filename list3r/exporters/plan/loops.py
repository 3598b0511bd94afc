"""Loop closures on the plan view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.components import Component
from list3r.memory.store.store import Store


def loop_ends(store: Store, component: Component) -> NDArray[np.float64]:
    """Return camera positions of the two frames of every accepted loop inside a component, world. Shape (L, 2, 3)."""
    session_of = {c.chunk_id: c.session_id for c in component.chunks}
    camera = {(f.session_id, f.frame_index): S_world_cam.translation for f, S_world_cam in component.poses}
    ends = []
    for edge in store.edges.all():
        if edge.kind != "loop" or not edge.accepted or edge.frames is None:
            continue
        pair = [camera.get((session_of.get(k, -1), n)) for k, n in zip((edge.u, edge.v), edge.frames, strict=True)]
        if pair[0] is not None and pair[1] is not None:
            ends.append((pair[0], pair[1]))
    return np.array(ends, dtype=np.float64).reshape(-1, 2, 3)

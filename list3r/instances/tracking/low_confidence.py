"""Low-confidence segments: not listed, kept as seen on the anchors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.geometric.support import collect_supports
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.settings import InstanceSettings
from list3r.instances.tracking.reprojection import LabelledChunk, mask_track
from list3r.memory.core.records import LocalInstance


def low_confidence_instances(
    views: ChunkViews, proposals: Sequence[Proposals], settings: InstanceSettings, first_id: int
) -> tuple[LocalInstance, ...]:
    """Return the low-confidence segments of a chunk, with local ids from `first_id` on, grouped by `identity`. They are
    seen on anchors alone: tracking them from frame to frame is not worth the time.
    """
    numbered = [(p, p.identity) for p in proposals if p.identity is not None and len(p.score)]
    if not numbered:
        return ()
    kept, numbers, s = [p for p, _ in numbered], [n for _, n in numbered], settings.low_confidence
    count = 1 + max(int(n.max()) for n in numbers)
    stride, images = views.stride, dict[int, NDArray[np.int32]]()
    for p, n in numbered:
        images[p.position] = np.append(0, n + 1).astype(np.int32)[p.labels[::stride, ::stride]]
    supports = collect_supports(views, kept, list(images.values()), count, s.support_points)
    tracks = LabelledChunk(views, kept, numbers, supports, settings).follow(images.__getitem__, sorted(images))
    whole = {k: float(v) for p, n in numbered for k, v in zip(n.tolist(), p.score, strict=True)}
    feature = {k: v for p, n in numbered for k, v in zip(n.tolist(), p.features, strict=True)}
    camera, least = views.reconstruction.camera, min(s.least_anchors, len(views.anchors))
    out: list[LocalInstance] = []
    for number, (track, support) in enumerate(zip(tracks, supports, strict=True)):
        if len(track.frames) >= least and len(support.points) >= s.least_points:
            seen = mask_track(track.frames, track.masks, track.visible, (camera.height, camera.width))
            out.append(LocalInstance(first_id + len(out), seen, feature[number], support, whole[number]))
    return tuple(out)

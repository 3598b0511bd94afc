"""Before the chunks of a video of wide steps: one map of all of it, and chunks that suit such a map (decision 0074)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from list3r.frames.base import FrameSource
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan, even_chunks
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.registry import entry

if TYPE_CHECKING:
    from list3r.association.whole_map.video_map import VideoMap


def takes_wide_steps(source: FrameSource, settings: BuildSettings) -> bool:
    """Tell whether a video is one to be mapped as a whole, by a model that can."""
    s = settings
    if not entry(s.reconstruction).maps_videos or (s.poses, s.local_features) != ("estimate", "sift"):
        return False
    from list3r.association.whole_map import source as whole_map

    return whole_map.takes_wide_steps(source, s.video_map, s.pace)


def map_whole(source: FrameSource, settings: BuildSettings) -> VideoMap | None:
    """Return the map of a whole video, by Frame.index; None where it gives none."""
    from list3r.association.whole_map.source import map_source

    with threadpool_limits(1):
        return map_source(source, settings.models.sfm, settings.video_map)


def map_spans(source: FrameSource, settings: BuildSettings, usual: Sequence[ChunkSpan]) -> list[ChunkSpan]:
    """Return the chunks of a video whose map tells their poses: of even length, so that processes end together, and
    with little overlap; the `usual` ones where lengths were asked for."""
    if settings.chunks != ChunkSettings():
        return list(usual)
    return even_chunks(source.info.frame_count, settings.video_map.chunks)

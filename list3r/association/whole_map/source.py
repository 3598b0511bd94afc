"""Which videos are mapped as a whole, and the map of one by its source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from list3r.association.whole_map.settings import VideoMapSettings
from list3r.association.whole_map.video_map import VideoMap, map_video
from list3r.frames.base import Frame, FrameSource
from list3r.frames.chunking.pace import PaceSettings, picture_flows
from list3r.reconstruction.sfm.settings import SfmSettings


def takes_wide_steps(source: FrameSource, settings: VideoMapSettings, pace: PaceSettings) -> bool:
    """Return whether a video is short and its steps are wide enough to be mapped as a whole."""
    if not settings.least_frames <= source.info.frame_count <= settings.most_frames:
        return False
    flows = picture_flows(source, pace)
    return len(flows) >= pace.least_spots and float(np.median(flows)) >= settings.least_flow


def map_source(source: FrameSource, sfm: SfmSettings, settings: VideoMapSettings) -> VideoMap | None:
    """Return the map of a video whose camera is known, by Frame.index; None where it gives none.

    It is stored only in the chunks' poses: the same video and camera give the same map again.
    """
    camera = source.info.camera
    assert camera is not None, "the camera is estimated before"
    frames = [(f.index, f.gray()) for f in source.read(0, source.info.frame_count) if isinstance(f, Frame)]
    found = map_video([gray for _, gray in frames], camera, sfm, settings)
    if found is None:
        return None
    index = [k for k, _ in frames]
    return replace(
        found,
        T_map_cam={index[k]: T for k, T in found.T_map_cam.items()},
        revisits=[(index[a], index[b], count) for a, b, count in found.revisits],
    )

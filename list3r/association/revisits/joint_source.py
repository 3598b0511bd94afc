"""Joint windows from the sources of a memory: the frames of both places are read again and reconstructed together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from list3r.frames.base import Frame, FrameSource, guessed_camera
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import TrackingError
from list3r.memory.core.records import JointWindow
from list3r.reconstruction.base import Reconstructor, WindowSide, reconstruct_jointly
from list3r.reconstruction.keyframe_record import frame_samples


class JointSourceReconstructor:
    """A `JointReconstructor` that reads the sessions' sources, opened when a window is first asked for.

    By session id, `paths` are those of the sources and `options` those of the build; defaults if not set.
    """

    def __init__(
        self, paths: Mapping[int, str], options: Mapping[int, SourceOptions], reconstructor: Reconstructor
    ) -> None:
        self._paths, self._options, self._reconstructor = paths, options, reconstructor
        self._sources: dict[int, FrameSource] = {}

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        """The window of frames (Frame.index) of two sessions; None when its two sides cannot be related.

        Raises `SourceError` when a session's source is no longer there.
        """
        u, v = self._read(u_session, u_frames), self._read(v_session, v_frames)
        if not u or not v:
            return None
        try:
            one, two = reconstruct_jointly(self._reconstructor, (self._side(u_session, u), self._side(v_session, v)))
        except TrackingError:
            return None
        if min(int(one.posed.sum()), int(two.posed.sum())) < 2:
            return None
        return JointWindow(frame_samples(one), frame_samples(two), one.scale_kind)

    def _side(self, session_id: int, frames: Sequence[Frame]) -> WindowSide:
        info = self._source(session_id).info
        return WindowSide(frames, info.camera or guessed_camera(info), info.camera is not None)

    def _source(self, session_id: int) -> FrameSource:
        if session_id not in self._sources:
            path = self._paths[session_id]
            self._sources[session_id] = open_source(path, self._options.get(session_id, SourceOptions()))
        return self._sources[session_id]

    def _read(self, session_id: int, indices: Sequence[int]) -> list[Frame]:
        source = self._source(session_id)
        wanted = sorted({source.position(int(i)) for i in indices})
        if not wanted:
            return []
        read = source.read(wanted[0], wanted[-1] + 1)
        return [f for f in read if isinstance(f, Frame) and f.index in set(indices)]

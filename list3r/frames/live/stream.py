"""A webcam or the address of a network stream, read by FFmpeg."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from list3r.frames.live.addresses import DEVICES, is_phone, without_secrets
from list3r.frames.live.camera import LiveCamera, LivePicture, LostError
from list3r.frames.live.feed import Tell
from list3r.frames.live.record3d import Record3dPhone
from list3r.frames.writers.base import jpeg
from list3r.memory.core.errors import OptionError, SourceError


def open_camera(source: str, tell: Tell) -> LiveCamera:
    """Return what the pictures of a stream come from; nothing is connected yet. Raises `OptionError`."""
    if is_phone(source):
        return Record3dPhone(source.partition(":")[2].strip("/"), tell)
    if source.startswith(DEVICES) and not Path(source).exists():
        others = ", ".join(str(p) for p in sorted(Path(DEVICES).parent.glob(f"{Path(DEVICES).name}*")))
        raise OptionError(f"there is no webcam {source}; there is {others or 'none at all'}")
    return NetworkStream(source)


class NetworkStream:
    """A `LiveCamera` that FFmpeg reads."""

    def __init__(self, source: str) -> None:
        self._source, self.name = source, without_secrets(source)

    def pictures(self, folder: Path, silence_s: float) -> Iterator[LivePicture]:
        wait = {"rw_timeout": str(int(1e6 * silence_s)), "fflags": "nobuffer"}
        kind = "v4l2" if self._source.startswith(DEVICES) else None
        words = {} if kind else wait | ({"rtsp_transport": "tcp"} if self._source.startswith("rtsp") else {})
        try:
            with av.open(self._source, format=kind, options=words, timeout=(2 * silence_s, silence_s)) as container:
                if not container.streams.video:
                    raise SourceError(f"{self.name} has no pictures")
                finite = bool(container.duration and container.duration > 0)
                for image in container.decode(video=0):
                    color = np.asarray(image.to_ndarray(format="rgb24"), np.uint8)
                    yield LivePicture(partial(_files, color), last_is_end=finite)
        except av.FFmpegError as error:
            raise LostError(error.strerror or str(error)) from None


def _files(color: NDArray[np.uint8]) -> dict[str, bytes]:
    return {".jpg": jpeg(color)}

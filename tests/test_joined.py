"""Several video files of one recording read as one."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError


def write(path: Path, first: int, count: int, size: tuple[int, int] = (64, 48)) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for k in range(first, first + count):
            picture = np.full((size[1], size[0], 3), 8 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("joined")
    return [write(root / "a.mp4", 0, 7), write(root / "b.mp4", 7, 5), write(root / "c.mp4", 12, 6)]


def opened(files: list[Path], **more: object) -> object:
    return open_source(files[0], SourceOptions(more=tuple(map(str, files[1:])), **more))  # type: ignore[arg-type]


def level(frame: object) -> int:
    assert isinstance(frame, Frame)
    return round(float(frame.color.mean()) / 8)


def test_frames_are_numbered_and_timed_through(files: list[Path]) -> None:
    source = opened(files)
    found = list(source.read(0, 18))
    assert [f.index for f in found] == list(range(18)) == [level(f) for f in found]
    assert all(b.time_s - a.time_s == pytest.approx(0.1, abs=1e-3) for a, b in pairwise(found))
    assert [source.position(k) for k in range(18)] == list(range(18))
    assert source.info.frame_count == 18 and any("3 files" in note for note in source.info.notes)


@pytest.mark.parametrize(("start", "stop", "step"), [(5, 14, 1), (0, 18, 4), (6, 17, 5), (8, 8, 1), (12, 40, 2)])
def test_any_stretch_is_that_of_the_whole(files: list[Path], start: int, stop: int, step: int) -> None:
    source = opened(files)
    assert [level(f) for f in source.read_every(start, stop, step)] == list(range(18))[start:stop:step]
    assert len(list(source.read_grays(start, stop))) == len(range(18)[start:stop])
    assert len(list(source.thumbnails())) == 18


def test_the_order_and_every_file_shape_the_fingerprint(files: list[Path]) -> None:
    prints = {opened(f).info.fingerprint for f in (files, files[:2], [files[1], files[0], files[2]])}
    assert len(prints | {open_source(files[0]).info.fingerprint}) == 4


def test_what_is_not_one_recording_is_refused(files: list[Path], tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="give files of one recording"):
        opened([files[0], write(tmp_path / "wide.mp4", 0, 3, (96, 48))])
    with pytest.raises(SourceError, match="not a video file"):
        opened([files[0], tmp_path])
    with pytest.raises(OptionError, match="one file"):
        opened(files, stop=9)

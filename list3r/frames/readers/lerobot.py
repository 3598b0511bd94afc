"""One episode of a LeRobot data set (version 3), as one camera of the robot filmed it.

`meta/info.json` names the features, `meta/episodes/*/*.parquet` says where each episode lies in the files of each
camera (`videos/KEY/chunk-NNN/file-NNN.mp4`, many episodes in one). Depth is a video of 12 bits whose codes lie evenly
over the depth or its logarithm (`video.depth_min`, `depth_max`, `shift`, `use_log`), or of 16 bits in millimetres.
There are no cameras and no poses of cameras in the layout; states of the robot are named and not used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource, SourceInfo
from list3r.frames.layout import FolderLayout, Optics
from list3r.frames.listing import FrameFiles
from list3r.frames.options import SourceOptions
from list3r.frames.readers.video import VideoSource
from list3r.frames.recordings.depth_code import DepthCode, bits_of, metres_of
from list3r.frames.recordings.lerobot_tables import INFO, Episode, read_episode, read_features
from list3r.frames.registration.rig import WORKING_SIDES, build_rig, merge_optics
from list3r.memory.core.errors import FrameError, OptionError, SourceError

_LATE = 0.5
"""Frames by which the times of a video may differ from those of the table."""


def is_dataset(root: Path) -> bool:
    """Return whether a folder is such a data set, of any version."""
    return (root / INFO).is_file() and ((root / "data").is_dir() or (root / "videos").is_dir())


class LeRobotSource(FrameSource):
    """A `FrameSource`: the pictures of one camera in one episode, numbered from 0, with depth where a key has it."""

    def __init__(self, root: Path, options: SourceOptions) -> None:
        """Raises `SourceError` for a data set that cannot be read, `OptionError` for what has to be chosen."""
        features, fps = read_features(root / INFO)
        filmed = {k: f for k, f in features.items() if f.get("dtype") == "video"}
        keys = {k: f for k, f in filmed.items() if not _is_depth(f)}
        depth_keys = {k: f for k, f in filmed.items() if _is_depth(f)}
        if "pose" in options.topics_by_role():
            raise OptionError(f"{root} has no poses of cameras; leave pose= out of --topics")
        color = _choose(root, "color", keys, options)
        depth = _choose_depth(root, depth_keys, options, color)
        episode = read_episode(root, [color] if depth is None else [color, depth], options.episode)
        self._video, self._first = _video(episode, color, options, fps, with_depth=depth is not None)
        self._depth = None
        if depth is not None:
            file, begins_s = episode.videos[depth]
            code = DepthCode.of(filmed[depth].get("info"))
            self._depth = _DepthVideo(file, round(begins_s * fps), episode.length, code)
        stored = self._video.stored_size
        optics, merged_notes = merge_optics(FolderLayout("lerobot", FrameFiles(), Optics(depth_scale=1.0)), options)
        size = None if self._depth is None else self._depth.size
        self._rig = build_rig(optics, stored, size, options.max_depth_m, _side(options, depth is not None))
        used = {color} if depth is None else {color, depth}
        notes = [f"episode {episode.number}, {episode.length} frames, of the camera {color}", *merged_notes]
        if depth is not None and self._rig.registration is None:
            notes.append(f"depth of {depth} is assumed to lie on the colour pixels; --depth-to-color changes that")
        if unused := [k for k in features if k not in used and k not in _BOOKKEEPING]:
            notes.append(f"not used: {', '.join(unused)}")
        self._info = self._describe(root, options, episode, tuple(notes))

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        depths: Iterator[tuple[int, NDArray[np.float32] | None]] | None = None
        for frame in self._video.read_every(start, stop, step):
            number = frame.index - self._first
            if isinstance(frame, BadFrame):
                yield replace(frame, index=number)
                continue
            time_s = frame.time_s - self._video.time_s(self._first)
            frame = replace(frame, index=number, time_s=time_s)
            if self._depth is None:
                yield frame
                continue
            depths = self._depth.read(number) if depths is None else depths
            raw = next((image for k, image in depths if k == number), None)
            yield self._with_depth(frame, raw)

    def position(self, index: int) -> int:
        return self._video.position(index + self._first)

    def thumbnails(self) -> Iterator[NDArray[np.uint8] | None]:
        return self._video.thumbnails()

    def read_grays(self, start: int, stop: int) -> Iterator[NDArray[np.uint8] | None]:
        return self._video.read_grays(start, stop)

    def _with_depth(self, frame: Frame, raw: NDArray[np.float32] | None) -> Frame | BadFrame:
        if raw is None:
            return BadFrame(frame.index, "the video of depth is damaged here")
        try:
            return replace(frame, depth=self._rig.depth(raw))
        except FrameError as error:
            return BadFrame(frame.index, str(error))

    def _describe(self, root: Path, options: SourceOptions, episode: Episode, notes: tuple[str, ...]) -> SourceInfo:
        info, separate, has_depth = self._video.info, self._rig.registration, self._depth is not None
        print_ = f"{info.fingerprint} {episode.number} {options.max_depth_m} {options.depth_scale}"
        print_ += "" if self._depth is None else f" {self._depth.path.name} {self._depth.path.stat().st_size}"
        return replace(
            info,
            kind="lerobot",
            path=str(root),
            has_depth=has_depth,
            fingerprint=hashlib.sha256(print_.encode()).hexdigest()[:32],
            depth_camera=separate.depth_camera if separate else None,
            T_color_depth=separate.T_color_depth if separate else None,
            depth_scale=self._rig.depth_scale if has_depth else None,
            notes=(*info.notes, *notes),
        )


_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Features that number the frames."""


def _is_depth(feature: Mapping[str, Any]) -> bool:
    about = {**_table(feature.get("video_info")), **_table(feature.get("info"))}
    return bool(about.get("is_depth_map") or about.get("video.is_depth_map"))


def _table(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _choose(root: Path, role: str, keys: Mapping[str, Any], options: SourceOptions) -> str:
    """The key that was asked for, or the only one. Raises `OptionError`."""
    wanted = options.topics_by_role().get(role)
    names = ", ".join(sorted(keys)) or "none"
    if wanted is None and len(keys) == 1:
        return next(iter(keys))
    if wanted is None or wanted not in keys:
        problem = "has several cameras" if wanted is None else f"has no camera {wanted}"
        raise OptionError(f"{root} {problem} ({names}); choose by --topics {role}=KEY")
    return wanted


def _choose_depth(root: Path, keys: Mapping[str, Any], options: SourceOptions, color: str) -> str | None:
    """The depth that goes with a camera: what was asked for, what is named after it, or the only one; None for none."""
    topics = options.topics_by_role()
    if not keys or "depth" in topics:
        return _choose(root, "depth", keys, options) if "depth" in topics else None
    named = [k for k in keys if k.replace("_depth", "").replace("depth", "") in (color, color.replace("_rgb", ""))]
    if len(named) == 1:
        return named[0]
    if "color" in topics and not named:
        return None
    return _choose(root, "depth", keys, options)


def _side(options: SourceOptions, has_depth: bool) -> int:
    return WORKING_SIDES[has_depth] if options.max_side is None else options.max_side


def _video(
    episode: Episode, key: str, options: SourceOptions, fps: float, *, with_depth: bool
) -> tuple[VideoSource, int]:
    """The frames of an episode that the options leave, and the number of its first in the file. Raises errors."""
    path, begins_s = episode.videos[key]
    first = round(begins_s * fps)
    start, stop = options.start or 0, min(episode.length, options.stop or episode.length)
    if options.start_s is not None:
        start = max(start, int(np.ceil(options.start_s * fps - 1e-6)))
    if options.end_s is not None:
        stop = min(stop, int(np.ceil(options.end_s * fps - 1e-6)))
    if start >= stop:
        raise OptionError(f"the options leave nothing of episode {episode.number}, which has {episode.length} frames")
    words = replace(
        options, kind="auto", start=first + start, stop=first + stop, start_s=None, end_s=None, topics=None,
        episode=None, depth_scale=None, depth_intrinsics=None, T_color_depth=None, registered=False,
        max_side=_side(options, with_depth),
    )  # fmt: skip
    video = VideoSource(path, words, whole=True)
    missing = first + episode.length - video.stored_count
    late = abs(video.time_s(min(first, video.stored_count - 1)) - video.time_s(0) - begins_s) * fps
    if missing > 0 or late > _LATE:
        why = f"{missing} frames are missing" if missing > 0 else f"it begins {late:.0f} frames off"
        raise SourceError(f"{path} does not hold episode {episode.number} as the table says: {why}; copy it again")
    return video, first


class _DepthVideo:
    """The depth images of one episode, by number, read in order."""

    def __init__(self, path: Path, first: int, length: int, code: DepthCode | None) -> None:
        """`first` is the number of the episode's first frame in the file. Raises `SourceError`."""
        self.path, self._first, self._stop, self._code = path, first, first + length, code
        self._video = VideoSource(path, SourceOptions(max_side=0), whole=True)
        if self._video.stored_count < first + length:
            raise SourceError(f"{path} ends after {self._video.stored_count} of {first + length} frames; copy it again")
        self.size = self._video.stored_size
        """(height, width), px."""
        image = next((image for _, image in self._video.pictures(first, self._stop) if image is not None), None)
        bits = 0 if image is None else bits_of(image)
        if bits <= 8 or (code is None and bits < 16):
            raise SourceError(
                f"{path} holds depth in {bits} bits a pixel without saying what they mean; choose another camera by "
                "--topics, or record depth again"
            )

    def read(self, number: int) -> Iterator[tuple[int, NDArray[np.float32] | None]]:
        """Yield numbers within the episode from `number` on, and depth in metres; None where it is damaged."""
        for k, image in self._video.pictures(self._first + number, self._stop):
            yield k - self._first, None if image is None else metres_of(image, self._code)

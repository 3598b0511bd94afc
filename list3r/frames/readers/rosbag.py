"""Recordings of robots: a ROS 1 `.bag` (RealSense's too), a ROS 2 folder, `.mcap` or `.db3`, read by `rosbags`.

The topics of colour, depth and poses are those that fit, or what `--topics color=/a,depth=/b,pose=/c` says. Colour and
depth are brought together by the times in their headers. Poses come from an odometry or pose topic, or from `/tf`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource, Listing, SourceInfo
from list3r.frames.beside import role_of
from list3r.frames.files import check_ordinary
from list3r.frames.folder import fingerprint, without_pose
from list3r.frames.layout import FolderLayout, Optics
from list3r.frames.listing import FrameFiles
from list3r.frames.options import SourceOptions
from list3r.frames.readers.tum import MAX_PAIR_GAP_S, associate
from list3r.frames.recordings.bag_chunks import bound_rosbags
from list3r.frames.recordings.ros_images import camera_of, is_depth, read_color, read_depth
from list3r.frames.recordings.ros_transforms import DRIFTING, TransformTree
from list3r.frames.registration.rig import build_rig, merge_optics
from list3r.frames.selection import select
from list3r.memory.core.errors import FrameError, OptionError, SourceError, first_line, install_hint

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

ENDINGS = (".bag", ".mcap", ".db3")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TF = "tf2_msgs/msg/TFMessage"
_INFO = "sensor_msgs/msg/CameraInfo"
_UNITS = "/option/Depth_Units/value"
_REPORTED_EVERY = 200
"""Messages after which whoever watches hears of the listing."""
_PACKED = ".zstd"
"""Ends the names of files that `ros2 bag record --compression-mode file` packed, also in metadata, which stay so."""
_NAMED = 8
"""Topics that are named in a message."""
_MOST_BYTES = 2**50
"""Of a recording: it is read message by message."""


def is_recording(path: Path) -> bool:
    """Whether a path is such a recording, by its name or, of a folder, by what is in it. One that was killed, or still
    runs, has no metadata. Raises `SourceError` for files that are packed as a whole.
    """
    packed = [path] if path.is_file() else [p for end in ENDINGS for p in path.glob(f"*{end}{_PACKED}")]
    if any(p.name.endswith(tuple(end + _PACKED for end in ENDINGS)) for p in packed):
        raise SourceError(f"{path} is compressed as a whole: unpack it (`zstd -d --rm {packed[0]}`), and give it again")
    if path.is_dir():
        return bool(_files(path))
    return path.suffix.lower() in ENDINGS or path.name.endswith(".bag.active")


def _files(path: Path) -> list[Path]:
    """The files of a folder that hold messages."""
    return sorted(p for end in ENDINGS[1:] for p in path.glob(f"*{end}"))


@dataclass(frozen=True)
class Stream:
    """The messages of an image topic."""

    topic: str
    times_s: NDArray[np.float64]
    """Of their headers, ascending. Shape (N,)."""
    received_ns: NDArray[np.int64]
    """When they were recorded, in the same order. Shape (N,)."""
    frame: str
    """Name of the camera's frame of reference."""
    first: Any
    """The first message."""


class BagSource(FrameSource):
    """A `FrameSource` over one recording; nothing but its index is kept."""

    def __init__(self, path: Path, options: SourceOptions, listing: Listing | None = None) -> None:
        """One pass over the recording, of which `listing` hears: messages looked at, and in all.

        Raises `SourceError` for what cannot be read and `OptionError` for topics.
        """
        self._path, self._options = path, options
        wanted = options.topics_by_role()
        with _opened(path) as reader:
            found = _Topics(reader, wanted, path, listing)
            color = found.color()
            depth = found.depth()
            tree = found.transforms(color.frame)
            optics, notes = found.optics(color, depth, tree)
            unread = found.unread({color.topic} | ({depth.topic} if depth else set()))
        self._color, self._depth = color, depth
        pairs = np.stack([np.arange(len(color.times_s))] * 2, axis=1)
        if depth is not None:
            pairs = associate(color.times_s, depth.times_s, MAX_PAIR_GAP_S)
            if not len(pairs):
                raise SourceError(f"{path}: no picture of {color.topic} has depth of {depth.topic} within 20 ms")
        self._pairs = pairs
        self._times_s = color.times_s[pairs[:, 0]]
        world = tree.world_of(color.frame)
        self._poses = tree.poses(color.frame, world, self._times_s) if world else [None] * len(pairs)
        self._chosen = select(self._times_s, options, path, clock=True, video=False)
        merged, merged_notes = merge_optics(FolderLayout("rosbag", FrameFiles(), optics), options)
        size = None if depth is None else read_depth(depth.first).shape
        stored = read_color(color.first).shape[:2]
        self._rig = build_rig(merged, stored, size, options.max_depth_m, options.max_side)
        posed = sum(T is not None for T in self._poses)
        notes = [*notes, *merged_notes, *unread]
        if len(pairs) < len(color.times_s):
            left = len(color.times_s) - len(pairs)
            notes.append(f"{left} of {len(color.times_s)} pictures have no depth within 20 ms and are left out")
        if posed:
            notes.append(f"poses of {color.frame} in {world}")
            if posed < len(pairs):
                notes.append(without_pose(len(pairs) - posed, len(pairs)))
        elif tree.moving:
            notes.append(f"poses of {', '.join(sorted(tree.moving))}; no transform leads from there to {color.frame}")
        self._info = replace(self._describe(tuple(notes), posed > 0), poses_drift=world == DRIFTING)

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        numbers = [int(self._chosen.starts[k]) for k in range(len(self._chosen))[start:stop:step]]
        if not numbers:
            return
        waiting: dict[int, dict[str, bytes]] = {n: {} for n in numbers}
        roles = ["color"] if self._depth is None else ["color", "depth"]
        at = {role: self._wanted(role, numbers) for role in roles}
        upcoming = iter(numbers)
        due: int | None = next(upcoming)
        with _opened(self._path) as reader:
            topics = {self._stream(role).topic: role for role in roles}
            connections = [c for c in reader.connections if c.topic in topics]
            first = min(min(stamps) for stamps in at.values())
            last = max(max(stamps) for stamps in at.values())
            for connection, received, raw in reader.messages(connections, start=first, stop=last + 1):
                role = topics[connection.topic]
                due_then = at[role].get(received)
                if not due_then:
                    continue
                waiting[due_then.pop(0)][role] = raw
                kinds = {topics[c.topic]: c.msgtype for c in connections}
                while due is not None and len(waiting[due]) == len(roles):
                    yield self._frame(reader, due, waiting.pop(due), kinds)
                    due = next(upcoming, None)
                if due is None:
                    return
        for number in [] if due is None else [due, *upcoming]:
            yield BadFrame(number, "its messages are missing from the recording")

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        numbers = [int(n) for n in self._chosen.starts]
        return [(n, float(self._times_s[n]), T) for n in numbers if (T := self._poses[n]) is not None]

    def _stream(self, role: str) -> Stream:
        stream = self._color if role == "color" else self._depth
        assert stream is not None
        return stream

    def _wanted(self, role: str, numbers: list[int]) -> dict[int, list[int]]:
        """The frame numbers of each recorded time that is to be read; several messages may have come at one time."""
        column, stream = (0 if role == "color" else 1), self._stream(role)
        out: dict[int, list[int]] = {}
        for n in numbers:
            out.setdefault(int(stream.received_ns[self._pairs[n, column]]), []).append(n)
        return out

    def _frame(
        self, reader: AnyReader, number: int, raw: Mapping[str, bytes], kinds: Mapping[str, str]
    ) -> Frame | BadFrame:
        try:
            color = self._rig.color(read_color(reader.deserialize(raw["color"], kinds["color"])))
            depth = None
            if "depth" in raw:
                depth = self._rig.depth(read_depth(reader.deserialize(raw["depth"], kinds["depth"])))
        except FrameError as error:
            return BadFrame(number, str(error))
        return Frame(number, float(self._times_s[number]), color, depth, self._poses[number])

    def _describe(self, notes: tuple[str, ...], has_poses: bool) -> SourceInfo:
        rig, separate = self._rig, self._rig.registration
        files = [self._path] if self._path.is_file() else sorted(p for p in self._path.iterdir() if p.is_file())
        listing = [(p.name, p.stat().st_size) for p in files]
        gaps = np.diff(self._times_s)
        return SourceInfo(
            kind="rosbag",
            path=str(self._path),
            frame_count=len(self._chosen),
            fps=float(1.0 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0 else 30.0,
            camera=rig.camera,
            has_depth=self._depth is not None,
            has_poses=has_poses,
            fingerprint=fingerprint("rosbag", listing, self._options),
            depth_camera=separate.depth_camera if separate else None,
            T_color_depth=separate.T_color_depth if separate else None,
            depth_scale=rig.depth_scale if self._depth is not None else None,
            notes=notes,
            image_size=rig.color_size,
        )


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """The recording, open. Raises `SourceError` for one that is cut off, has no index or is of another kind."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise OptionError(f"{path} is a ROS recording, which needs a package: {install_hint('ros')}") from None
    known = get_typestore(Stores.ROS2_HUMBLE)
    try:
        for part in [path] if path.is_file() or not path.is_dir() else sorted(path.iterdir()):
            if part == path or not part.is_dir():
                check_ordinary(part.stat(), part, _MOST_BYTES)
        with AnyReader(_parts(path), default_typestore=known) as reader:
            yield reader
    except (AnyReaderError, AssertionError, ValueError, KeyError, OSError, EOFError) as error:
        raise SourceError(
            f"{path} cannot be read as a ROS recording ({first_line(error)}); copy it again, or, where its "
            "recorder was interrupted, mend it: `rosbag reindex` for a bag, `mcap recover` for an mcap"
        ) from None


def _parts(path: Path) -> list[Path]:
    """What `rosbags` opens of a recording: its files where a folder has no metadata."""
    bound_rosbags()
    return [path] if path.is_file() or _describes(path / "metadata.yaml") else _files(path)


def _describes(metadata: Path) -> bool:
    """Whether metadata are there, and not those of files that were packed when they were written."""
    return metadata.exists() and not re.search(rf"\.(db3|mcap){_PACKED}\b", metadata.read_text("utf-8", "replace"))


class _Topics:
    """What a recording holds, looked at once."""

    def __init__(
        self, reader: AnyReader, wanted: Mapping[str, str], path: Path, listing: Listing | None = None
    ) -> None:
        self._reader, self._wanted, self._path, self._listing = reader, wanted, path, listing
        self._of = {c.topic: c for c in reader.connections}
        for role, topic in wanted.items():
            if topic not in self._of:
                raise OptionError(f"--topics {role}={topic}: {path} has {', '.join(sorted(self._of)) or 'no topics'}")
        pose = wanted.get("pose")
        if pose is not None and self._of[pose].msgtype not in _POSES:
            kinds = ", ".join(k.rsplit("/", 1)[-1] for k in _POSES)
            raise OptionError(
                f"--topics pose={pose} is {self._of[pose].msgtype}; poses are of {kinds}, or of /tf without it"
            )
        self._pose_topic = wanted.get("pose") or self._only_pose_topic()
        self._tree, self._infos = TransformTree(), dict[str, Any]()
        self._units: dict[str, float] = {}
        """Metres of a unit of depth, by the sensor's topics' beginning."""
        self._streams = self._scan()

    def color(self) -> Stream:
        """The pictures. Raises `SourceError` where none or several would fit."""
        found = [s for s in self._streams.values() if not is_depth(s.first)]
        found = [s for s in found if role_of(s.topic) != "depth"] or found
        return self._choose("color", found, ("color", "rgb"))

    def depth(self) -> Stream | None:
        """The depth images, None where there are none."""
        found = [s for s in self._streams.values() if is_depth(s.first)]
        if not found and "depth" not in self._wanted:
            return None
        chosen = self._choose("depth", found, ("aligned_depth", "depth"))
        try:
            read_depth(chosen.first)
        except FrameError as error:
            if "depth" in self._wanted:
                raise OptionError(f"--topics depth={chosen.topic}: {error}") from None
            raise SourceError(f"{self._path}: depth of {chosen.topic} cannot be read: {error}") from None
        return chosen

    def transforms(self, frame: str) -> TransformTree:
        """Where things were; a pose of a topic that does not say what it moves is that of the camera's `frame`."""
        self._tree.rename("", frame)
        return self._tree

    def optics(self, color: Stream, depth: Stream | None, tree: TransformTree) -> tuple[Optics, list[str]]:
        """The cameras that CameraInfo states, and what is assumed."""
        notes = [f"colour of {color.topic}" + (f", depth of {depth.topic}" if depth else "")]
        intrinsics, lens, size = self._camera(color)
        if depth is None:
            return Optics(intrinsics, lens, intrinsics_size=size), notes
        units = 1.0 if read_depth(depth.first).dtype.kind == "f" else 1.0 / self._unit_m(depth.topic)
        if "aligned_depth" in depth.topic or depth.frame == color.frame:
            return Optics(intrinsics, lens, depth_scale=units, intrinsics_size=size), notes
        depth_intrinsics, _, depth_size = self._camera(depth)
        T_color_depth = tree.between(color.frame, depth.frame)
        if T_color_depth is not None:
            notes.append("the pose of the depth camera is from /tf_static")
        return Optics(intrinsics, lens, depth_intrinsics, T_color_depth, units, size, depth_size), notes

    def _unit_m(self, topic: str) -> float:
        return next((unit for sensor, unit in self._units.items() if topic.startswith(sensor)), 0.001)

    def _camera(self, stream: Stream) -> tuple[Any, tuple[float, ...], tuple[int, int] | None]:
        base = stream.topic.removesuffix("/compressed").removesuffix("/compressedDepth")
        parent = base.rsplit("/", 1)[0]
        names = (f"{parent}/camera_info", f"{parent.rsplit('/', 1)[0]}/info/camera_info", f"{base}/camera_info")
        info = next((self._infos[n] for n in names if n in self._infos), None)
        if info is None:
            same = [i for i in self._infos.values() if i.header.frame_id.lstrip("/") == stream.frame]
            info = same[0] if same else None
        if info is None:
            return None, (), None
        return camera_of(info, stream.topic, rectified="rect" in base.rsplit("/", 1)[-1])

    def _choose(self, role: str, found: list[Stream], likely: tuple[str, ...]) -> Stream:
        if role in self._wanted:
            topic = self._wanted[role]
            if topic not in self._streams:
                raise OptionError(f"--topics {role}={topic} is not a topic of pictures")
            return self._streams[topic]
        for word in (*likely, ""):
            fitting = [s for s in found if word in s.topic]
            if len(fitting) == 1 or (fitting and word):
                return max(fitting, key=lambda s: (len(s.times_s), s.topic))
        names = ", ".join(s.topic for s in found)
        if not found:
            raise SourceError(f"{self._path}: no topic holds pictures (Image, CompressedImage); {self._all_topics()}")
        raise SourceError(f"{self._path}: several topics hold pictures ({names}); choose by --topics {role}=/TOPIC")

    def unread(self, pictures: set[str]) -> tuple[str, ...]:
        """Return a note on the topics that nothing is taken from, where `pictures` are those of colour and depth."""
        left = [t for t in self._of if t not in pictures and not self._taken_in(t)]
        return (f"not read: {self._named(left)}",) if left else ()

    def _taken_in(self, topic: str) -> bool:
        """Whether the cameras or poses of a topic were used."""
        kind = self._of[topic].msgtype
        return kind not in _IMAGES and self._is_read(topic, kind, self._pose_topic)

    def _all_topics(self) -> str:
        return f"it has {self._named(list(self._of))}" if self._of else "it is empty"

    def _named(self, topics: list[str]) -> str:
        """Topics with the kinds of their messages, the first of them."""
        some = [f"{t} ({self._of[t].msgtype.rsplit('/', 1)[-1]})" for t in sorted(topics)[:_NAMED]]
        return ", ".join(some) + (f" and {len(topics) - _NAMED} more" if len(topics) > _NAMED else "")

    def _scan(self) -> dict[str, Stream]:
        """One pass: times of pictures, transforms, cameras; of pictures the headers alone are read."""
        stamps: dict[str, list[tuple[float, int]]] = {}
        first: dict[str, Any] = {}
        looked_at = [c for c in self._reader.connections if self._is_read(c.topic, c.msgtype, self._pose_topic)]
        count = sum(c.msgcount for c in looked_at)
        for number, (connection, received, raw) in enumerate(self._reader.messages(looked_at), start=1):
            topic, kind = connection.topic, connection.msgtype
            if self._listing is not None and (number % _REPORTED_EVERY == 0 or number == count):
                self._listing(number, count)
            if kind not in _IMAGES:
                if topic not in self._infos:
                    self._take(topic, kind, self._reader.deserialize(raw, kind))
                continue
            if topic not in first:
                first[topic] = self._reader.deserialize(raw, kind)
            stamps.setdefault(topic, []).append((_stamp_s(raw), received))
        streams = {}
        for topic, rows in stamps.items():
            rows.sort()
            frame = first[topic].header.frame_id.lstrip("/")
            times, received_ns = np.array([t for t, _ in rows]), np.array([r for _, r in rows], np.int64)
            streams[topic] = Stream(topic, times, received_ns, frame, first[topic])
        return streams

    def _take(self, topic: str, kind: str, message: Any) -> None:
        """Take in a message that is no picture."""
        if kind == _INFO:
            self._infos[topic] = message
        elif kind == _TF and (self._pose_topic is None or "static" in topic):
            self._tree.add(message, fixed="static" in topic)
        elif topic == self._pose_topic:
            self._tree.add_pose(message, "")
        elif topic.endswith(_UNITS) and message.data > 0:
            self._units[topic.split("/option/")[0]] = float(message.data)

    @staticmethod
    def _is_read(topic: str, kind: str, pose_topic: str | None) -> bool:
        """Whether messages hold pictures, cameras or poses; clouds and the like are not read."""
        return kind in (*_IMAGES, _INFO, _TF) or topic == pose_topic or topic.endswith(_UNITS)

    def _only_pose_topic(self) -> str | None:
        """The only topic of poses where `/tf` does not move anything."""
        if any(c.msgtype == _TF and "static" not in c.topic for c in self._of.values()):
            return None
        topics = sorted({c.topic for c in self._of.values() if c.msgtype in _POSES})
        return topics[0] if len(topics) == 1 else None


def _stamp_s(raw: bytes) -> float:
    """Seconds of a message's header, without decoding the rest: after CDR's four bytes, or ROS 1's sequence number."""
    sec, nanosec = np.frombuffer(raw, "<u4", 2, 4)
    return float(sec) + 1e-9 * float(nanosec)

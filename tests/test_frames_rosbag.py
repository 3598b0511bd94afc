"""Recordings of robots: topics by what fits, times by headers, cameras and places by the recording's own transforms."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import List3rError, OptionError, SourceError
from tests import recordings
from tests.recordings import COUNT, off_plane, shots, write_bag
from tests.test_frames_recordings import frames_of, world_points

KINDS = ("bag", "mcap", "db3")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("registered", [False, True])
def test_depth_through_every_pose_lies_on_the_wall(kind: str, registered: bool, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", kind, registered=registered)
    info = open_source(path).info
    assert info.kind == "rosbag" and info.has_depth and info.has_poses and info.frame_count == COUNT
    assert (info.depth_camera is None) == registered
    for frame, shot in zip(frames_of(path), shots(), strict=True):
        off = off_plane(world_points(frame, info.camera))
        assert np.median(off) < 0.002 and np.quantile(off, 0.95) < 0.012
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)
        assert (frame.color == shot.color).all()


PACKED = [("bag", "lz4"), ("bag", "bz2"), ("mcap", "storage"), ("mcap", "message"), ("db3", "message")]


@pytest.mark.parametrize(("kind", "packed"), PACKED)
def test_messages_that_are_packed_are_those_that_are_not(kind: str, packed: str, tmp_path: Path) -> None:
    plain, small = (write_bag(tmp_path / name / "walk", kind, packed=how) for name, how in (("a", ""), ("b", packed)))
    for one, other in zip(frames_of(plain), frames_of(small), strict=True):
        assert (one.depth == other.depth).all() and (one.color == other.color).all()
        assert np.array_equal(one.T_source_cam, other.T_source_cam)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_file_that_is_packed_as_a_whole_is_asked_to_be_unpacked(kind: str, tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "walk", kind, packed="file")
    (packed,) = folder.glob("*.zstd")
    for path in (folder, packed):
        with pytest.raises(SourceError, match="zstd -d"):
            open_source(path)
    zstd = pytest.importorskip("backports.zstd")
    packed.with_suffix("").write_bytes(zstd.decompress(packed.read_bytes()))
    packed.unlink()
    assert len(frames_of(folder)) == COUNT


def test_poses_of_odometry_are_carried_to_the_camera(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", "mcap", odometry=True)
    assert any("in odom" in note for note in open_source(path).info.notes)
    for frame, shot in zip(frames_of(path), shots(), strict=True):
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)


def test_frames_are_read_from_the_middle_and_thinned(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", "db3")
    source = open_source(path)
    assert [f.index for f in source.read(1, 3)] == [1, 2]
    thinned = open_source(path, SourceOptions(every=2))
    assert [f.index for f in thinned.read(0, 9)] == [0, 2]
    assert [k for k, _, _ in source.read_poses()] == list(range(COUNT))  # type: ignore[attr-defined]


def test_topics_are_chosen_by_name(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", "mcap")
    chosen = SourceOptions(topics=(("color", "/camera/color/image_raw"),))
    assert all(isinstance(f, Frame) for f in open_source(path, chosen).read(0, COUNT))
    with pytest.raises(OptionError, match=r"--topics color=/nothing: .* has /camera/color/camera_info"):
        open_source(path, SourceOptions(topics=(("color", "/nothing"),)))
    with pytest.raises(OptionError, match="the roles are color, depth, pose"):
        SourceOptions(topics=(("smell", "/a"),))


def test_topics_that_are_not_read_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "walk", "mcap")
    assert not [note for note in open_source(path).info.notes if note.startswith("not read")]
    messages = recordings._messages
    with monkeypatch.context() as patch:
        both = lambda put_, **how: [*messages(put_, **how), *messages(put_, registered=True, odometry=True)]  # noqa: E731
        patch.setattr(recordings, "_messages", both)
        (said,) = [n for n in open_source(write_bag(tmp_path / "both")).info.notes if n.startswith("not read")]
        assert said == "not read: /odom (Odometry)"
        (tmp_path / "both/plots").mkdir()
        assert len(frames_of(tmp_path / "both")) > 0
        blind = lambda put_, **how: [m for m in messages(put_, **how) if "Image" not in m[1]]  # noqa: E731
        patch.setattr(recordings, "_messages", blind)
        with pytest.raises(SourceError, match=r"no topic holds pictures .* it has .*/tf \(TFMessage\)"):
            open_source(write_bag(tmp_path / "blind"))


@pytest.mark.parametrize("kind", KINDS)
def test_listing_a_recording_tells_how_far_it_is(kind: str, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    path = write_bag(tmp_path / "walk", kind)
    source = open_source(path, listing=lambda done, total: told.append((done, total)))
    done, total = told[-1]
    assert source.info.frame_count == COUNT and done == total == 1 + 5 * COUNT


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_that_is_cut_off_is_one_clear_line(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix == f".{kind}")
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with pytest.raises(List3rError, match=r"`rosbag reindex`.*`mcap recover`") as caught:
        list(open_source(path).read(0, COUNT))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_folder_whose_metadata_was_never_written_is_read(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", kind)
    (path / "metadata.yaml").unlink()
    assert open_source(path).info.frame_count == len(frames_of(path)) == COUNT


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_no_place_to_cut_a_recording_breaks_its_reader(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", kind, chunk_bytes=20_000)
    file = file_of(path, kind)
    data = file.read_bytes()
    for length in np.random.default_rng(1).integers(1, len(data), 25).tolist():
        file.write_bytes(data[:length])
        try:
            assert 0 < len(list(open_source(path).read(0, COUNT))) <= COUNT
        except List3rError as error:
            assert "\n" not in str(error)


def file_of(path: Path, kind: str) -> Path:
    """The file of a recording that holds its messages."""
    return path if path.is_file() else next(path.glob(f"*.{kind}"))


def test_a_file_of_noise_is_one_clear_line(tmp_path: Path) -> None:
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"\x89" * 500)
        with pytest.raises(List3rError, match="ROS recording"):
            open_source(tmp_path / name)


def rvl(depth: np.ndarray) -> bytes:
    """Depth packed as Wilson 2017 describes it, a number at a time."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            nibbles.append((value & 7) | (8 if value > 7 else 0))
            value >>= 3
            if not value:
                return

    flat, at, last = depth.ravel().tolist(), 0, 0
    while at < len(flat):
        for known in (False, True):
            run = next((k for k in range(at, len(flat)) if bool(flat[k]) != known), len(flat)) - at
            put(run)
            for value in flat[at : at + run] if known else ():
                step = value - last
                put(2 * step if step >= 0 else -2 * step - 1)
                last = value
            at += run
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    height, width = depth.shape
    return struct.pack("<ii", width, height) + np.array(words, "<u4").tobytes()


FORMS = {
    "png": ("16UC1; png compressed ", "/camera/depth/image_raw/compressed", lambda z: recordings.png(z)),
    "png of an old driver": ("png", "/camera/depth/image_raw/compressed", lambda z: recordings.png(z)),
    "rvl": ("16UC1; compressedDepth rvl", "/camera/depth/image_raw/compressedDepth", lambda z: bytes(12) + rvl(z)),
}


def write_packed(root: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bag whose depth is packed in another form, with a hole in it."""
    said, topic, pack = FORMS[form]
    messages = recordings._messages

    def changed(put_, **how):
        for name, kind, time, message in messages(put_, **how):
            if "Depth" in name:
                z = cv2.imdecode(np.frombuffer(message.data.tobytes()[12:], np.uint8), cv2.IMREAD_UNCHANGED)
                z[:5, :7] = 0
                data = np.frombuffer(pack(z), np.uint8)
                message = put_.make(kind, header=message.header, format=said, data=data)
                name = topic
            yield name, kind, time, message

    monkeypatch.setattr(recordings, "_messages", changed)
    return write_bag(root, "bag", registered=True)


@pytest.mark.parametrize("form", FORMS)
def test_depth_topics_are_read_however_they_are_packed(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_packed(tmp_path / "walk", form, monkeypatch)
    asked = SourceOptions(topics=(("depth", FORMS[form][1]),))
    for options in (SourceOptions(), asked):
        source = open_source(path, options)
        frames = [f for f in source.read(0, COUNT) if isinstance(f, Frame)]
        assert len(frames) == COUNT
        for frame in frames:
            assert frame.depth is not None and not frame.depth[:5, :7].any()
            assert np.median(off_plane(world_points(frame, source.info.camera))) < 0.002


def test_a_topic_that_is_no_depth_or_pose_is_refused_where_it_is_asked_for(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk", "mcap")
    for role, topic, words in (
        ("depth", "/camera/color/image_raw", "rgb8 are no depth"),
        ("depth", "/camera/color/camera_info", "not a topic of pictures"),
        ("pose", "/camera/color/image_raw", "poses are of Odometry"),
    ):
        with pytest.raises(OptionError, match=words):
            open_source(path, SourceOptions(topics=((role, topic),)))

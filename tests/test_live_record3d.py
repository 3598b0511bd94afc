"""Record3D over USB: a phone behind a usbmuxd, as far as its protocol is known."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.frames.base import BadFrame, Frame
from list3r.frames.live.addresses import is_stream, without_secrets
from list3r.frames.live.feed import FeedState, LiveSettings
from list3r.frames.live.spooled import StreamFeed
from list3r.frames.live.stream import open_camera
from list3r.frames.live.usbmux import ADDRESS
from list3r.frames.source import open_source
from list3r.memory.core.errors import SourceError
from list3r.pipeline.live import build_live
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from tests.phone_server import FRONT, message, usbmuxd
from tests.recordings import COUNT, K, off_plane, shots
from tests.test_frames_recordings import world_points

pytest.importorskip("lzfse")
QUICK = LiveSettings(retry_s=0.6, pause_s=0.05, silence_s=1.0, poll_s=0.05)
NO_FRAME = struct.pack(">4I", 1, 101, 0, 200) + bytes(200)
ENDLESS = struct.pack(">4I", 1, 101, 0, 2**32 - 1)


def messages(**changes: object) -> list[bytes]:
    return [message(s.color, s.depth, s.T_world_cam, K, **changes) for s in shots()]  # type: ignore[arg-type]


def followed(folder: Path, told: list[str], source: str = "record3d:") -> FeedState:
    """What is there when the phone has ended."""
    feed = StreamFeed(open_camera(source, told.append), folder, QUICK, None, told.append)
    end = time.monotonic() + 30
    while not feed.state().ended and time.monotonic() < end:
        time.sleep(0.02)
    feed.admit()
    feed.close()
    return feed.state()


def test_depth_of_a_phone_through_every_pose_lies_on_the_wall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    half = np.full(shots()[0].depth.shape, 2, np.uint8)
    half[:, : half.shape[1] // 2] = 1
    told: list[str] = []
    with usbmuxd([messages(confidence=half)], monkeypatch, tmp_path):
        state = followed(tmp_path / "f", told)
    assert (state.count, state.received, state.cuts) == (COUNT, COUNT, ())
    assert "does not stream" in state.reason and "did not come back" in state.reason
    source = open_source(tmp_path / "f")
    info = source.info
    assert info.kind == "live" and info.has_depth and info.has_poses and info.poses_drift
    assert info.camera is not None and (info.camera.fx, info.camera.cx) == pytest.approx((K[0], K[2]))
    for frame, shot in zip(source.read(0, COUNT), shots(), strict=True):
        assert isinstance(frame, Frame) and frame.depth is not None
        off, width = off_plane(world_points(frame, info.camera)), frame.depth.shape[1]
        assert np.median(off) < 0.002 and np.quantile(off, 0.95) < 0.012
        assert np.allclose(frame.T_source_cam, shot.T_world_cam, atol=1e-5)
        assert (frame.depth[:, : width // 2 - 2] == 0).all() and (frame.depth[:, width // 2 + 3 :] > 0).mean() > 0.9


def test_a_phone_that_comes_back_begins_a_world_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, told = messages(), list[str]()
    with usbmuxd([whole[:2], [whole[2][:900]], whole[2:]], monkeypatch, tmp_path):
        state = followed(tmp_path / "f", told)
    assert (state.count, state.cuts, state.reconnects) == (COUNT, (2,), 2)
    frames = list(open_source(tmp_path / "f").read(0, COUNT))
    assert [f.T_source_cam is not None for f in frames if isinstance(f, Frame)] == [True] * 2 + [False] * (COUNT - 2)
    assert sum("another frame of reference" in line for line in told) == 1


def test_a_damaged_frame_is_bad_and_damage_between_frames_ends_a_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shot, whole, told = shots()[1], messages(), list[str]()
    damaged = message(shot.color, shot.depth, shot.T_world_cam, K, packed_depth=b"bvx2" + bytes(400))
    with usbmuxd([[whole[0], damaged, whole[2], NO_FRAME], [ENDLESS], [*whole[3:]]], monkeypatch, tmp_path):
        state = followed(tmp_path / "f", told)
    assert (state.count, state.cuts) == (COUNT, (3,))
    frames = list(open_source(tmp_path / "f").read(0, COUNT))
    assert [k for k, f in enumerate(frames) if isinstance(f, BadFrame)] == [1]
    assert any("not a frame of Record3D 1.10" in line for line in told)
    assert any("4294967295 bytes" in line for line in told)


def test_pictures_of_another_size_are_left_out_and_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, told, shot = messages(), list[str](), shots()[1]
    turned = message(np.rot90(shot.color), np.rot90(shot.depth), shot.T_world_cam, K)
    with usbmuxd([[whole[0], turned, turned, whole[2]]], monkeypatch, tmp_path):
        state = followed(tmp_path / "f", told)
    assert state.count == 2 and sum("160x120 are left out" in line for line in told) == 1


def test_poses_that_begin_at_the_first_picture_say_nothing_of_gravity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = np.linalg.inv(shots()[0].T_world_cam)
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    sent = [message(s.color, s.depth, y_up @ first @ s.T_world_cam, K) for s in shots()]
    with usbmuxd([sent], monkeypatch, tmp_path):
        followed(tmp_path / "f", [])
    info = open_source(tmp_path / "f").info
    assert info.has_poses and not info.z_up and any("which way is up" in note for note in info.notes)


@pytest.mark.parametrize(
    ("connections", "serials", "source", "said"),
    [
        ([messages(device=FRONT)], ("A",), "record3d:", "front camera"),
        ([], ("A",), "record3d:", "does not stream"),
        ([], (), "record3d:", "no iPhone is connected"),
        ([], ("A",), "record3d:B", "no iPhone B is connected"),
        ([], ("A", "B"), "record3d:", "name one: record3d:A, record3d:B"),
    ],
)
def test_what_keeps_a_phone_from_streaming_is_said(
    connections: list[list[bytes]],
    serials: tuple[str, ...],
    source: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with usbmuxd(connections, monkeypatch, tmp_path, serials=serials):
        with pytest.raises(SourceError, match=said):
            build_live(source, tmp_path / "m.l3r", live=QUICK)
    assert [p.name for p in tmp_path.iterdir()] == ["mux"]


@pytest.mark.parametrize("address", ["UNIX:none", "127.0.0.1:9", "nonsense"])
def test_a_missing_usbmuxd_is_said(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ADDRESS, address)
    with pytest.raises(SourceError, match="usbmuxd does not answer"):
        build_live("record3d:", tmp_path / "m.l3r", live=QUICK)


def test_a_phone_is_a_stream_and_its_serial_number_is_not_shown() -> None:
    assert is_stream("record3d:") and is_stream("record3d:00008101-AB")
    assert without_secrets("record3d:00008101-AB") == without_secrets("record3d:") == "record3d://usb"


@pytest.mark.slow
def test_a_walk_with_a_phone_becomes_a_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walk = WalkSettings(frames=24, size=(96, 72))
    _, poses = walk.poses()
    camera, renderer = walk.camera(), Renderer(walk.world(), walk.camera())
    drawn = [(renderer.render(T), T) for T in poses]
    own = camera.fx, camera.fy, camera.cx, camera.cy
    sent = [message(seen.color, seen.depth, T, own) for seen, T in drawn]
    told: list[str] = []
    watch, request = Watch(note=told.append), BuildRequest(chunk=8, overlap=3)
    with usbmuxd([sent[:14], sent[14:]], monkeypatch, tmp_path):
        run = RunOptions(live=True, workers=1)
        report = build_live("record3d:", tmp_path / "m.l3r", settings=request, run=run, live=QUICK, watch=watch)
    assert report.live is not None and (report.live.received, report.live.reconnects) == (24, 2)
    assert report.posed == 24 and report.live.gaps == 1
    with list3r.open(tmp_path / "m.l3r") as scene:
        session = scene.store.sessions.all()[0]
        assert session.source == "record3d://usb" and session.settings["poses"] == "prior"
        assert session.settings["up"] == "source"
        assert scene.store.facts.scale_kind == "metric" and len(scene) == report.instances > 0

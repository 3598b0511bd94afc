"""Live sources: a stream over the loopback and a folder that grows."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.frames.live.addresses import is_stream, without_secrets
from list3r.frames.live.feed import FeedState, LiveSettings
from list3r.frames.live.spooled import StreamFeed
from list3r.frames.live.stream import NetworkStream
from list3r.frames.source import open_source
from list3r.frames.writers.base import jpeg
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.pipeline.live import build_live, ready_spans
from list3r.pipeline.request import BuildRequest, RunOptions
from list3r.simulation.dataset import WalkSettings, write_walk

QUICK = LiveSettings(retry_s=1.0, pause_s=0.05, silence_s=1.0, idle_s=1.0, poll_s=0.05)


@contextmanager
def served(pictures: list[bytes], cut_after: int | None = None) -> Iterator[str]:
    """Serve pictures as motion JPEG; with `cut_after` the connection breaks after so many, and goes on when asked."""
    sent = iter(pictures)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for n, picture in enumerate(sent, start=1):
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                self.wfile.write(head.encode() + picture + b"\r\n")
                time.sleep(0.01)
                if n == cut_after:
                    return

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/camera"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def pictures(count: int) -> list[bytes]:
    return [jpeg(np.full((48, 64, 3), 8 * k % 250, np.uint8)) for k in range(count)]


def wait_for(feed: StreamFeed) -> FeedState:
    end = time.monotonic() + 30
    while not feed.state().ended and time.monotonic() < end:
        time.sleep(0.02)
    return feed.state()


def admitted(feed: StreamFeed) -> FeedState:
    wait_for(feed)
    assert feed.admit() and not feed.admit()
    feed.close()
    return feed.state()


def test_a_lost_connection_is_made_again_and_leaves_a_cut(tmp_path: Path) -> None:
    told: list[str] = []
    with served(pictures(24), cut_after=9) as address:
        feed = StreamFeed(NetworkStream(address), tmp_path / "f", QUICK, None, told.append)
        state = admitted(feed)
    assert state.ended and state.reconnects >= 2 and len(told) >= 2
    assert state.count == state.received and 15 <= state.count <= 24
    assert len(state.cuts) >= 1 and all(0 < c < state.count for c in state.cuts)
    source = open_source(tmp_path / "f")
    assert (source.info.kind, source.info.frame_count, source.info.camera) == ("live", state.count, None)
    times = [f.time_s for f in source.read(0, state.count)]
    assert all(a < b for a, b in pairwise(times))


def test_the_newest_wait_and_the_others_are_dropped_and_counted(tmp_path: Path) -> None:
    with served(pictures(30)) as address:
        settings = LiveSettings(most_waiting=10, retry_s=0.5, pause_s=0.05, silence_s=1.0)
        feed = StreamFeed(NetworkStream(address), tmp_path / "f", settings, None, lambda line: None)
        while feed.state().received < 5:
            time.sleep(0.005)
        assert feed.admit()
        first = feed.state().count
        state = wait_for(feed)
        assert (state.count, state.waiting) == (first, 10)
        state = admitted(feed)
    assert (state.count, state.waiting) == (first + 10, 0) and state.cuts == (first,)
    assert state.dropped == state.received - state.count > 0
    assert len(list((tmp_path / "f/rgb").iterdir())) == state.count
    newest = next(open_source(tmp_path / "f").read(state.count - 1, state.count))
    assert int(newest.color[0, 0, 0]) == pytest.approx(8 * 29 % 250, abs=3)  # type: ignore[union-attr]


def test_chunks_are_those_of_a_plan_once_all_is_there() -> None:
    settings, cuts = ChunkSettings(10, 3), (23, 41)
    whole = plan_chunks(60, settings, cuts)
    seen: list[object] = []
    for count in range(1, 61):
        spans = ready_spans(FeedState(count, tuple(c for c in cuts if c < count), False), settings)
        assert spans[: len(seen)] == seen
        ended = FeedState(count, tuple(c for c in cuts if c < count), True, waiting=60 - count)
        assert count == 60 or ready_spans(ended, settings) == spans  # what waits when it ends still comes
        seen = list(spans)
    assert ready_spans(FeedState(60, cuts, True), settings) == whole
    assert seen == whole[: len(seen)] and len(seen) >= len(whole) - 1


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("rtsp://me:secret@cam.local:554/a?token=1", "rtsp://cam.local:554/a"),
        ("http://cam/video", "http://cam/video"),
        ("/dev/video0", "/dev/video0"),
    ],
)
def test_secrets_of_an_address_are_not_shown(source: str, shown: str) -> None:
    assert is_stream(source) and without_secrets(source) == shown
    assert not is_stream("walk.mp4") and not is_stream("c:/walk")


@pytest.mark.slow
def test_a_folder_that_grows_becomes_a_memory_that_can_be_asked_meanwhile(tmp_path: Path) -> None:
    whole, growing, memory = (
        write_walk(tmp_path / "w", WalkSettings(frames=24, size=(96, 72))),
        tmp_path / "g",
        tmp_path / "m",
    )
    lists = {name: (whole / f"{name}.txt").read_text().splitlines()[1:] for name in ("rgb", "depth")}
    seen: list[int] = []

    def record() -> None:
        for k in range(24):
            for name, rows in lists.items():
                (growing / name).mkdir(exist_ok=True)
                shutil.copy(whole / rows[k].split()[1], growing / name)
                with (growing / f"{name}.txt").open("a") as out:
                    out.write(rows[k] + "\n")
            if k == 16:
                seen.append(_chunks_by(memory))

    growing.mkdir()
    for name in ("calibration.txt", "groundtruth.txt"):
        shutil.copy(whole / name, growing)
    writer = threading.Thread(target=record)
    writer.start()
    request = BuildRequest(poses="given", chunk=12, overlap=4)
    report = build_live(growing, memory, settings=request, run=RunOptions(live=True, workers=1), live=QUICK)
    writer.join()
    assert report.live is not None and (report.posed, report.live.dropped, report.chunks) == (24, 0, 3)
    assert seen == [1]
    with list3r.open(memory) as scene:
        assert len(scene) == report.instances


def _chunks_by(memory: Path) -> int:
    """Chunks that a reader sees, waited for as long as it takes to make one."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            with Store.open(memory) as store:
                if store.chunks.all():
                    return len(store.chunks.all())
        except (OSError, list3r.List3rError):
            pass
        time.sleep(0.1)
    return 0


@pytest.mark.parametrize("source", ["rtsp://me:secret@cam.local/a?token=secret", "record3d:secret", "/dev/video9"])
def test_what_has_no_frames_of_its_own_is_not_inspected(source: str) -> None:
    with pytest.raises(SourceError, match="list3r build") as error:
        open_source(source)
    assert "secret" not in str(error.value)


def test_what_is_no_live_source_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="is not a folder"):
        build_live(tmp_path / "none", tmp_path / "m.l3r", run=RunOptions(live=True))
    with pytest.raises(OptionError, match="cannot be resumed"):
        build_live(tmp_path, tmp_path / "m.l3r", run=RunOptions(live=True, resume=True))
    with pytest.raises(SourceError, match="no picture came"):
        build_live("http://127.0.0.1:9/none", tmp_path / "m.l3r", live=QUICK)
    assert not list(tmp_path.iterdir())

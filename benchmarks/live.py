"""A stream served from a file on the loopback, built while readers ask, with its connection cut again and again.

python benchmarks/live.py --seconds 600 --readers 8 --cuts 5 --json benchmarks/results/live.json

Pictures of a simulated walk are served as motion JPEG at 15 a second, forth and back; `list3r build URL` follows them
as structure from motion with a known camera. Each reader opens the memory, asks for the instances nearest to some point
and for all relations, and checks that every id in the answers is one of the memory's. At the end Ctrl-C ends the
session, and `verify` checks every row.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from machine import machine, write_json

import list3r
from list3r.frames.writers.base import jpeg
from list3r.memory.core.errors import List3rError
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import sense

RATE = 15.0


class Broadcast:
    """The pictures of a stream by the clock, and when its connection breaks."""

    def __init__(self, pictures: Sequence[bytes], seconds: float, cuts: int) -> None:
        self.pictures, self.seconds = pictures, seconds
        self.breaks_s = [seconds * (k + 1) / (cuts + 1) for k in range(cuts)]
        self.begun: float | None = None
        self.connections, self.sent = 0, 0

    def serve(self, handler: BaseHTTPRequestHandler) -> None:
        """Send pictures to one listener until the next break."""
        self.begun = self.begun or time.monotonic()
        self.connections += 1
        period = 2 * len(self.pictures) - 2
        while (now := time.monotonic() - self.begun) < self.seconds:
            if self.breaks_s and now > self.breaks_s[0]:
                self.breaks_s.pop(0)
                return
            at = int(now * RATE) % period
            picture = self.pictures[at if at < len(self.pictures) else period - at]
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
            handler.wfile.write(head.encode() + picture + b"\r\n")
            self.sent += 1
            time.sleep(max(0.0, (int(now * RATE) + 1) / RATE - (time.monotonic() - self.begun)))


class Reader(threading.Thread):
    """Asks a memory again and again."""

    def __init__(self, memory: Path, stop: threading.Event, pause_s: float) -> None:
        super().__init__(daemon=True)
        self._memory, self._stop_event, self._pause_s = memory, stop, pause_s
        self.seconds: list[float] = []
        self.most_instances = 0
        self.wrong: list[str] = []

    def run(self) -> None:
        """Ask until it is over."""
        while not self._stop_event.wait(self._pause_s):
            if self._memory.exists():
                self._ask()

    def _ask(self) -> None:
        started = time.monotonic()
        try:
            with list3r.open(self._memory) as scene, scene.store.snapshot():
                ids = {i.id for i in scene}
                asked = {m.instance.id for m in scene.nearest((0.0, 0.0, 0.0), k=5)} if ids else set()
                related = {n for r in scene.relations() for n in (r.subject, r.object)}
                if not (asked | related) <= ids | {i.id for i in scene.store.instances.all()}:
                    self.wrong.append("an answer names an id that is not in the memory")
        except List3rError as error:
            if "is being" not in str(error) and "no memory" not in str(error):
                self.wrong.append(str(error))
            return
        self.seconds.append(time.monotonic() - started)
        self.most_instances = max(self.most_instances, len(ids))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--readers", type=int, default=8)
    parser.add_argument("--cuts", type=int, default=5)
    parser.add_argument("--pictures", type=int, default=150)
    parser.add_argument("--pause", type=float, default=1.0, help="seconds between two questions of a reader")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    walk = WalkSettings(seed=1, frames=args.pictures, size=(240, 180))
    with tempfile.TemporaryDirectory() as scratch:
        broadcast = Broadcast(film(walk), args.seconds, args.cuts)
        result = run(broadcast, Path(scratch) / "live.l3r", walk, args.readers, args.pause)
    print(machine())
    print(json.dumps(result, indent=1))
    write_json(args.json, result)


def film(walk: WalkSettings) -> list[bytes]:
    """Pictures of the walk, as files."""
    times, poses = walk.poses()
    renderer = Renderer(walk.world(), walk.camera())
    drawn = (renderer.render(T) for T in poses)
    return [jpeg(sense(f, walk.sensor, walk.seed, k, float(times[k])).color) for k, f in enumerate(drawn)]


def run(broadcast: Broadcast, memory: Path, walk: WalkSettings, readers: int, pause_s: float) -> dict[str, Any]:
    """Serve, build, ask; end the build with Ctrl-C when the broadcast is over."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            with suppress(ConnectionError):  # whoever listens may leave
                broadcast.serve(self)

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    c = walk.camera()
    command = [sys.executable, "-m", "list3r", "build", f"http://127.0.0.1:{server.server_port}/", "-m", str(memory)]
    command += ["--intrinsics", f"{c.fx},{c.fy},{c.cx},{c.cy}", "--distortion", "0,0,0,0,0", "--preset", "cpu"]
    command += ["--fps", "5", "--chunk", "20", "--overlap", "6", "--depth-every", "2", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    stop = threading.Event()
    asking = [Reader(memory, stop, pause_s) for _ in range(readers)]
    for reader in asking:
        reader.start()
    while broadcast.begun is None or time.monotonic() - broadcast.begun < broadcast.seconds:
        time.sleep(0.2)
    interrupted = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    out = process.communicate()[0]
    ended_s = time.monotonic() - interrupted
    stop.set()
    for reader in asking:
        reader.join()
    server.shutdown()
    checked = subprocess.run(
        [sys.executable, "-m", "list3r", "verify", str(memory)], capture_output=True, text=True, check=False
    )
    answer = json.loads(out) if process.returncode == 0 else {"matches": [{"live": None}], "notes": []}
    report = answer["matches"][0]
    answers = [s for r in asking for s in r.seconds]
    return {
        "seconds": broadcast.seconds,
        "sent": broadcast.sent,
        "connections": broadcast.connections,
        "status": process.returncode,
        "from_ctrl_c_to_end_s": round(ended_s, 1),
        "live": report["live"],
        "frames": {k: report.get(k) for k in ("frames", "posed", "chunks", "components", "instances", "relations")},
        "notes": answer["notes"],
        "readers": readers,
        "answers": len(answers),
        "answer_s": round(statistics.median(answers), 3) if answers else None,
        "most_instances_seen": max((r.most_instances for r in asking), default=0),
        "wrong": sorted({w for r in asking for w in r.wrong}),
        "verify": checked.returncode,
    }


if __name__ == "__main__":
    main()

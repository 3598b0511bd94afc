"""The viewer on millions of points or a memory: frames while the camera is turned, search, a click, errors of the page.

PYTHONPATH=. python benchmarks/viewer.py --points 5000000 --json FILE --picture FILE
PYTHONPATH=. python benchmarks/viewer.py --memory house.l3r

The memory is synthetic (`exporters.py`) unless one is given. The page is Chromium without a screen and without a
graphics card: its software renderer draws, so a frame is also given in processor seconds of all its processes.
"""

from __future__ import annotations

import argparse
import itertools
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from machine import descendants, write_json
from PIL import Image

import exporters
import list3r

if TYPE_CHECKING:
    from list3r.viewer.app import Viewer
    from list3r.viewer.clouds import PageClouds
    from tests.browser import Browser

TURNED_S = 20.0
COUNT_FRAMES = """
const clear = WebGL2RenderingContext.prototype.clear;
WebGL2RenderingContext.prototype.clear = function(...words) { window.drew = true; return clear.apply(this, words) };
(function next(at) { if (window.drew) window.drawn.push(at); window.drew = false; requestAnimationFrame(next) })(0)
"""
"""Notes the times of the frames in which the scene was drawn."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--objects", type=int, default=2_000)
    parser.add_argument("--memory", type=Path, help="a memory to show, instead of one with so many points")
    parser.add_argument("--words", default="Stuhl", help="what is searched")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--picture", type=Path, help="file for a picture of the page")
    args = parser.parse_args()
    from list3r.viewer.app import Viewer, ViewerSettings
    from tests.browser import Browser

    exporters.POINTS = args.points // args.objects
    with tempfile.TemporaryDirectory() as folder:
        path = args.memory or Path(folder) / "made.l3r"
        if args.memory is None:
            exporters.write_memory(path, args.objects)
        report: dict[str, Any] = {"file_mb": round(path.stat().st_size / 1e6, 1)}
        with list3r.open(path) as memory:
            began = time.process_time()
            viewer = Viewer(memory, ViewerSettings(0))
            report["start_cpu_s"] = round(time.process_time() - began, 1)
            sheets = viewer.world.sheets.values()
            report |= {"instances": len(viewer.world.instances), "points": int(viewer.world.cloud.counts.sum())}
            report |= {"triangles": sum(len(s.faces) for s in sheets)}
            report["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            page = Browser(Path(folder) / "profile")
            try:
                report |= measure(page, viewer, args)
            finally:
                page.close()
                viewer.stop()
    print(report)
    write_json(args.json, report)


def measure(page: Browser, viewer: Viewer, args: argparse.Namespace) -> dict[str, Any]:
    """Time of the page to load, to turn and to search."""
    began = time.monotonic()
    page.open(viewer.address)
    page.wait(lambda: "Click a thing in the list" in page.text(), 300)
    page.wait(viewer.server.get_clients, 300)
    loaded = time.monotonic() - began
    page.wait(lambda: [p for p in viewer._pages.values() if p.at_rest], 300)
    (points,) = viewer._pages.values()
    report = {"load_s": round(loaded, 1), "shown_s": round(time.monotonic() - began, 1)}
    report |= {"page_draws_points_a_s": round(1 / (points.seconds_a_point or 1e-9)), "at_rest": drawn(points, "/fine/")}
    report |= {"all_triangles_ms": round(1000 * points.seconds_of_sheets), "slow": points.slow}
    page.run(f"window.drawn = []; {COUNT_FRAMES}")
    report |= {"moving": drawn(points, "/coarse/"), **turn(page)}
    print(report, flush=True)
    time.sleep(5.0)
    began = time.monotonic()
    page.fill("Find", args.words)
    page.press("Search")
    page.wait(lambda: viewer.state.selected is not None, 300)
    report["search_s"] = round(time.monotonic() - began, 2)
    time.sleep(5.0)
    if args.picture is not None:
        Image.fromarray(page.picture()).save(args.picture)
    return {**report, "console_errors": page.errors}


def drawn(points: PageClouds, level: str) -> int:
    """How many points one level of the page has."""
    return sum(len(n.points) for name, n in points._nodes.items() if name.startswith(level) and hasattr(n, "points"))


def turn(page: Browser) -> dict[str, float]:
    """Turn the camera with the mouse; frames a second, the longest wait for one and the cost of a frame."""
    page.run("window.drawn = []")
    used, began, step = cpu_seconds(page), time.monotonic(), 0
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=400, y=400, button="left", clickCount=1)
    while time.monotonic() - began < TURNED_S or (page.run("window.drawn.length") < 5 and step < 1000):
        step += 1
        place = {"x": 400 + 5 * (step % 40), "y": 400}
        page.call("Input.dispatchMouseEvent", type="mouseMoved", **place, button="left", buttons=1)
        time.sleep(0.05)
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=400, y=400, button="left", clickCount=1)
    drawn, lasted, spent = page.run("window.drawn"), time.monotonic() - began, cpu_seconds(page) - used
    gaps = sorted(b - a for a, b in itertools.pairwise(at for at in drawn if at))
    return {
        "frames_per_s": round(len(gaps) / lasted, 2),
        "median_frame_ms": round(gaps[len(gaps) // 2]),
        "longest_frame_ms": round(gaps[-1]),
        "cpu_s_a_frame": round(spent / len(gaps), 3),
        "cores_used": round(spent / lasted, 2),
        "load_average": round(os.getloadavg()[0], 1),
    }


def cpu_seconds(page: Browser) -> float:
    """Processor seconds of all processes of the browser."""
    ticks = 0
    for pid in [page._program.pid, *descendants(page._program.pid)]:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

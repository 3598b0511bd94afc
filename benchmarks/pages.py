"""report.html of a large memory in a browser: time until it can be searched, and of a search.

PYTHONPATH=. python benchmarks/pages.py --instances 1000,100000 --json benchmarks/results/pages.json

The memories are synthetic (`exporters.py`). The page is opened from disk in Chromium without a screen; times are wall
seconds on the machine as it is, and processor seconds of all of the browser's processes.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from machine import machine, write_json
from PIL import Image
from viewer import cpu_seconds

import exporters
import list3r

if TYPE_CHECKING:
    from tests.browser import Browser

ROWS = "document.querySelectorAll('#list tbody tr').length"
SEARCH = """(() => { const began = performance.now(); search.value = %r; search.dispatchEvent(new Event('input'));
document.body.offsetHeight; return performance.now() - began })()"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", default="1000,100000")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--picture", type=Path, help="file for a picture of the last page")
    args = parser.parse_args()
    from tests.browser import Browser

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        page = Browser(Path(folder) / "profile")
        try:
            for count in (int(n) for n in args.instances.split(",")):
                memory, report = Path(folder) / f"made-{count}.l3r", Path(folder) / f"{count}.html"
                exporters.write_memory(memory, count)
                with list3r.open(memory) as scene:
                    scene.export("report", report)
                rows.append({"instances": count, "mb": round(report.stat().st_size / 1e6, 1), **measure(page, report)})
                print(rows[-1], flush=True)
            if args.picture is not None:
                Image.fromarray(page.picture()).save(args.picture)
        finally:
            page.close()
    print(machine())
    write_json(args.json, {"rows": rows})


def measure(page: Browser, report: Path) -> dict[str, Any]:
    """Seconds until the page lists instances, seconds of a search, and the page's memory."""
    used, began = cpu_seconds(page), time.monotonic()
    page.open(report.as_uri())
    page.wait(lambda: page.run(f"document.readyState === 'complete' && {ROWS} > 0"), 300)
    row: dict[str, Any] = {
        "open_s": round(time.monotonic() - began, 2),
        "open_cpu_s": round(cpu_seconds(page) - used, 2),
    }
    row["heap_mb"] = round(page.run("performance.memory.usedJSHeapSize") / 1e6)
    row["search_ms"] = {word: round(page.run(SEARCH % word)) for word in ("zzz", "#77", "stuhl", "plant on table", "")}
    page.run(SEARCH % "stuhl")
    row["found"] = page.run("document.getElementById('count').textContent")
    return {**row, "load_average": round(os.getloadavg()[0], 1), "console_errors": page.errors}


if __name__ == "__main__":
    main()

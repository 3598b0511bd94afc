"""Draw how a catalogue in PostgreSQL grows, from the result of benchmarks/catalog.py.

python scripts/catalog_growth.py
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

ROOT = Path(__file__).resolve().parents[1]
RESULT, PICTURE = ROOT / "benchmarks/results/catalog.json", ROOT / "docs/images/catalog-growth.png"
LINES = {
    "put of 1000": "a memory of 1,000 goes in",
    "similar, all": "similar, over all memories",
    "find, frequent word, all": "find, a frequent word, over all",
    "find, one word, all": "find, one word, over all",
    "nearest, one memory": "nearest, in one memory",
}


def main() -> None:
    """Draw the picture."""
    stages = json.loads(RESULT.read_text(encoding="utf-8"))["stages"]
    counts = [s["instances"] for s in stages]
    figure, axes = pyplot.subplots(figsize=(7.2, 4.2), dpi=110)
    for name, told in LINES.items():
        spent = [s[name]["client_cpu_ms"] + s[name]["server_cpu_ms"] for s in stages]
        axes.loglog(counts, spent, marker="o", label=told)
    axes.set(xlabel="instances in the catalogue", ylabel="processor time of client and server, ms")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(PICTURE, metadata={"Software": None})


if __name__ == "__main__":
    main()

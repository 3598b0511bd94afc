"""Print the tables of README.md from the committed results, or check that README.md shows them.

    python scripts/readme_tables.py            # write the tables between their marks in README.md
    python scripts/readme_tables.py --check    # exit status 1 where README.md differs

Each table is read from JSON files under benchmarks/results, which the command named below the table in README.md wrote.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PRESETS = ("calm", "loop", "kidnap", "dynamic", "twins", "sparse", "corridor")
PAPER_ATE_M = {"baseline": 0.964, "ilrd": 0.708, "iasm": 0.706, "cwgo": 0.277}
"""LIST3R's ablation on fr2_360_kidnap (Gao et al. 2026), metres."""


def _read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def kitchen() -> str:
    """Return the table of the red kitchen: colour and depth, and four ways of giving its colour alone."""
    depth, colour = _read("redkitchen"), [_read(f"sfm{kind}") for kind in ("", "-free-focal", "-mp4", "-phone")]
    runs = [r["list3r"] for r in colour]
    plain = [r.get("pycolmap") for r in colour]
    ways = ("colour, focal length given", "colour, nothing given", "as mp4", "as a phone's clip")
    return _table(
        ["7-Scenes red kitchen, 1,000 frames", "colour and depth", *ways],
        [
            ["frames with a pose", f"{depth['posed']:,}", *(f"{r['posed']:,}" for r in runs)],
            ["ATE RMSE after Sim(3), m", f"{depth['ate_sim3_m']:.3f}", *(f"{r['ate_sim3_m']:.3f}" for r in runs)],
            ["ATE RMSE after SE(3), m", f"{depth['ate_se3_m']:.3f}", *("" for _ in runs)],
            ["plain pycolmap, every 8th frame, same run", ""]
            + ["" if p is None else f"{p['ate_sim3_m']:.3f}" for p in plain],
            ["whole program, frames/s", f"{depth['frames_per_second']:.1f}"]
            + [f"{r['frames_per_s']:.1f}" for r in runs],
            ["peak memory, GB", f"{depth['peak_mb'] / 1000:.1f}", *(f"{r['peak_mb'] / 1000:.1f}" for r in runs)],
            ["instances listed", str(depth["instances"]), *(str(r["instances"]) for r in runs)],
        ],
    )


def walks() -> str:
    """Return the table of simulated walks, with a sensor's depth and by colour alone."""
    depth, colour = _read("simulated")["mean"], _read("colour")["mean"]

    def both(name: str, key: str) -> list[str]:
        return [name, *(f"{m[f'{key}_recall']:.2f}, {m[f'{key}_precision']:.2f}" for m in (depth, colour))]

    def boxes(m: dict[str, float], iou: str, kind: str = "") -> str:
        return f"{m[f'{kind}recall_{iou}']:.2f}, {m[f'{kind}precision_{iou}']:.2f}"

    return _table(
        ["recall, precision; means over walks", "colour and depth, 6 walks", "colour alone, 3 walks"],
        [
            ["instances at box IoU 0.25", boxes(depth, "0.25"), boxes(colour, "0.25", "box_")],
            ["instances at box IoU 0.50", boxes(depth, "0.50"), boxes(colour, "0.50", "box_")],
            ["instances at mask IoU 0.25", "", boxes(colour, "0.25", "mask_")],
            both("`on`", "on"),
            both("`next_to`", "next_to"),
            both("`in`", "in"),
            ["camera (ATE RMSE), m", f"{depth['ate_se3_m']:.3f}", f"{colour['ate_sim3_m']:.3f}"],
        ],
    )


def discovery() -> str:
    """Return the table of discovery: rules, the learned one and true masks on worlds left out and in a house; and what
    is lost where the networks see less.
    """
    methods = {"geometric": "rules (default)", "learned": "`--discovery learned`", "true": "true masks"}
    places = {
        "discovery": "10 left-out worlds",
        "discovery-fitted": "6 left-out rooms with what is built in",
        "discovery-house": "a house",
        "discovery-ablation": "the 10 worlds, networks trained on 40 rooms",
    }
    keys = {"boxes at IoU 0.25": ("", "0.25"), "at 0.5": ("", "0.5"), "masks at 0.25": ("mask_", "0.25")}
    keys["masks at 0.5"] = ("mask_", "0.5")
    rows = []
    for name, place in places.items():
        for method, entry in _read(name)["mean"].items():
            cells = [
                f"{entry[f'{kind}recall_{iou}']:.2f}, {entry[f'{kind}precision_{iou}']:.2f}"
                for kind, iou in keys.values()
            ]
            rows.append([f"{place}: {methods.get(method, method)}", *cells])
    return _table(["recall, precision of one chunk", *keys], rows)


def association() -> str:
    """Return the table of the variants of association: mean and worst of eight seeds."""
    runs = _read("association")["runs"]
    names = {
        "baseline": "baseline: edges by confidence, every frame similarity above 0.85 a loop, no cut detection",
        "ilrd": "+ cut detection, verified loops (ILRD)",
        "iasm": "+ instance-aware support (IASM)",
        "cwgo": "+ graph with covariances, and nodes within chunks (full)",
    }
    rows = []
    for variant, name in names.items():
        errors = [[r["ate_sim3_m"] for r in runs if (r["preset"], r["variant"]) == (p, variant)] for p in PRESETS]
        cells = [f"{statistics.mean(e):.3f} ({statistics.median(e):.3f}, {max(e):.3f})" for e in errors]
        rows.append([name, *cells, f"*{PAPER_ATE_M[variant]}*"])
    return _table(["ATE, m: mean (median, worst)", *PRESETS, "*paper*"], rows)


def changes() -> str:
    """Return the table of second sessions."""
    total = _read("sessions")["total seeds 311 to 320"]
    cells = [f"{total[kind]['f1']:.2f}" for kind in ("moved", "removed", "added", "all")]
    return _table(
        ["ten homes that nothing was tuned on", "moved", "removed", "added", "all"], [["F1 of change records", *cells]]
    )


def relations() -> str:
    """Return the table of relations where the masks are told."""
    pooled = _read("relations")["pooled"]
    names = {
        "on": "`on`",
        "in": "`in`",
        "next_to": "`next_to`",
        "attached_to": "`attached_to`",
        "viewpoint": "left, right, front, behind",
        "between": "`between`",
    }
    cells = [f"{pooled[key]['precision']:.2f}, {pooled[key]['recall']:.2f}" for key in names]
    return _table(["relations with true masks", *names.values()], [["precision, recall", *cells]])


TABLES: dict[str, Callable[[], str]] = {
    "kitchen": kitchen,
    "walks": walks,
    "discovery": discovery,
    "association": association,
    "changes": changes,
    "relations": relations,
}


def filled(text: str) -> str:
    """Return README's text with every marked table written anew. Raises `SystemExit` for a mark without a table."""

    def fill(mark: re.Match[str]) -> str:
        name = mark.group(1)
        if name not in TABLES:
            raise SystemExit(f"README.md asks for the table {name}; there are {', '.join(TABLES)}")
        return f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end of table -->"

    return re.sub(r"<!-- table (\w+) -->\n.*?<!-- end of table -->", fill, text, flags=re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 where README.md differs")
    check = parser.parse_args().check
    readme = ROOT / "README.md"
    before = readme.read_text(encoding="utf-8")
    after = filled(before)
    if check and before != after:
        print("README.md shows other figures than benchmarks/results: run scripts/readme_tables.py", file=sys.stderr)
        raise SystemExit(1)
    if not check:
        readme.write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()

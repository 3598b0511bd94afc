"""Tables that hold the store, questions and the derivation of today against those of b097ed9."""

from __future__ import annotations

from typing import Any

from tables.results import read, table

_WALKS = {
    "walk": "a walk through rooms",
    "stay": "a stay in one room",
    "sessions": "20 sessions of 15 chunks in one place",
    "corridor": "a corridor",
}


def derivation() -> str:
    """Return what deriving the library costs, before and now."""
    now, before = read("derivation")["walks"], read("derivation-before")["walks"]
    rows = []
    for name, words in _WALKS.items():
        a, b = before[name], now[name]
        at_the_end_alone = "derived" in b
        rows.append(
            [
                f"{words}, {b['chunks']:,} chunks",
                *(_seconds(a[k], b[k], left_out=at_the_end_alone) for k in ("chunk_s", "longest_s")),
                *(_seconds(a[k], b[k]) for k in ("end_s", "edit_s")),
                f"{a['peak_mb']:.0f}, {b['peak_mb']:.0f}",
                f"{b['alike']:,} of {b['listed_before']:,}",
            ]
        )
    head = ["before, now", "a chunk, s", "longest call, s", "end, s", "an edit, s", "peak, MB", "instances alike"]
    return table(head, rows)


def _seconds(before: float, now: float, *, left_out: bool = False) -> str:
    return f"{before:.3g}, {'not measured' if left_out else format(now, '.3g')}"


_ASKED = {
    "nearest": "nearest",
    "within_1m": "within 1 m",
    "find_label": "find, a label",
    "find_words": "find, words",
    "find_relation": "find, a relation",
    "find_nothing": "find, an unknown word",
    "similar": "similar",
    "nearest_cold_first": "open + first nearest",
}
"""What `scale.py` asks, by the name of its figures."""
_BUILD = "build of 200 frames"


def questions() -> str:
    """Return the processor time of questions, before and now, by the size of the memory."""
    before, now = ({s["instances"]: s for s in read(name)["sizes"]} for name in ("scale-small-before", "scale-small"))
    head = ["median processor time, ms: before, now", *(f"{n:,} instances" for n in now)]
    rows = [[words, *(_pair(before[n], now[n], f"{key}_cpu_p50_ms") for n in now)] for key, words in _ASKED.items()]
    return table(head, rows)


def _pair(before: Any, now: Any, key: str) -> str:
    return f"{before[key]:.3g}, {now[key]:.3g}"


def traces() -> str:
    """Return what a question and a build pass through, before and now."""
    before, now = read("trace-before"), read("trace")
    rows = []
    for words, key in (("`find`", "find"), ("open + `find`", "open + find"), (_BUILD, _BUILD)):
        both = [of[key] for of in (before, now) if key in of]
        counts = [", ".join(f"{of[k]:,}" for of in both) for k in ("files", "functions", "calls")]
        rows.append([words, *counts, ", ".join(f"{100 * of['share_that_checks_integrity']:.0f} %" for of in both)])
    spent = [f"{before['processor_ms'][k]:.1f}, {now['processor_ms'][k]:.1f} ms" for k in now["processor_ms"]]
    rows = [[*row, "" if row[0] != "open + `find`" else spent[0]] for row in rows]
    rows.insert(2, ["open + `nearest`", "", "", "", "", spent[1]])
    return table(["before, now", "files", "functions", "calls", "of all calls check integrity", "processor time"], rows)

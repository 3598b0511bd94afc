"""Tables that hold the store and the derivation of today against those of b097ed9."""

from __future__ import annotations

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

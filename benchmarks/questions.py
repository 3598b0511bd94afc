"""Ask a memory what people would ask, and compare with the right answers.

    python benchmarks/questions.py                                     # the room of 67 named things
    python benchmarks/questions.py --memory demo=demo/rooms.l3r        # and the memory of `list3r demo`
    python benchmarks/questions.py --unseen                            # questions that nobody looked at meanwhile
    python benchmarks/questions.py --wrong                             # prints each question that went wrong
    list3r build .../redkitchen -m kitchen.l3r --frames 0:300 --detector nanodet-m-416.param
    PYTHONPATH=. python benchmarks/discovery_memory.py --seeds 5101-5102 --frames 150 --keep FOLDER
    PYTHONPATH=. python benchmarks/phone.py --only portrait --detector nanodet-m-416.param --keep FOLDER
    python benchmarks/questions.py --memory kitchen=kitchen.l3r --memory colour=FOLDER/portrait.l3r \\
        --memory world_5101=FOLDER/world-5101-150/learned.l3r --memory world_5102=FOLDER/world-5102-150/learned.l3r

A question is right where the first answer is one of those that a person would point at, where the count or yes or no
is right, or, where there is nothing to point at, where no answer claims to be exact. It is confidently wrong where the
first answer is wrong with a score above 0.9, or a count or a yes or no is given and wrong. A thing of a memory is
known by the nearest place within `near` metres (0.25 where a table has none); places are those of the true things of
the simulated walks and of what the kitchen's pictures show, so a thing that was not found or not named counts as wrong.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import list3r
from list3r.importers.base import box_surface
from list3r.importers.importing import import_map
from list3r.memory.core.errors import List3rError
from list3r.memory.core.geometry import OrientedBox

Array = NDArray[np.float64]
SETS = Path(__file__).parent / "question_sets"
CONFIDENT = 0.9


@dataclass(frozen=True)
class Asked:
    """A question with its answer."""

    question: str
    answer: str
    """Keys of things that may come first; =N for a count; yes, no; none where nothing fits."""
    place: str | None
    """Viewpoint x,y,z."""


@dataclass(frozen=True)
class Judged:
    """What a memory answered."""

    question: str
    wanted: str
    said: str
    score: float | None
    verdict: str
    """right, wrong, confident (wrong and sure of it), error."""
    seconds: float


def read_table(name: str) -> list[dict[str, str]]:
    """Return the rows of a table of tab-separated values."""
    with (SETS / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))


def asked_of(name: str) -> list[Asked]:
    """Return the questions of a table."""
    return [Asked(r["question"], r["answer"], r["from"] or None) for r in read_table(name)]


def make_room(folder: Path) -> tuple[Path, dict[int, str]]:
    """Write the room as a map of HOV-SG and import it; the memory, and the key of each id."""
    objects = folder / "map/objects"
    objects.mkdir(parents=True)
    rows = read_table("room.tsv")
    for n, row in enumerate(rows):
        x, y, bottom, *size = (float(row[k]) for k in ("x", "y", "bottom", "width", "depth", "height"))
        center = np.array([x, y, bottom + size[2] / 2])
        legs = row["name"].endswith(("table", "desk"))
        points = np.concatenate([box_surface(b) for b in (_table if legs else _solid)(center, np.array(size))])
        vertex = np.zeros(len(points), [*((c, "<f4") for c in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
        for k, c in enumerate("xyz"):
            vertex[c] = points[:, k]
        for c, value in zip(("red", "green", "blue"), row["rgb"].split(","), strict=True):
            vertex[c] = int(value)
        kinds = "".join(f"property {'float' if c in 'xyz' else 'uchar'} {c}\n" for c in vertex.dtype.names or ())
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{kinds}end_header\n"
        (objects / f"0_0_{n}.ply").write_bytes(head.encode() + vertex.tobytes())
        said = {"object_id": f"0_0_{n}", "name": row["name"], "embedding": []}
        (objects / f"0_0_{n}.json").write_text(json.dumps(said))
    report = import_map(folder / "map", folder / "room.l3r")
    return folder / "room.l3r", {report.ids[f"0_0_{n}"]: row["key"] for n, row in enumerate(rows)}


def _solid(center: Array, size: Array) -> list[OrientedBox]:
    return [OrientedBox(center, size, np.eye(3))]


def _table(center: Array, size: Array, leg_m: float = 0.05) -> list[OrientedBox]:
    """Return a top and four legs: other things stand under it."""
    top = OrientedBox(center + np.array([0, 0, (size[2] - leg_m) / 2]), np.array([size[0], size[1], leg_m]), np.eye(3))
    corners = [np.array([i, j, 0]) * (size - leg_m) / 2 for i in (-1, 1) for j in (-1, 1)]
    return [top, *(OrientedBox(center + c, np.array([leg_m, leg_m, size[2]]), np.eye(3)) for c in corners)]


def judge(memory: Any, asked: Asked, keys: dict[int, str]) -> Judged:
    """Ask one question."""
    start = time.perf_counter()
    try:
        found = memory.find(asked.question, 10, viewpoint=asked.place)
    except List3rError as error:
        return Judged(asked.question, asked.answer, str(error), None, "error", time.perf_counter() - start)
    seconds = time.perf_counter() - start
    first = found[0] if found else None
    exact = getattr(found, "exact", True)
    count, answer = getattr(found, "counted", None), getattr(found, "answer", None)
    name = "nothing" if first is None else keys.get(first.instance.id, f"#{first.instance.id}")
    wanted = asked.answer
    sure = first is not None and first.score > CONFIDENT
    if wanted.startswith("="):
        said, right, sure = str(count), count == int(wanted[1:]), count is not None
    elif wanted in ("yes", "no"):
        said, right, sure = str(answer), answer == wanted, answer is not None
    elif wanted == "none":
        said, right = f"{name}{'' if exact else ' (not exact)'}", first is None or not exact
    else:
        said, right = name, name in wanted.split()
    verdict = "right" if right else "confident" if sure else "wrong"
    return Judged(asked.question, wanted, said, None if first is None else first.score, verdict, seconds)


def keys_at(path: Path, name: str, near_m: float = 0.25) -> dict[int, str]:
    """Return the key of each thing whose centre is at one of a table of places: ids are others in each build."""
    rows = read_table(name)
    places = np.array([[float(r[k]) for k in "xyz"] for r in rows])
    near = np.array([float(r.get("near") or near_m) for r in rows])
    with list3r.open(path) as memory:
        off = {i.id: np.linalg.norm(places - i.center, axis=1) for i in memory}
    found = {n: np.where(d <= near, d, np.inf) for n, d in off.items()}
    return {n: rows[int(d.argmin())]["key"] for n, d in found.items() if np.isfinite(d.min())}


def judged(path: Path, name: str, keys: dict[int, str]) -> list[Judged]:
    """Ask the questions of a table."""
    with list3r.open(path) as memory:
        return [judge(memory, a, keys) for a in asked_of(name)]


def summary(rows: list[Judged]) -> dict[str, Any]:
    """Return the counts, and the shares in per cent."""
    counts = Counter(r.verdict for r in rows)
    n = len(rows)
    return {
        "questions": n,
        "right": counts["right"],
        "errors": counts["error"],
        "confident_wrong": counts["confident"],
        "right_percent": round(100 * counts["right"] / n, 1),
        "confident_wrong_percent": round(100 * counts["confident"] / n, 1),
        "median_ms": round(1e3 * float(np.median([r.seconds for r in rows])), 2),
    }


def main() -> None:
    """Ask, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    named = "a set of question_sets and its memory, say demo=demo/rooms.l3r"
    parser.add_argument("--memory", action="append", default=[], metavar="SET=MEMORY", help=named)
    parser.add_argument("--unseen", action="store_true", help="ask the questions that were kept aside")
    parser.add_argument("--wrong", action="store_true", help="print what went wrong")
    parser.add_argument("--json", type=Path, help="write the results here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path, keys = make_room(Path(folder))
        sets = {"room": judged(path, "room_unseen.tsv" if options.unseen else "room_questions.tsv", keys)}
    for name, file in (entry.split("=", 1) for entry in options.memory):
        sets[name] = judged(Path(file), f"{name}_questions.tsv", keys_at(Path(file), f"{name}.tsv"))
    for name, rows in sets.items():
        print(name, summary(rows))
        for r in rows:
            if options.wrong and r.verdict != "right":
                print(f"  {r.verdict}: {r.question!r}: {r.said} ({r.score}), not {r.wanted}")
    if options.json is not None:
        wrong = {n: [asdict(r) for r in rows if r.verdict != "right"] for n, rows in sets.items()}
        content = {n: {**summary(rows), "wrong": wrong[n]} for n, rows in sets.items()}
        options.json.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

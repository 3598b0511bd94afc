"""Share of questions that scene.md answers like the memory, by budget of tokens and size of the memory.

    python benchmarks/prompt_pack.py [MEMORY ...] [--objects 10 100 1000 5000] [--questions 200] [--out FILE.json]

A plain program reads only the text. Questions: the nearest instance, the support, the count of a name, distance and
direction between two instances. `general` is one text for all questions; `asked` is a text made for each question (of
every tenth of them), whose ids it names.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import write_json

import list3r
from list3r.api import SceneMemory
from list3r.exporters.prompt.scene_text import SUPPORTING, name_of
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import Instance, Relation
from list3r.memory.store.store import Store

BUDGETS = (300, 1000, 4000)
KINDS = ("nearest", "held", "count", "far", "direction")
_NAMES = [
    f"{color} {shape}" for color in ("red", "blue", "white", "tan") for shape in ("mug", "box", "chair", "lamp", "book")
]
_ROW = re.compile(r"^(\d+) ([^|]+?)\??(?: \| (\S+,\S+,\S+) \| (\S+))?((?: \| [^|]+)*)$")


@dataclass(frozen=True)
class Question:
    """One question with the memory's own answer."""

    kind: str
    text: str
    of: tuple[Any, ...]
    answer: Any


# ---------------------------------------------------------------------------------------------- the memory


def questions(memory: SceneMemory, count: int) -> Iterator[Question]:
    """Questions with their answers, of all kinds in turn."""
    rng = np.random.default_rng(0)
    objects = memory.instances()
    held = [(r.subject, r.object) for p in SUPPORTING for r in memory.relations(predicate=p)]
    names = Counter(name_of(i) for i in memory.instances(structure=None))
    for n in range(count):
        a, b = (objects[k] for k in rng.choice(len(objects), 2, replace=False))
        kind = KINDS[n % len(KINDS)]
        if kind == "nearest":
            near = memory.nearest(a.id, k=2)
            ties = {m.instance.id for m in near if abs(m.distance_m - near[0].distance_m) < 0.02}
            yield Question(kind, f"what is nearest to #{a.id}?", (a.id,), ties)
        elif kind == "held" and held:
            subject = held[int(rng.integers(len(held)))][0]
            objects = {o for s, o in held if s == subject}
            yield Question(kind, f"what is #{subject} on?", (subject,), objects)
        elif kind == "count":
            yield Question(kind, f"how many {name_of(a)} are there?", (name_of(a),), names[name_of(a)])
        elif kind == "far":
            away = float(np.linalg.norm(a.center - b.center))
            yield Question(kind, f"how far is #{a.id} from #{b.id}?", (a.id, b.id), away)
        elif kind == "direction":
            step = b.center - a.center
            axis = int(np.argmax(np.abs(step)))
            yield Question(kind, f"which way is #{b.id} from #{a.id}?", (a.id, b.id), (axis, bool(step[axis] > 0)))


def made_memory(path: Path, count: int) -> None:
    """A house of `count` objects on tables in a row of rooms."""
    rng = np.random.default_rng(count)
    instances, relations, table = [], [], 0
    for n in range(1, count + 1):
        room = np.array([4.0 * (n // 60 % 40), 4.0 * (n // 2400), 0.0])
        if n % 8 == 1:
            table, size, center = n, np.array([1.2, 0.7, 0.7]), room + np.append(rng.uniform(0.6, 3.4, 2), 0.35)
        else:
            size = rng.uniform(0.06, 0.3, 3)
            center = np.append(instances[table - 1].center[:2] + rng.uniform(-0.45, 0.45, 2), 0.7 + size[2] / 2)
            relations.append(Relation(n, "on", table, 0.9, 0.05))
        name = "table" if n == table else _NAMES[int(rng.integers(len(_NAMES)))]
        instances.append(_instance(n, name, center, size, float(rng.uniform(0.4, 1.0))))
    with Store.create(path) as store, store.transaction():
        store.facts.scale_kind, store.facts.gravity = "metric", "known"
        store.instances.put(instances)
        store.relations.replace(None, relations)


def _instance(n: int, name: str, center: np.ndarray, size: np.ndarray, confidence: float) -> Instance:
    return Instance(
        id=n, label=None, description=name, center=center, aabb=np.stack([center - size / 2, center + size / 2]),
        box=OrientedBox(center, size, np.eye(3)), confidence=confidence, observations=20, first_seen_s=0.0,
        last_seen_s=1.0, state="present", structure=None, color_rgb=(200, 200, 200), color_name="white", component=1,
        best_view=None,
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------- the reader


class Reader:
    """A plain program's reading of the text; lengths in metres."""

    def __init__(self, text: str, units: str) -> None:
        scale = 100.0 if units == "m" else 1.0
        self.centers: dict[int, np.ndarray] = {}
        self.sizes: dict[int, np.ndarray] = {}
        self.names: Counter[str] = Counter()
        self.held: dict[int, int] = {}
        self.near: dict[int, dict[int, float]] = {}
        self.total: dict[str, int] = {}
        for line in text.splitlines():
            if line.startswith("In all: "):
                self.total = {m[2]: int(m[1]) for m in re.finditer(r"(\d+) ([^;]+)", line[8:])}
            elif line.startswith("Nearest"):
                for one in line.split(": ", 1)[1].split("; "):
                    subject, others = one.split(": ")
                    for pair in others.split(", "):
                        other, gap = pair.split(" ")
                        for x, y in ((int(subject), int(other)), (int(other), int(subject))):
                            self.near.setdefault(x, {})[y] = float(gap) / scale
            elif found := _ROW.match(line):
                n = int(found[1])
                self.names[found[2]] += 1
                if found[3]:
                    self.centers[n] = np.array([float(v) for v in found[3].split(",")]) / scale
                    self.sizes[n] = np.array([float(v) for v in found[4].split("@")[0].split("x")]) / scale
                if holder := re.search(r"\| (?:on|in|attached to) (\d+)", found[5]):
                    self.held[n] = int(holder[1])

    def answers(self, q: Question) -> bool:
        """Whether the text agrees with the memory."""
        if q.kind == "count":
            return (self.total or self.names).get(q.of[0]) == q.answer
        if q.kind == "held":
            return self.held.get(q.of[0]) in q.answer
        if any(n not in self.centers for n in q.of):
            return False
        if q.kind == "nearest":
            return self._nearest(q.of[0]) in q.answer
        step = self.centers[q.of[1]] - self.centers[q.of[0]]
        if q.kind == "far":
            return abs(float(np.linalg.norm(step)) - q.answer) < 0.02 + 0.02 * q.answer
        axis = int(np.argmax(np.abs(step)))
        return (axis, bool(step[axis] > 0)) == q.answer

    def _nearest(self, n: int) -> int | None:
        if n in self.near:
            return min(self.near[n], key=self.near[n].__getitem__)
        gaps = {k: self._gap(n, k) for k in self.centers if k != n}
        return min(gaps, key=gaps.__getitem__) if gaps else None

    def _gap(self, a: int, b: int) -> float:
        apart = np.abs(self.centers[a] - self.centers[b]) - (self.sizes[a] + self.sizes[b]) / 2
        return float(np.linalg.norm(np.maximum(apart, 0.0)))


def measure(memory: SceneMemory, count: int) -> list[dict[str, Any]]:
    """Shares of questions answered, for each budget."""
    asked = list(questions(memory, count))
    out = []
    for tokens in BUDGETS:
        prompt = memory.prompt(tokens)
        reader = Reader(prompt.text, memory.units)
        right = [reader.answers(q) for q in asked]
        few = asked[::10] if len(asked) > 10 else asked
        few += [q for q in asked[1::10]]
        special = [Reader(memory.prompt(tokens, q.text).text, memory.units).answers(q) for q in few]
        by_kind = {k: [r for r, q in zip(right, asked, strict=True) if q.kind == k] for k in KINDS}
        row = {
            "memory": memory.path.stem, "instances": prompt.instances, "budget": tokens, "tokens": prompt.tokens,
            "listed": len(prompt.listed), "questions": len(asked), "general": float(np.mean(right)),
            "asked": float(np.mean(special)), **{k: float(np.mean(v)) for k, v in by_kind.items() if v},
        }  # fmt: skip
        print("  ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
        out.append(row)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memories", nargs="*", type=Path)
    parser.add_argument("--objects", nargs="*", type=int, default=[10, 100, 1000, 5000])
    parser.add_argument("--questions", type=int, default=200)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        paths = list(options.memories)
        for count in options.objects:
            paths.append(Path(folder) / f"made-{count}.l3r")
            made_memory(paths[-1], count)
        for path in paths:
            with list3r.open(path) as memory:
                rows += measure(memory, options.questions)
            write_json(options.out, {"rows": rows})  # None writes nothing


if __name__ == "__main__":
    main()

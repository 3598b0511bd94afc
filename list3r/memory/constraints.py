"""What an operator said of local instances: what belongs together, what does not, what is gone, what it is called.

Edits speak of local instances (chunk:local), which never change, so they hold however the groups are formed later. The
last word wins: edits are taken newest first, and what an older one says against a newer one is left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

Key = tuple[int, int]
"""(chunk id, local id)."""
T = TypeVar("T")


@dataclass(frozen=True)
class Edit:
    """What an operator did to the library."""

    entry: int
    """Its number in the merge log."""
    created_at: str
    """When, UTC, ISO 8601."""
    author: str
    """Who."""
    kind: str
    """merge, split, label, delete, scale, undo."""
    parts: tuple[tuple[Key, ...], ...]
    """The local instances it speaks of: the two things of a merge, the two parts of a split, else one thing."""
    through: int
    """The last chunk then."""
    before: tuple[tuple[int, str | None, tuple[Key, ...]], ...]
    """Ids, labels and local instances of the things it touched, as they were: what an undo brings back."""
    text: str | None = None
    """The new label, or the anchor of scale as it was said."""
    target: int | None = None
    """The entry of the log that it takes back."""
    scale: tuple[int, float] | None = None
    """Of an anchor of scale: a chunk id, and how many metres a unit of that chunk is."""


def standing(edits: Sequence[Edit]) -> list[Edit]:
    """The edits that hold, oldest first: those that no undo that holds itself has taken back."""
    undone: set[int] = set()
    kept = []
    for edit in sorted(edits, key=lambda e: -e.entry):
        if edit.entry in undone:
            continue
        if edit.kind == "undo" and edit.target is not None:
            undone.add(edit.target)
        kept.append(edit)
    return kept[::-1]


class Bonds:
    """Sets of local instances that belong together, and which sets must never come together. Grows by `join`."""

    def __init__(self) -> None:
        self._root: dict[Key, Key] = {}
        self._members: dict[Key, set[Key]] = {}
        self._foes: dict[Key, set[Key]] = {}

    def copy(self) -> Bonds:
        """Bonds that can grow without changing these."""
        other = Bonds()
        other._root = dict(self._root)
        other._members = {k: set(v) for k, v in self._members.items()}
        other._foes = {k: set(v) for k, v in self._foes.items()}
        return other

    def members(self, key: Key) -> set[Key]:
        """All that belongs together with a local instance, itself too."""
        return self._members.get(self._root.get(key, key), {key})

    def sets(self) -> list[list[Key]]:
        """All sets of two and more, in order."""
        return sorted(sorted(m) for m in self._members.values() if len(m) > 1)

    def part(self, a: Key, b: Key) -> None:
        """The two never come together, unless they belong together already."""
        root_a, root_b = self._root.get(a, a), self._root.get(b, b)
        if root_a != root_b:
            self._foes.setdefault(root_a, set()).add(root_b)
            self._foes.setdefault(root_b, set()).add(root_a)

    def parted(self, a: Key, b: Key) -> bool:
        """Whether the two must not come together."""
        return self._root.get(b, b) in self._foes.get(self._root.get(a, a), ())

    def join(self, a: Key, b: Key) -> None:
        """The two belong together, and all that belongs to them."""
        keep, gone = self._root.get(a, a), self._root.get(b, b)
        if keep == gone:
            return
        moved = self._members.pop(gone, {gone})
        self._members.setdefault(keep, {keep}).update(moved)
        self._root.update(dict.fromkeys(moved | {keep}, keep))
        for foe in self._foes.pop(gone, set()):
            self._foes[foe].discard(gone)
            self._foes[foe].add(keep)
            self._foes.setdefault(keep, set()).add(foe)

    def partings(self) -> list[tuple[Key, Key]]:
        """One pair of names for every two sets that must not come together; see `members`."""
        return sorted((a, b) for a, foes in self._foes.items() for b in foes if a < b)


@dataclass(frozen=True)
class Deletion:
    """A thing that was taken out of the memory."""

    keys: frozenset[Key]
    through: int
    """The last chunk then: what it or an earlier one saw, and what was not deleted, is another thing."""

    def outside(self, keys: Collection[Key]) -> bool:
        """Whether any of these was there when the thing was deleted, and stayed."""
        return any(k[0] <= self.through and k not in self.keys for k in keys)


@dataclass(frozen=True)
class Constraints:
    """All that the standing edits say."""

    bonds: Bonds = field(default_factory=Bonds)
    """What belongs together and what does not."""
    deletions: tuple[Deletion, ...] = ()
    labels: tuple[tuple[frozenset[Key], str | None], ...] = ()
    """Newest first; None takes a label away."""
    touched: frozenset[Key] = frozenset()
    """Shown however little was seen of them, because somebody spoke of them."""

    def __bool__(self) -> bool:
        return bool(self.touched or self.deletions)

    @staticmethod
    def of(edits: Sequence[Edit]) -> Constraints:
        """What edits (undone ones among them) come to."""
        bonds, deletions, labels, touched = Bonds(), [], [], set()
        for edit in reversed(standing(edits)):
            keys = [k for part in edit.parts for k in part]
            if edit.kind in ("merge", "split"):
                _bind(bonds, [keys] if edit.kind == "merge" else edit.parts)
                touched.update(keys)
            if edit.kind == "split":
                for a in edit.parts[0]:
                    for b in edit.parts[1]:
                        bonds.part(a, b)
            elif edit.kind == "label":
                labels.append((frozenset(keys), edit.text))
                touched.update(keys)
            elif edit.kind == "delete":
                _bind(bonds, [keys])
                deletions.append(Deletion(frozenset(keys), edit.through))
        return Constraints(bonds, tuple(deletions), tuple(labels), frozenset(touched))

    def growing(self) -> Growing:
        """To ask while groups are formed."""
        return Growing(self)

    def forbids(self, a: Collection[Key], b: Collection[Key]) -> str:
        """Why two whole groups must not be made one thing, or nothing."""
        if not self:
            return ""
        growing = self.growing()
        for group in (a, b):
            first, *rest = sorted(group)
            for key in rest:
                growing.join(first, key)
        return growing.objection(min(a), min(b))

    def pairs_apart(self, among: Collection[Key]) -> list[tuple[Key, Key]]:
        """Pairs that must not come together, of which one is among these."""
        wanted = set(among)
        out = []
        for a, b in self.bonds.partings():
            left, right = sorted(self.bonds.members(a)), sorted(self.bonds.members(b))
            out += [(x, y) for x in left for y in right if x in wanted or y in wanted]
        return out

    def joined(
        self, groups: Sequence[Sequence[Key]], components: Mapping[int, int], of_first: Mapping[Key, T]
    ) -> tuple[list[list[Key]], dict[Key, T]]:
        """The groups with those joined that belong together, and what is known of them by their first member.

        `components` by chunk id: what lies in two frames of reference cannot be one thing yet. Of several groups that
        come together the last one of which anything is known tells.
        """
        home = {key: n for n, group in enumerate(groups) for key in group}
        parts = {n: [n] for n in range(len(groups))}
        now = list(range(len(groups)))
        for together in self.bonds.sets():
            present = [k for k in together if k in home]
            for component in sorted({components[k[0]] for k in present}):
                ns = sorted({now[home[k]] for k in present if components[k[0]] == component})
                for n in ns[1:]:
                    parts[ns[0]] += parts.pop(n)
                    for m in parts[ns[0]]:
                        now[m] = ns[0]
        out: list[list[Key]] = []
        known: dict[Key, T] = {}
        for members in parts.values():
            keys = sorted(k for n in members for k in groups[n])
            out.append(keys)
            for n in sorted(members):
                if groups[n][0] in of_first:
                    known[keys[0]] = of_first[groups[n][0]]
        return sorted(out), known

    def deleted(self, group: Collection[Key]) -> bool:
        """Whether a group is a thing that was deleted, or what was seen of it later."""
        return any(not d.keys.isdisjoint(group) and not d.outside(group) for d in self.deletions)

    def shown(self, groups: Sequence[Sequence[Key]], evidence: Iterable[bool]) -> list[bool]:
        """Which groups are shown, given which ones the evidence would show."""
        return [
            not self.deleted(g) and (seen or not self.touched.isdisjoint(g))
            for g, seen in zip(groups, evidence, strict=True)
        ]

    def remembered(self, groups: Sequence[Sequence[Key]], before: Mapping[Key, int]) -> dict[Key, int]:
        """The ids of before without those of deleted things."""
        gone = {k for g in groups if self.deleted(g) for k in g} if self.deletions else set()
        return {k: n for k, n in before.items() if k not in gone}

    def labels_of(self, groups: Sequence[Sequence[Key]], weights: Mapping[Key, int]) -> dict[int, str | None]:
        """Labels by group number: each goes to the group with most of what it was given to; the last word wins."""
        home = {key: n for n, group in enumerate(groups) for key in group} if self.labels else {}
        out: dict[int, str | None] = {}
        for keys, text in self.labels:
            share: dict[int, int] = {}
            for k in sorted(keys):
                if k in home:
                    share[home[k]] = share.get(home[k], 0) + weights[k]
            if share:
                out.setdefault(min(share, key=lambda n: (-share[n], n)), text)
        return out


class Growing:
    """Whether groups may join, while they are formed: an operator's word speaks for all that belongs together."""

    def __init__(self, constraints: Constraints) -> None:
        self._bonds = constraints.bonds.copy()
        self._deletions = constraints.deletions

    def objection(self, a: Key, b: Key) -> str:
        """Why the groups of two local instances must stay apart, or nothing."""
        if self._bonds.parted(a, b):
            return "an operator parted them"
        if self._deletions:
            left, right = self._bonds.members(a), self._bonds.members(b)
            for d in self._deletions:
                for one, other in ((left, right), (right, left)):
                    if not d.keys.isdisjoint(one) and d.outside(other):
                        return "an operator deleted one of them, and not the other"
        return ""

    def join(self, a: Key, b: Key) -> None:
        """Two groups, named by any member, have joined."""
        self._bonds.join(a, b)


def _bind(bonds: Bonds, sets: Iterable[Sequence[Key]]) -> None:
    for keys in sets:
        for key in sorted(keys)[1:]:
            if not bonds.parted(min(keys), key):
                bonds.join(min(keys), key)

"""Constraints from operators' edits: what belongs together, what does not, what is gone, what it is called.

Edits name local instances (chunk:local), which never change, so they hold however the groups are formed later. The
last edit wins: edits are taken newest first, and what an older one says against a newer one is left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from scipy.cluster.hierarchy import DisjointSet


Key = tuple[int, int]
"""(chunk id, local id)."""
T = TypeVar("T")


def key_name(key: Key) -> str:
    """Return how a local instance is named in messages and logs: `chunk:local`."""
    return f"{key[0]}:{key[1]}"


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
    """merge, split, label, delete, scale, room, undo."""
    parts: tuple[tuple[Key, ...], ...]
    """The local instances concerned: the two instances of a merge, the two parts of a split, else one instance. Of a
    room the keyframes (chunk id, Frame.index) that were taken in it."""
    through: int
    """The last chunk then."""
    before: tuple[tuple[int, str | None, tuple[Key, ...]], ...]
    """Ids, labels and local instances of the instances it touched, as they were: what an undo brings back."""
    text: str | None = None
    """The new label, the name of a room, or the anchor of scale as it was said."""
    target: int | None = None
    """The entry of the log that it takes back."""
    scale: tuple[int, float] | None = None
    """Of an anchor of scale: a chunk id, and how many metres a unit of that chunk is."""


def standing(edits: Sequence[Edit]) -> list[Edit]:
    """Return the edits that hold, oldest first: those that no undo that holds itself has taken back."""
    undone: set[int] = set()
    kept = []
    for edit in sorted(edits, key=lambda e: -e.entry):
        if edit.entry in undone:
            continue
        if edit.kind == "undo" and edit.target is not None:
            undone.add(edit.target)
        kept.append(edit)
    return kept[::-1]


class LinkConstraints:
    """Sets of local instances that must be linked, and which of these sets must not."""

    def __init__(self) -> None:
        from scipy.cluster.hierarchy import DisjointSet

        self._sets: DisjointSet = DisjointSet()
        self._apart: dict[Key, set[Key]] = {}

    def copy(self) -> LinkConstraints:
        """Return constraints that can grow without changing these."""
        return deepcopy(self)

    def _root(self, key: Key) -> Key:
        return self._sets[key] if key in self._sets else key

    def members(self, key: Key) -> set[Key]:
        """Return all that must be linked with a local instance, itself too."""
        return set(self._sets.subset(key)) if key in self._sets else {key}

    def sets(self) -> list[list[Key]]:
        """Return all sets of two and more, in order."""
        return sorted(sorted(m) for m in self._sets.subsets() if len(m) > 1)

    def cannot_link(self, a: Key, b: Key) -> None:
        """Keep two apart, and all that is linked with them, unless they are linked with each other."""
        a, b = self._root(a), self._root(b)
        if a != b:
            self._apart.setdefault(a, set()).add(b)
            self._apart.setdefault(b, set()).add(a)

    def forbids(self, a: Key, b: Key) -> bool:
        """Return whether two must not be linked."""
        return self._root(b) in self._apart.get(self._root(a), ())

    def must_link(self, a: Key, b: Key) -> None:
        """Link two, and all that is linked with them."""
        self._sets.add(a)
        self._sets.add(b)
        roots = {self._sets[a], self._sets[b]}
        self._sets.merge(a, b)
        keep = self._sets[a]
        for gone in roots - {keep}:
            for other in self._apart.pop(gone, set()):
                self._apart[other].discard(gone)
                self._apart[other].add(keep)
                self._apart.setdefault(keep, set()).add(other)

    def cannot_links(self) -> list[tuple[Key, Key]]:
        """Return one local instance of each for every two sets that must not be linked; see `members`."""
        return sorted((a, b) for a, others in self._apart.items() for b in others if a < b)


@dataclass(frozen=True)
class Deletion:
    """An instance that was taken out of the memory."""

    keys: frozenset[Key]
    through: int
    """The last chunk then: what it or an earlier one saw, and what was not deleted, is another instance."""

    def outside(self, keys: Collection[Key]) -> bool:
        """Return whether any of these was there when the instance was deleted, and stayed."""
        return any(k[0] <= self.through and k not in self.keys for k in keys)


@dataclass(frozen=True)
class Constraints:
    """All that the standing edits say."""

    links: LinkConstraints = field(default_factory=LinkConstraints)
    """What must be linked and what must not."""
    deletions: tuple[Deletion, ...] = ()
    labels: tuple[tuple[frozenset[Key], str | None], ...] = ()
    """Newest first; None takes a label away."""
    touched: frozenset[Key] = frozenset()
    """Shown however little was seen of them, because somebody spoke of them."""

    def __bool__(self) -> bool:
        return bool(self.touched or self.deletions)

    def speaks_of(self, key: Key) -> bool:
        """Return whether somebody said anything of a local instance."""
        return key in self.touched or any(key in d.keys for d in self.deletions)

    @staticmethod
    def of(edits: Sequence[Edit]) -> Constraints:
        """Return what edits (undone ones among them) come to."""
        links, deletions, labels, touched = LinkConstraints(), [], [], set()
        for edit in reversed(standing(edits)):
            keys = [k for part in edit.parts for k in part]
            if edit.kind in ("merge", "split"):
                _must_link(links, [keys] if edit.kind == "merge" else edit.parts)
                touched.update(keys)
            if edit.kind == "split":
                for a, b in product(*edit.parts[:2]):
                    links.cannot_link(a, b)
            if edit.kind == "label":
                labels.append((frozenset(keys), edit.text))
                touched.update(keys)
            if edit.kind == "delete":
                _must_link(links, [keys])
                deletions.append(Deletion(frozenset(keys), edit.through))
        return Constraints(links, tuple(deletions), tuple(labels), frozenset(touched))

    def check(self) -> ConstraintCheck:
        """Return what to ask while groups are formed."""
        return ConstraintCheck(self)

    def forbids(self, a: Collection[Key], b: Collection[Key]) -> str:
        """Return why two whole groups must not be made one instance, or nothing."""
        if not self:
            return ""
        check = self.check()
        for group in (a, b):
            first, *rest = sorted(group)
            for key in rest:
                check.join(first, key)
        return check.objection(min(a), min(b))

    def pairs_apart(self, among: Collection[Key]) -> list[tuple[Key, Key]]:
        """Return pairs that must not come together, of which one is among these."""
        wanted = set(among)
        out = []
        for a, b in self.links.cannot_links():
            pairs = product(sorted(self.links.members(a)), sorted(self.links.members(b)))
            out += [(x, y) for x, y in pairs if x in wanted or y in wanted]
        return out

    def joined(
        self, groups: Sequence[Sequence[Key]], components: Mapping[int, int], of_first: Mapping[Key, T]
    ) -> tuple[list[list[Key]], dict[Key, T]]:
        """Return the groups with those joined that must be linked, and what is known of them by their first member.

        `components` by chunk id: instances of two connected components cannot be one yet. Of several groups
        that come together the last known one counts.
        """
        from scipy.cluster.hierarchy import DisjointSet

        home = {key: n for n, group in enumerate(groups) for key in group}
        sets = DisjointSet(range(len(groups)))
        for together in self.links.sets():
            first: dict[int, int] = {}
            for k in (k for k in together if k in home):
                sets.merge(first.setdefault(components[k[0]], home[k]), home[k])
        out: list[list[Key]] = []
        known: dict[Key, T] = {}
        for members in map(sorted, sets.subsets()):
            keys = sorted(k for n in members for k in groups[n])
            out.append(keys)
            found = [of_first[groups[n][0]] for n in members if groups[n][0] in of_first]
            if found:
                known[keys[0]] = found[-1]
        return sorted(out), known

    def deleted(self, group: Collection[Key]) -> bool:
        """Return whether a group is an instance that was deleted, or what was seen of it later."""
        return any(not d.keys.isdisjoint(group) and not d.outside(group) for d in self.deletions)

    def shown(self, groups: Sequence[Sequence[Key]], evidence: Iterable[bool]) -> list[bool]:
        """Return which groups are shown, given which ones the evidence would show."""
        return [
            not self.deleted(g) and (seen or not self.touched.isdisjoint(g))
            for g, seen in zip(groups, evidence, strict=True)
        ]

    def remembered(self, groups: Sequence[Sequence[Key]], before: Mapping[Key, int]) -> dict[Key, int]:
        """Return the ids of before without those of deleted instances."""
        gone = {k for g in groups if self.deleted(g) for k in g} if self.deletions else set()
        return {k: n for k, n in before.items() if k not in gone}

    def labels_of(self, groups: Sequence[Sequence[Key]], weights: Mapping[Key, int]) -> dict[int, str | None]:
        """Return labels by group number: each goes to the group with most of what it was given to; the last word
        wins.
        """
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


class ConstraintCheck:
    """Whether groups may join, while they are formed: a constraint holds for all that is linked."""

    def __init__(self, constraints: Constraints) -> None:
        self._links = constraints.links.copy()
        self._deletions = constraints.deletions

    def objection(self, a: Key, b: Key) -> str:
        """Return why the groups of two local instances must stay apart, or nothing."""
        if self._links.forbids(a, b):
            return "an operator split them"
        if not self._deletions:
            return ""
        left, right = self._links.members(a), self._links.members(b)
        sides = ((left, right), (right, left))
        separated = (not d.keys.isdisjoint(x) and d.outside(y) for d in self._deletions for x, y in sides)
        return "an operator deleted one of them, and not the other" if any(separated) else ""

    def join(self, a: Key, b: Key) -> None:
        """Take in that two groups, named by any member, have joined."""
        self._links.must_link(a, b)


def _must_link(links: LinkConstraints, sets: Iterable[Sequence[Key]]) -> None:
    for keys in sets:
        for key in sorted(keys)[1:]:
            if not links.forbids(min(keys), key):
                links.must_link(min(keys), key)

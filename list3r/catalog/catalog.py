"""The face of a catalogue: the questions that one memory answers, for one of many memories or for all."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.batch.storage import Output, is_remote
from list3r.catalog.backends import open_backend
from list3r.catalog.base import MOST_RANKED, Backend
from list3r.catalog.reading import printable, read_content
from list3r.catalog.records import (
    CatalogAnswers,
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    CatalogMatch,
    CatalogRelation,
    MemoryEntry,
    UnknownMemoryError,
    Wanted,
)
from list3r.memory.core.description.words import kind_word
from list3r.memory.core.errors import OptionError, SpaceMismatchError, UnknownIdError, naming_extras
from list3r.memory.library.relations.predicates import PREDICATES
from list3r.memory.store.search.vectors import unit_query
from list3r.queries.finding.grammar import Phrase, parse
from list3r.queries.finding.naming import tiers
from list3r.queries.finding.words import STRUCTURE, wanted_words
from list3r.queries.match import checked_count, checked_length, checked_point
from list3r.queries.relations import ALL_PREDICATES
from list3r.queries.views.viewpoint import VIEWPOINT

MOST_ANSWERS = 1_000
"""Answers of one question."""
_LARGEST_ID = 2**63 - 1


class Catalog:
    """A catalogue that is open; use it as a context manager or call `close`.

    Answers come from the catalogue alone: distances are to oriented boxes. The surfaces are in the file that each
    answer names.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @staticmethod
    @naming_extras()
    def open(url: str, connections: int = 1, *, make: bool = True) -> Catalog:
        """Open postgresql://host/name, or a file of the embedded catalogue, which is made where there is none unless
        `make` is False.

        Raises `CatalogError`.
        """
        return Catalog(open_backend(url, connections, make=make))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let the database go."""
        self._backend.close()

    def alive(self) -> bool:
        """Whether the database answers."""
        return self._backend.alive()

    # ------------------------------------------------------------------ memories

    def add(self, path: str | Path, name: str | None = None, store: str | None = None) -> MemoryEntry:
        """Add a memory file to the catalogue, in place of the one with its name; returns its entry, with the new
        revision.

        With a `store`, a folder or URL, the file is copied there under a name that no other file ever gets, and the
        catalogue names the copy. Raises `OptionError` for an invalid name, `CatalogError`, `MemoryFileError`.
        """
        content = read_content(str(path), name)
        if store is not None:
            kept = f"{content.entry.name}-{content.entry.sha256[:16]}"
            output = Output(store)
            output.prepare()
            if output.size(kept) is None:
                if is_remote(str(path)):
                    raise CatalogError(f"{path} is in a store already; leave out --store")
                output.publish(Path(path), kept, replace=False)
            content = read_content(output.place(kept), content.entry.name)
        return self._backend.put(content)

    def again(self, path: str, name: str | None = None) -> MemoryEntry:
        """Write a memory again from its file; its revision stays where the file is the same. Raises as `add` does."""
        try:
            content = read_content(path, name)
        except OptionError as error:
            raise OptionError(f"{error}; if the catalogue has it, `list3r catalog remove` forgets it") from None
        return self._backend.put(content, again=True)

    def loading(self, count: int) -> AbstractContextManager[None]:
        """Add this many memories meanwhile: if the catalogue has fewer, its indices are built again at the end."""
        return self._backend.loading(many=count > len(self._backend.memories()))

    def remove(self, name: str) -> None:
        """Forget a memory; its file stays. Raises `CatalogError` where there is none of that name."""
        if not self._backend.drop(printable(name)):
            raise _unknown(name)

    def memories(self) -> list[MemoryEntry]:
        """Return all memories by name."""
        return self._backend.memories()

    def memory(self, name: str) -> MemoryEntry:
        """Return one memory. Raises `CatalogError` where there is none of that name."""
        found = self._backend.memories([printable(name)])
        if not found:
            raise _unknown(name)
        return found[0]

    # ------------------------------------------------------------------ questions

    def nearest(
        self,
        memory: str,
        *,
        point: ArrayLike | None = None,
        instance_id: int | None = None,
        k: int = 5,
        filters: CatalogFilters | None = None,
    ) -> CatalogAnswers:
        """Find the k instances of one memory nearest to a point or to the centre of an instance, by their boxes."""
        k, filters = _count(k), filters or CatalogFilters()
        if (point is None) == (instance_id is None):
            raise OptionError("give either a point or an instance")
        at = checked_point(point, "point") if point is not None else self._known(memory, instance_id).box.center
        count, own = k + 8, instance_id
        while True:
            entry, near = _of(memory, self._backend.near(printable(memory), at.tolist(), count, filters))
            found = [f for f in _by_distance(near, at) if f[1] != own][:k]
            # Axis-aligned boxes bound the distance from below: other instances are no nearer than the last.
            if len(near) < count or (len(found) == k and found[-1][0] <= near[-1].aabb_distance(at)):
                break
            count *= 4
        reference = "the point" if own is None else f"the centre of #{own}"
        return self._answers(((t, 1.0 / (1.0 + d), d, f"box {d:.2f} from {reference}") for d, _, t in found), [entry])

    def within(
        self,
        memory: str,
        *,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        center: ArrayLike | None = None,
        radius: float | None = None,
        filters: CatalogFilters | None = None,
    ) -> CatalogAnswers:
        """Find the instances of one memory whose boxes meet a box or a sphere, those nearest to its middle first."""
        filters = filters or CatalogFilters()
        box, sphere = lower is not None and upper is not None, center is not None and radius is not None
        if box == sphere:
            raise OptionError("give one region: a box (lower and upper corner) or a sphere (center and radius)")
        if box:
            assert lower is not None and upper is not None
            low, high = checked_point(lower, "lower corner"), checked_point(upper, "upper corner")
            middle, reach = (low + high) / 2.0, np.inf
            if (low > high).any():
                raise OptionError(f"the lower corner {low.tolist()} must not be beyond the upper one {high.tolist()}")
        else:
            assert center is not None and radius is not None
            middle, reach = checked_point(center, "center"), checked_length(radius, "radius")
            low, high = middle - reach, middle + reach
        region = low.tolist(), high.tolist()
        entry, met = _of(memory, self._backend.inside(printable(memory), *region, filters, MOST_ANSWERS + 1))
        found = _by_distance(met, middle)
        notes = [f"only the first {MOST_ANSWERS} instances are listed"] if len(met) > MOST_ANSWERS else []
        rows = (
            (t, 1.0 / (1.0 + d), d, f"box {d:.2f} from the middle") for d, _, t in found[:MOST_ANSWERS] if d <= reach
        )
        return self._answers(rows, [entry], notes)

    def find(
        self, text: str, memory: str | None = None, *, k: int = 5, filters: CatalogFilters | None = None
    ) -> CatalogAnswers:
        """Answer a question, in one memory or over all: names in any word for them, and stored relations to others.

        Sizes, superlatives and what depends on a viewpoint are questions to one file. Raises `OptionError`.
        """
        k, filters, entries = _count(k), filters or CatalogFilters(), self._entries(memory)
        question = parse(text)
        best: dict[tuple[str, int], tuple[CatalogInstance, float, None, str]] = {}
        total, notes, fits = 0, list(question.notes), []
        for phrase in question.phrases:
            found, ranked = self._named(memory, phrase, k, filters)
            fits.append(question.at_least <= ranked <= (MOST_RANKED if question.at_most is None else question.at_most))
            total += ranked
            if ranked >= MOST_RANKED:
                notes.append(f"{ranked} or more things match {text!r}; only {ranked} were ranked")
            for t, score, wording in found:
                best.setdefault((t.memory, t.id), (t, score, None, wording))
        rows = sorted(best.values(), key=lambda row: -row[1])[:k]
        out = self._answers(rows, entries, notes)
        if question.kind == "count":
            out.counted = total
        if question.kind == "exists":
            out.answer = "yes" if (all(fits) if question.every else any(fits)) else "no"
        return out

    def _named(
        self, memory: str | None, phrase: Phrase, k: int, filters: CatalogFilters
    ) -> tuple[list[tuple[CatalogInstance, float, str]], int]:
        """Return the k best that a phrase means, by the first of its nouns that names any, and how many there are."""
        for nouns in tiers(phrase):
            found: dict[tuple[str, int], tuple[CatalogInstance, float, str]] = {}
            total = 0
            for noun in nouns or (None,):
                wanted = _wanted(phrase, noun)
                structure = not STRUCTURE.isdisjoint((*phrase.all_words, noun))
                chosen = CatalogFilters(True, filters.min_confidence, filters.state) if structure else filters
                rows, ranked = self._backend.named(memory, wanted, k, chosen)
                total += ranked
                wording = f"named {' '.join(phrase.words + ((noun,) if noun else phrase.noun))}".strip()
                for t, score in rows:
                    found.setdefault((t.memory, t.id), (t, score, wording if wanted.words else "stands so"))
            if found:
                return list(found.values()), total
        return [], 0

    def similar(
        self,
        memory: str | None = None,
        *,
        instance_id: int | None = None,
        vector: ArrayLike | None = None,
        space: str | None = None,
        anywhere: bool = True,
        k: int = 5,
        filters: CatalogFilters | None = None,
    ) -> CatalogAnswers:
        """Find instances that look like an instance of a memory, or like a vector of a space: over all memories, or in
        that one alone where not `anywhere`.

        Raises `OptionError` for arguments that make no sense, `SpaceMismatchError` for vectors of another space.
        """
        k, filters, entries = _count(k), filters or CatalogFilters(), self._entries(memory)
        if (instance_id is None) == (vector is None):
            raise OptionError("give either an instance or a vector to compare with")
        chosen = self._space(memory, space)
        if instance_id is not None:
            if memory is None:
                raise OptionError("an id belongs to one memory; name that memory")
            self._known(memory, instance_id)
            asked = self._backend.vector(memory, instance_id, chosen)
            if asked is None:
                raise OptionError(f"{memory} has no vector for #{instance_id} in {chosen}; `list3r embed` makes one")
            vector = asked
        assert vector is not None
        unit = unit_query(vector)
        self._check_space(chosen, len(unit))
        found = self._backend.alike(None if anywhere else memory, chosen, unit, k + (instance_id is not None), filters)
        others = [(t, c) for t, c in found if (t.memory, t.id) != (memory, instance_id)][:k]
        rows = ((t, c, None, f"cosine in {chosen}") for t, c in others)
        return self._answers(rows, [] if anywhere else entries)

    def relations(
        self,
        memory: str | None = None,
        *,
        subject: int | str | None = None,
        predicate: str | None = None,
        object: int | str | None = None,
        k: int = 100,
    ) -> CatalogAnswers:
        """Return stored relations by any of subject, predicate and object (words, or ids within one memory)."""
        k, entries = _count(k), self._entries(memory)
        if predicate is not None and (
            predicate in VIEWPOINT or predicate not in ALL_PREDICATES or predicate == "between"
        ):
            stored = ", ".join(p for p in ALL_PREDICATES if p not in VIEWPOINT and p != "between")
            raise OptionError(f"predicate {predicate!r} is not stored; choose one of: {stored}")
        if subject is None and object is None and memory is None:
            raise OptionError("over all memories, name the subject or the object by words, such as mug")
        ends = self._end(subject, memory), self._end(object, memory)
        rows = self._backend.related(memory, ends[0], predicate, ends[1], k)
        by_name = self._by_name(entries, [r[0] for r in rows])
        return CatalogAnswers(
            CatalogRelation(
                r[0], by_name[r[0]][0].revision, by_name[r[0]][0].path, by_name[r[0]][1], *r[1:6], *_rounded(r[6:])
            )
            for r in rows
            if r[0] in by_name
        )

    # ------------------------------------------------------------------ parts

    def _entries(self, memory: str | None) -> list[MemoryEntry]:
        return [] if memory is None else [self.memory(memory)]

    def _known(self, memory: str, instance_id: int | None) -> CatalogInstance:
        assert instance_id is not None
        found, name = None, printable(memory)
        if 0 <= instance_id <= _LARGEST_ID:
            found = self._backend.instance(name, instance_id)
            if found is None:  # there is no such memory, or it was taken in again since it was last asked for
                found = self._backend.instance(self.memory(name).name, instance_id)
        if found is None:
            raise UnknownIdError(f"the catalogue has no instance {instance_id} in {memory}")
        return found

    def _end(self, what: int | str | None, memory: str | None) -> Wanted:
        """Return the instances meant by a subject or an object."""
        if what is None:
            return Wanted()
        if isinstance(what, str) and not re.fullmatch(r"#?[0-9]{1,18}", what):
            return Wanted(tuple(wanted_words(what)))
        if memory is None:
            raise OptionError(f"id {what} belongs to one memory; name that memory, or give words")
        number = int(what.removeprefix("#")) if isinstance(what, str) else what
        return Wanted(instance_id=self._known(memory, number).id)

    def _space(self, memory: str | None, space: str | None) -> str:
        if space is not None:
            return space
        spaces = self._backend.spaces(memory)
        if len(spaces) != 1:
            which = f"name one of: {', '.join(spaces)}" if spaces else "`list3r embed` makes vectors"
            what = memory or "the catalogue"
            raise OptionError(f"{what} has vectors of {len(spaces)} spaces; {which}")
        return spaces[0]

    def _check_space(self, space: str, numbers: int) -> None:
        """Raise `SpaceMismatchError` unless the catalogue has vectors of so many numbers in a space."""
        held = self._backend.dimension(space)
        if held is None:
            known = ", ".join(self._backend.spaces(None)) or "none"
            raise SpaceMismatchError(f"the catalogue has no vectors of {space}; it has: {known}")
        if held != numbers:
            raise SpaceMismatchError(f"a vector of {numbers} numbers does not belong to {space}, which has {held}")

    def _by_name(
        self, known: Iterable[MemoryEntry], names: Iterable[str]
    ) -> dict[str, tuple[MemoryEntry, bool | None]]:
        """Return the entries of some memories, with whether their files have changed since."""
        wanted, entries = set(names), {e.name: e for e in known}
        missing = sorted(wanted - entries.keys())
        entries |= {e.name: e for e in (self._backend.memories(missing) if missing else ())}
        return {n: (entries[n], is_stale(entries[n])) for n in wanted if n in entries}

    def _answers(
        self,
        rows: Iterable[tuple[CatalogInstance, float, float | None, str]],
        known: Sequence[MemoryEntry],
        notes: Sequence[str] = (),
    ) -> CatalogAnswers:
        held = list(rows)
        by_name = self._by_name(known, (t.memory for t, *_ in held))
        found = [_match(t, *by_name[t.memory], notices) for t, *notices in held if t.memory in by_name]
        stale = sorted({m.memory for m in found if m.stale})
        notices = [f"{n} has changed since it was added; `list3r catalog add` adds the current file" for n in stale]
        return CatalogAnswers(found, [*notes, *notices])


def _of(
    name: str, found: tuple[MemoryEntry, list[CatalogInstance]] | None
) -> tuple[MemoryEntry, list[CatalogInstance]]:
    """Return the result of a database for a memory. Raises `UnknownMemoryError` where it has none of that name."""
    if found is None:
        raise _unknown(name)
    return found


def _unknown(name: str) -> UnknownMemoryError:
    return UnknownMemoryError(f"the catalogue has no memory {name!r}; `list3r catalog list` shows them")


def is_stale(entry: MemoryEntry) -> bool | None:
    """Return whether a file differs from the catalogued one; None for one that is not on this machine."""
    if is_remote(entry.path) or not entry.mtime_ns:
        return None
    try:
        now = Path(entry.path).stat()
    except OSError:
        return True
    return (now.st_size, now.st_mtime_ns) != (entry.bytes, entry.mtime_ns)


def box_distances(instances: Sequence[CatalogInstance], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of a point from oriented boxes, 0 inside, world units. Shape (N,)."""
    apart = point - np.array([t.box.center for t in instances]).reshape(-1, 3)
    axes, size = (np.array([getattr(t.box, name) for t in instances]) for name in ("rotation", "size"))
    local = np.einsum("ni,nij->nj", apart, axes.reshape(-1, 3, 3))
    return np.asarray(np.linalg.norm(np.maximum(np.abs(local) - size.reshape(-1, 3) / 2.0, 0.0), axis=1))


def _by_distance(
    instances: Sequence[CatalogInstance], point: NDArray[np.float64]
) -> list[tuple[float, int, CatalogInstance]]:
    """Return instances with the distance of a point from their boxes and their number, the nearest first."""
    held = zip(box_distances(instances, point).tolist(), instances, strict=True)
    return sorted(((d, t.id, t) for d, t in held), key=lambda f: f[:2])


def _match(t: CatalogInstance, entry: MemoryEntry, stale: bool | None, found: Sequence[Any]) -> CatalogMatch:
    score, distance, reason = found
    return CatalogMatch(
        t.memory,
        entry.revision,
        entry.path,
        stale,
        t.id,
        t.label,
        t.description,
        t.state,
        round(t.confidence, 4),
        tuple(_rounded(t.box.center.tolist())),
        tuple(_rounded(t.box.size.tolist())),
        entry.units,
        round(score, 4),
        None if distance is None else round(distance, 4),
        reason,
    )


def _rounded(numbers: Iterable[float]) -> list[float]:
    return [round(x, 4) for x in numbers]


def _wanted(phrase: Phrase, noun: str | None) -> Wanted:
    """Return a phrase as what the database can look for. Raises `OptionError` for what only a file can tell."""
    negated = next((c for c in phrase.where if c.negated), None)
    for what, beyond in (
        (phrase.size, phrase.size is not None),
        (phrase.order and phrase.order.by, phrase.order is not None),
        (f"#{phrase.instance_id}", phrase.instance_id is not None),
        (phrase.change, phrase.change is not None),
        ("between", any(c.other for c in phrase.where)),
        (negated and f"not {negated.object.text}", negated is not None),
    ):
        if beyond:
            raise OptionError(f"{phrase.text!r}: a catalogue cannot answer {what!r}; ask the memory file")
    where = []
    for clause in phrase.where:
        stored = tuple(p for p in clause.predicates if p in PREDICATES)
        if not stored:
            raise OptionError(f"{phrase.text!r}: {clause.wording!r} depends on the viewpoint; ask the memory file")
        where.append((stored, _wanted(clause.object, next(iter(clause.object.meant), None))))
    words = (*phrase.words, kind_word(noun)) if noun else phrase.all_words
    if not words and not where:
        raise OptionError(f"{phrase.text!r} has no word to search for; name an object, a colour or a shape")
    return Wanted(words, None, tuple(where))


def _count(k: int) -> int:
    k = checked_count(k)
    if k > MOST_ANSWERS:
        raise OptionError(f"k = {k}: a catalogue gives at most {MOST_ANSWERS} answers; ask for fewer")
    return k

"""The store against a plain model: chunks, edits, undos and reopenings in any order.

`LIST3R_TEST_PROFILE=thorough` makes it go through many more steps, other ones each time.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from list3r.memory.core.constraints import Key
from list3r.memory.core.errors import UnknownIdError
from list3r.memory.library import consolidation
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from tests.conftest import THOROUGH
from tests.memory_scenes import BOX, MUG, TWIN
from tests.test_consolidation import add, chunk, create

PIECES = [MUG, TWIN, BOX]
MOST_CHUNKS = 4
IN_MEMORY = "/dev/shm"
"""Where there is such a folder no step waits for a disk."""
View = dict[int, tuple[str | None, frozenset[Key]]]


def view(store: Store) -> View:
    """All that a reader sees of who is who: labels and local instances by id."""
    return {
        i.id: (i.label, frozenset((o.chunk_id, o.local_id) for o in store.observations.of(i.id)))
        for i in store.instances.all()
    }


@dataclass(frozen=True)
class Said:
    """What an operator said: the model's own record of an edit."""

    kind: str
    parts: tuple[frozenset[Key], ...]
    text: str | None = None

    @property
    def keys(self) -> frozenset[Key]:
        return frozenset().union(*self.parts)


class StoreAgainstModel(RuleBasedStateMachine):
    """The model knows what is what, and what was said and not taken back; it knows nothing of how groups are formed."""

    @initialize(grows=st.booleans())
    def begin(self, grows: bool) -> None:
        """A memory whose library grows from the first chunk on, or is derived as a whole each time."""
        self.patch = pytest.MonkeyPatch()
        if grows:
            self.patch.setattr(consolidation, "_ALWAYS", 2)
        self.folder = tempfile.TemporaryDirectory(dir=IN_MEMORY if os.access(IN_MEMORY, os.W_OK) else None)
        self.path = Path(self.folder.name) / "a.l3r"
        self.store = create(self.path)
        self.chunks = 0
        self.truth: dict[Key, str] = {}
        self.said: dict[int, Said] = {}
        self.last: tuple[int, View] | None = None
        self.held: dict[int, frozenset[Key]] = {}
        self.add_chunk()
        self.add_chunk()

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            self.folder.cleanup()
            self.patch.undo()

    # ------------------------------------------------------------------ what happens

    @precondition(lambda self: self.chunks < MOST_CHUNKS)
    @rule()
    def add_chunk(self) -> None:
        result = chunk(self.chunks, PIECES)
        add(self.store, result)
        self.chunks += 1
        for i in result.library.instances:
            color = tuple(i.support.rgb[0].tolist())
            near = min((MUG, TWIN), key=lambda p: abs(p.center[0] - float(i.support.points[:, 0].mean())))
            self.truth[self.chunks, i.local_id] = BOX.name if color == BOX.rgb else near.name
        self.last = None

    @rule(data=st.data())
    def merge(self, data: st.DataObject) -> None:
        before = view(self.store)
        if len(before) < 2:
            return
        a, b = data.draw(st.lists(st.sampled_from(sorted(before)), min_size=2, max_size=2, unique=True))
        report = edits.merge(self.store, a, b)
        assert report.ids == (min(a, b),) and self.store.ids.resolve(max(a, b)) == min(a, b)
        self._said(report.entry, Said("merge", (before[a][1], before[b][1])), before)

    @rule(data=st.data())
    def split(self, data: st.DataObject) -> None:
        before = view(self.store)
        large = [n for n in sorted(before) if len(before[n][1]) > 1]
        if not large:
            return
        n = data.draw(st.sampled_from(large))
        keys = sorted(before[n][1])
        out = data.draw(st.none() | st.lists(st.sampled_from(keys), min_size=1, max_size=len(keys) - 1, unique=True))
        report = edits.split(self.store, n, out)
        now = view(self.store)
        assert len(report.new) <= 1 and all(m > max(self.held) for m in report.new)
        # What a split leaves free may go to an older thing that it had been kept from; then there is no new one.
        left, right = (held & before[n][1] for _, held in now.values() if held & before[n][1])
        assert left | right == before[n][1]
        assert out is None or frozenset(out) in (left, right)
        self._said(report.entry, Said("split", (left, right)), before)

    @rule(data=st.data(), text=st.sampled_from(["a", "b", None]))
    def label(self, data: st.DataObject, text: str | None) -> None:
        before = view(self.store)
        if before:
            n = data.draw(st.sampled_from(sorted(before)))
            report = edits.label(self.store, n, text)
            assert view(self.store) == {**before, n: (text, before[n][1])}
            self._said(report.entry, Said("label", (before[n][1],), text), before)

    @rule(data=st.data())
    def delete(self, data: st.DataObject) -> None:
        before = view(self.store)
        if len(before) > 1:
            n = data.draw(st.sampled_from(sorted(before)))
            report = edits.delete(self.store, n)
            assert view(self.store) == {k: v for k, v in before.items() if k != n}
            self._said(report.entry, Said("delete", (before[n][1],)), before)

    @precondition(lambda self: self.said)
    @rule(data=st.data())
    def undo(self, data: st.DataObject) -> None:
        entry = data.draw(st.none() | st.sampled_from(sorted(self.said)))
        report = edits.undo(self.store, entry)
        entry = max(self.said) if entry is None else entry
        if self.last is not None and self.last[0] == entry:
            assert view(self.store) == self.last[1], "the undo of the last edit brings back what was"
        del self.said[entry]
        self.last = None
        assert report.kind == "undo"

    @rule(data=st.data(), kind=st.sampled_from(["merge", "split", "label", "delete"]), again=st.booleans())
    def say_and_take_back(self, data: st.DataObject, kind: str, again: bool) -> None:
        """What is taken back at once leaves nothing behind; taken back in turn, it holds again."""
        before, known = view(self.store), set(self.said)
        if kind == "label":
            self.label(data, "c")
        else:
            {"merge": self.merge, "split": self.split, "delete": self.delete}[kind](data)
        for entry in set(self.said) - known:
            after, what = view(self.store), self.said.pop(entry)
            undone = edits.undo(self.store, entry).entry
            assert view(self.store) == before
            if again:
                edits.undo(self.store, undone)
                assert view(self.store) == after
                self.said[entry] = what
        self.last = None

    @rule()
    def reopen(self) -> None:
        before = (view(self.store), self.store.ids.aliases(), self.store.edits.all(), self.store.relations.all())
        self.store.close()
        self.store = Store.open(self.path, writable=True)
        assert (
            view(self.store),
            self.store.ids.aliases(),
            self.store.edits.all(),
            self.store.relations.all(),
        ) == before

    def _said(self, entry: int, what: Said, before: View) -> None:
        self.said[entry] = what
        self.last = (entry, before)

    # ------------------------------------------------------------------ what always holds

    @invariant()
    def the_file_is_sound(self) -> None:
        if hasattr(self, "store"):
            assert self.store.verify() == []

    @invariant()
    def what_was_said_last_of_anything_holds(self) -> None:
        if not hasattr(self, "store"):
            return
        home = {k: n for n, (_, keys) in view(self.store).items() for k in keys}
        deleted = {k for s in self.said.values() if s.kind == "delete" for k in s.keys}
        assert not deleted & set(home), "what is deleted is not seen"
        spoken: set[Key] = set()
        for _, s in sorted(self.said.items(), reverse=True):
            if s.kind in ("merge", "split") and not s.keys & (spoken | deleted):
                homes = [{home.get(k) for k in part} for part in s.parts]
                assert all(len(h) == 1 and None not in h for h in homes)
                assert (homes[0] == homes[1]) == (s.kind == "merge")
            if s.kind == "label" and not s.keys & (spoken | deleted):
                owners = {home.get(k) for k in s.keys}
                rivals = [t for e, t in self.said.items() if t.kind == "label" and t is not s]
                if len(owners) == 1 and not any({home.get(k) for k in t.keys} & owners for t in rivals):
                    assert self.store.instances.get(owners.pop() or 0).label == s.text
            if s.kind != "label":
                spoken |= s.keys

    @invariant()
    def what_nobody_spoke_of_is_grouped_as_it_is_in_truth(self) -> None:
        if not hasattr(self, "store"):
            return
        home = {k: n for n, (_, keys) in view(self.store).items() for k in keys}
        spoken = {self.truth[k] for s in self.said.values() for k in s.keys}
        for name in {p.name for p in PIECES} - spoken:
            keys = [k for k, n in self.truth.items() if n == name]
            owners = {home.get(k) for k in keys}
            assert len(owners) == 1 and None not in owners
            assert set(keys) == {k for k, n in home.items() if n in owners}

    @invariant()
    def every_id_resolves_or_was_deleted(self) -> None:
        if not hasattr(self, "store"):
            return
        now = view(self.store)
        for n, (_, keys) in now.items():
            self.held[n] = keys
        assert not self.store.ids.aliases().keys() & now.keys(), "what names an instance is no alias"
        seen = {k for _, keys in now.values() for k in keys}
        for n, keys in self.held.items():
            try:
                assert self.store.ids.resolve(n) in now
            except UnknownIdError as error:
                assert "was deleted" in str(error)
                assert any(s.kind == "delete" for s in self.said.values())
                assert not (n in now and keys & seen)


StoreAgainstModel.TestCase.settings = settings(
    max_examples=400 if THOROUGH else 30,
    stateful_step_count=40 if THOROUGH else 9,
    derandomize=not THOROUGH,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
TestStoreAgainstModel = pytest.mark.slow(StoreAgainstModel.TestCase)

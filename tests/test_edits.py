"""Edits: what an operator said holds, whatever arrives later, and can be taken back."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import pytest

import list3r
from list3r.cli.app import run
from list3r.memory.core.constraints import Key
from list3r.memory.core.errors import List3rError, MemoryFileError, OptionError, UnknownIdError
from list3r.memory.core.geometry import Sim3
from list3r.memory.library.maintenance import edits
from list3r.memory.library.maintenance.merge_log import merge_log
from list3r.memory.store.store import Store
from tests.conftest import instance
from tests.memory_scenes import CHAIR, MUG, TABLE, TWIN
from tests.test_consolidation import add, chunk, content, create

PIECES = [TABLE, MUG, TWIN, CHAIR]


def built(path: Path, chunks: int = 3) -> Store:
    store = create(path)
    for k in range(chunks):
        add(store, chunk(k, PIECES))
    return store


def at(store: Store, piece: object) -> int:
    """The id of a thing, by the local instance that is it in the first chunk."""
    return min(
        store.instances.all(),
        key=lambda i: float(sum((i.center - piece.center) ** 2)),  # type: ignore[attr-defined]
    ).id


def members(store: Store, instance_id: int) -> set[Key]:
    return {(o.chunk_id, o.local_id) for o in store.observations.of(instance_id)}


def partition(store: Store) -> dict[int, set[Key]]:
    return {i.id: members(store, i.id) for i in store.instances.all()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("edits") / "walk.l3r"
    built(path).close()
    return path


@pytest.fixture
def path(finished: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "walk.l3r"
    copy.write_bytes(finished.read_bytes())
    return copy


def test_a_merge_keeps_the_older_id_and_holds_when_both_are_seen_again(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        mug, twin = at(store, MUG), at(store, TWIN)
        older, newer = min(mug, twin), max(mug, twin)
        both = members(store, mug) | members(store, twin)
        report = edits.merge(store, twin, mug, author="ann")
        assert (report.ids, report.aliases) == ((older,), ((newer, older),))
        assert members(store, older) == both and store.ids.resolve(newer) == older
    with Store.open(path, writable=True) as store:
        add(store, chunk(3, PIECES))
        assert len(store.instances.all()) == len(PIECES) - 1
        assert store.ids.resolve(newer) == older and len(members(store, older)) == len(both) + 2
        assert store.edits.all()[0].author == "ann" and store.verify() == []


def test_undoing_a_merge_brings_the_retired_id_back(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        before = partition(store)
        mug, twin = at(store, MUG), at(store, TWIN)
        edits.merge(store, mug, twin)
        report = edits.undo(store)
        assert report.restored == (max(mug, twin),)
        assert partition(store) == before and store.ids.aliases() == {}
        edits.undo(store, report.entry)
        assert store.ids.resolve(max(mug, twin)) == min(mug, twin), "undoing the undo brings the merge back"


def test_a_split_gives_a_new_id_to_the_smaller_part_and_holds(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        chair = at(store, CHAIR)
        whole = members(store, chair)
        leaving = sorted(whole)[1]
        report = edits.split(store, chair, [leaving])
        new = report.new[0]
        assert new == len(PIECES) + 1
        assert members(store, new) == {leaving} and members(store, chair) == whole - {leaving}
        add(store, chunk(3, PIECES))
        assert members(store, new) >= {leaving} and members(store, chair) >= whole - {leaving}
        undone = edits.undo(store)
        assert undone.aliases == ((new, chair),) and members(store, chair) >= whole
        again = edits.undo(store, undone.entry)
        assert again.restored == (new,) and members(store, new) >= {leaving}


def test_a_split_without_parts_finds_the_two_things_that_were_merged(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        mug, twin = at(store, MUG), at(store, TWIN)
        parts = {frozenset(members(store, mug)), frozenset(members(store, twin))}
        edits.merge(store, mug, twin)
        report = edits.split(store, mug)
        assert {frozenset(members(store, n)) for n in report.ids} == parts
        edits.merge(store, *report.ids)
        assert len(store.instances.all()) == len(PIECES) - 1, "the last word wins"


def test_labels_follow_what_they_were_given_to(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        mug, twin = at(store, MUG), at(store, TWIN)
        edits.label(store, mug, "ann's mug")
        edits.label(store, twin, "  bob's\n mug ")
        assert store.instances.get(twin).label == "bob's mug"
        edits.merge(store, mug, twin)
        assert store.instances.get(mug).label == "bob's mug", "the last word wins"
        add(store, chunk(3, PIECES))
        assert store.instances.get(mug).label == "bob's mug"
        edits.undo(store)
        assert (store.instances.get(mug).label, store.instances.get(twin).label) == ("ann's mug", "bob's mug")
        edits.undo(store)
        assert (store.instances.get(mug).label, store.instances.get(twin).label) == ("ann's mug", None)
        edits.label(store, mug, "")
        assert store.instances.get(mug).label is None
        for bad in ("x" * 201, "a\x07b"):
            with pytest.raises(OptionError):
                edits.label(store, mug, bad)


def test_what_was_deleted_stays_away_and_comes_back_under_its_id(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        mug = at(store, MUG)
        seen, others = members(store, mug), {n: m for n, m in partition(store).items() if n != mug}
        entry = edits.delete(store, mug).entry
        assert mug not in partition(store)
        add(store, chunk(3, PIECES))
        assert len(store.instances.all()) == len(PIECES) - 1
        assert all(members(store, n) >= m for n, m in others.items())
        with pytest.raises(UnknownIdError, match=f"was deleted.*undo .*{entry}"):
            edits.label(store, mug, "mug")
        report = edits.undo(store)
        assert report.restored == (mug,) and members(store, mug) > seen


def test_a_decision_of_the_log_can_be_undone_and_the_undo_too(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        before = partition(store)
        entry = next(e for e in merge_log(store, at(store, CHAIR)) if e.decision.kind == "merge")
        report = edits.undo(store, entry.entry)
        a, b = (tuple(int(x) for x in name.split(":")) for name in (entry.decision.a, entry.decision.b))
        home = {key: n for n, keys in partition(store).items() for key in keys}
        assert home[a] != home[b] and len(report.new) == 1
        with pytest.raises(OptionError, match="no longer applies"):
            edits.undo(store, entry.entry)
        edits.undo(store)
        assert partition(store) == before


def test_edits_do_not_change_what_they_do_not_speak_of(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        before = content(store)
        edits.merge(store, at(store, MUG), at(store, TWIN))
        edits.undo(store)
        after = content(store)
        for was, now in zip(before[:4], after[:4], strict=True):
            assert was == now


@pytest.mark.parametrize(
    "verb",
    [
        lambda s: edits.merge(s, 1, 99),
        lambda s: edits.merge(s, 1, 1),
        lambda s: edits.split(s, 99),
        lambda s: edits.split(s, 1, [(9, 9)]),
        lambda s: edits.split(s, 1, []),
        lambda s: edits.label(s, 10**30, "x"),
        lambda s: edits.delete(s, -1),
        lambda s: edits.delete(s, 1, author="a\udc80"),
        lambda s: edits.label(s, 1, "\ud800"),
        lambda s: edits.undo(s),
        lambda s: edits.undo(s, 10**30),
    ],
)
def test_edits_that_make_no_sense_change_nothing(path: Path, verb: object) -> None:
    with Store.open(path, writable=True) as store:
        before = (content(store), store.edits.all(), store.merges.all())
        with pytest.raises(List3rError) as error:
            verb(store)  # type: ignore[operator]
        assert "\n" not in str(error.value)
        assert (content(store), store.edits.all(), store.merges.all()) == before


def test_things_that_no_chunk_of_the_file_shows_can_be_named_but_not_regrouped(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        with store.transaction():
            store.instances.put(
                [instance(1, (0, 0, 0), (1, 1, 1), (9, 9, 9)), instance(2, (3, 0, 0), (1, 1, 1), (9, 9, 9))]
            )
        edits.label(store, 1, "cube")
        assert store.instances.get(1).label == "cube"
        for verb in (lambda: edits.merge(store, 1, 2), lambda: edits.split(store, 1), lambda: edits.delete(store, 1)):
            with pytest.raises(OptionError):
                verb()
        edits.undo(store)
        assert store.instances.get(1).label is None and len(store.instances.all()) == 2


def test_things_of_parts_that_were_never_joined_are_not_merged(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        add(store, chunk(0, [CHAIR]))
        add(store, chunk(1, [CHAIR], step=500), placed=Sim3.exp([9.0, 0, 0, 0, 0, 0, 0]), component=2)
        with pytest.raises(OptionError, match="never joined"):
            edits.merge(store, 1, 2)


def test_the_face_for_python_edits_only_what_is_open_for_writing(path: Path) -> None:
    with list3r.open(path) as memory:
        with pytest.raises(MemoryFileError, match="writable=True"):
            memory.delete(1)
        assert memory.merges()
    with list3r.open(path, writable=True) as memory:
        with pytest.raises(MemoryFileError, match="written by"):
            list3r.open(path, writable=True)
        memory.label(1, "first")
        memory.merge(1, 2)
        assert memory.instance(2).label == "first"
        memory.split(1)
        memory.undo()
        memory.delete(1)
        assert [e.kind for e in memory.store.edits.all()] == ["label", "merge", "split", "undo", "delete"]


def test_the_commands(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = str(path)
    assert run(["edit", "label", name, "1", "my table", "--author", "ann"]) == 0
    assert run(["edit", "merge", name, "2", "3", "--json"]) == 0
    assert '"kind": "merge"' in capsys.readouterr().out
    assert run(["edit", "split", name, "4", "--out", "1:x"]) == 2
    assert run(["edit", "delete", name, "99"]) == 2
    assert run(["edit", "undo", name, "9999"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 3
    assert run(["edit", "undo", name]) == 0
    assert "#3 is back" in capsys.readouterr().out
    assert run(["edit", "log", name]) == 0
    out = capsys.readouterr().out
    assert "edit merge (undone)" in out and "score" in out and "ann named" in out
    assert run(["edit", "log", name, "1", "--json"]) == 0
    assert '"author": "ann"' in capsys.readouterr().out
    assert run(["edit", "split", name, "4"]) == 0
    assert run(["edit", "delete", name, "4"]) == 0
    assert run(["verify", name]) == 0


def test_a_file_that_another_writes_or_that_is_read_only_gives_one_line(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Store.open(path, writable=True):
        assert run(["edit", "label", str(path), "1", "x"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    if os.geteuid() != 0:
        path.chmod(0o444)
        assert run(["edit", "label", str(path), "1", "x"]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_damaged_edit_is_named(path: Path) -> None:
    with Store.open(path, writable=True) as store:
        edits.merge(store, 1, 2)
    for damage in ('{"parts": [[[1, 0]]]}', "[1", '{"parts": 3, "through": 1, "before": []}'):
        with sqlite3.connect(path) as database:
            database.execute("UPDATE edits SET arguments = ?", (damage,))
        database.close()
        with Store.open(path) as store, pytest.raises(MemoryFileError, match=r"damaged \(.*repair"):
            store.edits.all()

"""Scraps: kept by chunks, not listed, shown to who asks how sure instances are; nothing else is derived from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.records import FIRST_SCRAP, FIRST_UNLISTED, ChunkResult, LocalInstance
from list3r.memory.library.maintenance.unlisted import derive_segments, derive_unlisted
from list3r.memory.store.store import Store
from tests.memory_scenes import BOX, CHAIR, FLOOR, MAGAZINE, MUG, TABLE, Piece
from tests.test_consolidation import add, chunk, content, create, local

LISTED = [FLOOR, TABLE, BOX, CHAIR]


def with_scraps(index: int, things: Sequence[Piece], scraps: Sequence[Piece], whole: float = 0.3) -> ChunkResult:
    """Chunk `index` in which only the first pieces are sure enough to be listed."""
    result = chunk(index, list(things))
    first, start = len(result.library.instances), int(result.frame_indices[0])
    found: list[LocalInstance] = []
    for n, piece in enumerate(scraps):
        found.append(replace(local(first + n, piece, index, start, np.zeros(3)), stability=whole))
    return replace(result, library=replace(result.library, scraps=tuple(found)))


def build(path: Path, chunks: Sequence[ChunkResult]) -> Path:
    with create(path) as store:
        for result in chunks:
            add(store, result)
    return path


def test_what_is_listed_does_not_depend_on_scraps(tmp_path: Path) -> None:
    chunks = [with_scraps(k, LISTED, [MUG, MAGAZINE]) for k in range(3)]
    plain = [replace(c, library=replace(c.library, scraps=())) for c in chunks]
    with (
        Store.open(build(tmp_path / "with.l3r", chunks)) as one,
        Store.open(build(tmp_path / "none.l3r", plain)) as two,
    ):
        assert content(one) == content(two)
        assert one.verify() == [] and len(derive_segments(one)) == 2 and derive_segments(two) == []


def test_scraps_of_several_chunks_are_one_and_bear_a_lasting_id(tmp_path: Path) -> None:
    chunks = [with_scraps(k, LISTED, [MUG], whole=0.2 + 0.1 * k) for k in range(3)]
    first = build(tmp_path / "one.l3r", chunks[:1])
    with Store.open(first) as store:
        (before,) = derive_segments(store)
    with Store.open(build(tmp_path / "all.l3r", chunks)) as store:
        (scrap,) = derive_segments(store)
    assert scrap.instance.id == before.instance.id == FIRST_SCRAP and len(scrap.members) == 3
    assert scrap.instance.confidence == pytest.approx(0.3) and before.instance.confidence == pytest.approx(0.2)
    assert np.allclose(scrap.instance.center, MUG.center, atol=0.03)


def test_a_scrap_of_one_chunk_that_is_a_thing_of_another_is_that_thing(tmp_path: Path) -> None:
    chunks = [with_scraps(0, LISTED, [MUG]), chunk(1, [*LISTED, MUG]), chunk(2, [*LISTED, MUG])]
    with Store.open(build(tmp_path / "m.l3r", chunks)) as store:
        near = [i for i in store.instances.all() if np.allclose(i.center, MUG.center, atol=0.03)]
        assert len(near) == 1 and derive_segments(store) == []


def test_every_question_can_be_asked_of_scraps_too(tmp_path: Path) -> None:
    path = build(tmp_path / "m.l3r", [with_scraps(k, LISTED, [MUG]) for k in range(2)])
    with list3r.open(path) as plain, list3r.open(path, min_confidence=0.25) as more:
        assert [i.id for i in plain.instances(structure=None)] == [i.id for i in more.instances(structure=None)][:-1]
        scrap = more.instances()[-1]
        assert scrap.id == FIRST_SCRAP and more.nearest(MUG.center, k=1)[0].instance.id == scrap.id
        assert plain.nearest(MUG.center, k=1)[0].instance.id != scrap.id
        assert len(more.support(scrap.id).points) > 0 and more.seen(scrap.id).frames
        assert more.relations() == plain.relations() and more.relations_of(scrap.id) == []
        assert [m.instance.id for m in more.similar(scrap.id, k=1)] != []
        more.export("json", tmp_path / "more.json")
        with pytest.raises(UnknownIdError):
            plain.instance(scrap.id)
    with list3r.open(path, min_confidence=0.35) as surer:
        assert all(i.confidence >= 0.35 and i.id < FIRST_SCRAP for i in surer.instances(structure=None))
    assert f'"id": {FIRST_SCRAP}' in (tmp_path / "more.json").read_text()


def test_what_is_too_unsure_to_be_listed_is_there_for_who_asks(tmp_path: Path) -> None:
    chunks = [with_unsure_mug(k) for k in range(3)]
    path = build(tmp_path / "m.l3r", chunks)
    with list3r.open(path) as plain, list3r.open(path, min_confidence=0.0) as more:
        listed = {i.id for i in plain.instances(structure=None)}
        (unsure,) = (i for i in more.instances(structure=None) if i.id not in listed)
        assert unsure.id >= FIRST_UNLISTED and unsure.confidence < 0.3
        assert np.allclose(unsure.center, MUG.center, atol=0.03)
        assert more.nearest(MUG.center, k=1)[0].instance.id == unsure.id and more.relations() == plain.relations()
        assert len(more.seen(unsure.id).frames) and len(more.support(unsure.id).points)
    with Store.open(build(tmp_path / "sure.l3r", [chunk(k, LISTED) for k in range(3)])) as store:
        assert derive_unlisted(store) == []


def with_unsure_mug(index: int) -> ChunkResult:
    """Chunk `index` in which discovery is hardly sure of the mug."""
    result = chunk(index, [*LISTED, MUG])
    found = result.library.instances
    mug = min(found, key=lambda i: float(np.linalg.norm(i.support.points.mean(axis=0) - MUG.center)))
    told = [replace(i, stability=0.001) if i is mug else i for i in found]
    return replace(result, library=replace(result.library, instances=tuple(told)))


def test_a_memory_with_its_scraps_can_only_be_read(tmp_path: Path) -> None:
    path = build(tmp_path / "m.l3r", [with_scraps(0, LISTED, [MUG])])
    with pytest.raises(OptionError, match="only be read"):
        list3r.open(path, writable=True, min_confidence=0.2)
    with pytest.raises(OptionError, match="between 0 and 1"):
        list3r.open(path, min_confidence=1.5)


def test_a_list_of_nothing_says_how_many_are_doubtful(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = build(tmp_path / "m.l3r", [with_scraps(k, [FLOOR], [MUG]) for k in range(2)])
    assert run(["list", str(path)]) == 0
    said = capsys.readouterr()
    assert said.out == "nothing found\n" and said.err.startswith("1 doubtful instance")
    assert run(["list", str(path), "--json"]) == 0 and not capsys.readouterr().err

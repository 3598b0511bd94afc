"""Settings: all that decides a result can be given, is plain JSON, and comes back as it was."""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.settings import from_plain, stored_settings
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings, settings_of
from list3r.memory.store.rows.codec import to_json
from list3r.memory.store.store import Store
from list3r.pipeline.settings import AssociationSettings, BuildSettings, session_settings


def leaves(settings: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    for f in fields(settings):
        value = getattr(settings, f.name)
        yield from leaves(value, (*path, f.name)) if is_dataclass(value) else [((*path, f.name), value)]


def changed(settings: Any, path: tuple[str, ...], to: object) -> Any:
    name, *rest = path
    return replace(settings, **{name: changed(getattr(settings, name), tuple(rest), to) if rest else to})


def other(value: object) -> object:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + type(value)(1)
    if isinstance(value, tuple):
        return (*map(other, value),)
    return "another"


def again(settings: BuildSettings) -> BuildSettings:
    return from_plain(BuildSettings, json.loads(to_json(settings.as_plain())))


def test_every_number_of_every_stage_survives_the_way_through_json() -> None:
    """One number of every stage at a time, so that none can come back in the place of another of its stage."""
    default = BuildSettings()
    assert again(default) == default and hash(again(default)) == hash(default)
    stages: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for path, value in leaves(default):
        if value is not None and value != ():
            stages.setdefault(path[:-1], []).append(path)
    values = dict(leaves(default))
    tried = 0
    for turn in zip_longest(*stages.values()):
        made, paths = default, []
        for path in turn:
            if path is not None:
                with suppress(Exception):  # a value that the stage itself refuses
                    made = changed(made, path, other(values[path]))
                    paths.append(path)
        found = dict(leaves(made))
        assert [path for path, value in leaves(default) if found[path] != value] == sorted(paths, key=list(found).index)
        back = again(made)
        assert back == made, [path for path, value in leaves(back) if found[path] != value]
        assert set(made.differing(default)) == {path[0] for path in paths}
        tried += len(paths)
    assert tried > 500


def test_what_is_not_there_is_as_by_default_and_what_nobody_knows_is_left_out() -> None:
    assert from_plain(BuildSettings, {}) == BuildSettings()
    found = from_plain(BuildSettings, {"chunks": {"length": 40, "overlap": 12}, "gone": 1, "models": {"gone": {}}})
    assert found.chunks.length == 40 and found.models == BuildSettings().models


@pytest.mark.parametrize(
    "plain", [[], {"chunks": 3}, {"chunks": {"length": "many"}}, {"depth_every": True}, {"chunks": {"length": 0}}]
)
def test_what_does_not_fit_is_refused(plain: Any) -> None:
    with pytest.raises(ValueError):
        from_plain(BuildSettings, plain)


def test_a_memory_is_derived_by_the_settings_of_its_first_session(tmp_path: Path) -> None:
    first = BuildSettings(library=ConsolidationSettings(redundancy=RedundancySettings(chunks=3)))
    with Store.create(tmp_path / "m.l3r") as store:
        with store.transaction():
            for number, settings in enumerate((first, BuildSettings())):
                store.sessions.complete(store.sessions.add("walk", str(number), settings.as_plain(), 3))
        assert settings_of(store, None).redundancy.chunks == 3
        assert [session_settings(s) for s in store.sessions.all()] == [first, BuildSettings()]


def test_settings_that_cannot_be_read_are_one_line(tmp_path: Path) -> None:
    with Store.create(tmp_path / "m.l3r") as store:
        with store.transaction():
            store.sessions.add("walk", "", {"association": {"solved_whole": "all"}}, 3)
        with pytest.raises(MemoryFileError, match="'all' is not a whole number"):
            stored_settings(store, AssociationSettings, "association")
        with pytest.raises(MemoryFileError, match="session 1"):
            session_settings(store.sessions.all()[0])

"""update through the real program: a second walk is placed in the first one's world, and errors name the fix."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.frames.chunking.chunks import ChunkSettings
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import OptionError, TrackingError
from list3r.memory.store.store import Store
from list3r.pipeline.reports import ties
from list3r.pipeline.request import RunOptions, Watch
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.update import update
from list3r.simulation.dataset import WalkSettings, write_walk

SETTINGS = BuildSettings(poses="estimate", chunks=ChunkSettings(length=24, overlap=8))


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two walks through one room, of which the second starts elsewhere."""
    folder = tmp_path_factory.mktemp("walks")
    first = WalkSettings(seed=3, frames=30, size=(192, 144))
    second = WalkSettings(seed=3, walk_seed=77, frames=22, start=8, size=(192, 144))
    return write_walk(folder / "first", first), write_walk(folder / "second", second)


@pytest.fixture(scope="module")
def one(walks: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The memory of the first walk."""
    path = tmp_path_factory.mktemp("memory") / "one.l3r"
    list3r.build(walks[0], path, settings=SETTINGS, workers=0).close()
    return path


@pytest.fixture(scope="module")
def two(one: Path, walks: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The memory of both."""
    path = tmp_path_factory.mktemp("memory") / "two.l3r"
    shutil.copy(one, path)
    report = update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0))
    assert report.placed == report.chunks
    assert report.ties > 0
    assert report.session == 2
    assert report.posed > 18
    return path


def interrupt(path: Path, walk: Path) -> None:
    """An update that is stopped after its first chunk."""

    def stop(done: int, _: int) -> None:
        if done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update(path, walk, settings=SETTINGS, run=RunOptions(workers=0), watch=Watch(stop))


@pytest.mark.slow
def test_the_second_session_lies_in_the_world_of_the_first(two: Path, one: Path) -> None:
    with Store.open(two) as store, Store.open(one) as before:
        assert {c.component for c in store.chunks.all()} == {store.chunks.all()[0].component}
        first, was = store.chunks.all()[0].S_world_chunk, before.chunks.all()[0].S_world_chunk
        np.testing.assert_allclose(first.as_matrix(), was.as_matrix(), atol=0.02)
        assert ties(store, 2)
        assert [s.state for s in store.sessions.all()] == ["complete", "complete"]
        assert store.verify() == []


def test_ids_of_the_first_session_live_on_and_nothing_is_said_to_have_changed(two: Path, one: Path) -> None:
    with Store.open(two) as store, Store.open(one) as before:
        for instance in before.instances.all(structure=False):
            store.ids.resolve(instance.id)
        assert [e for e in store.events.all(2) if e.kind in ("removed", "moved")] == []
        assert any(e.kind == "seen_again" for e in store.events.all(2))


def test_a_video_that_is_in_the_memory_already_is_refused(two: Path, walks: tuple[Path, Path]) -> None:
    for walk in walks:
        with pytest.raises(OptionError, match="already, as session"):
            update(two, walk, settings=SETTINGS)


def test_an_interrupted_build_or_update_is_finished_first(tmp_path: Path, walks: tuple[Path, Path]) -> None:
    path = tmp_path / "begun.l3r"
    info = open_source(walks[0]).info
    with Store.create(path) as store, store.transaction():
        store.sessions.add(str(walks[0]), info.fingerprint, {}, 30)
    with pytest.raises(OptionError, match="holds no video yet"):
        update(path, walks[1], settings=SETTINGS)


def test_the_program_says_in_one_line_what_is_wrong(
    tmp_path: Path, walks: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["update", str(tmp_path / "none.l3r"), str(walks[1])]) == 2
    assert run(["update", str(tmp_path / "none.l3r"), str(tmp_path / "nowhere")]) == 2
    assert run(["changes", str(tmp_path / "none.l3r")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 3
    assert all(line.startswith("error: ") for line in lines)


@pytest.mark.slow
def test_an_interrupted_update_goes_on_to_the_same_memory(
    one: Path, two: Path, walks: tuple[Path, Path], tmp_path: Path
) -> None:
    path = tmp_path / "resumed.l3r"
    shutil.copy(one, path)

    interrupt(path, walks[1])
    with Store.open(path) as store, Store.open(one) as before:
        assert [i.id for i in store.instances.all()] == [i.id for i in before.instances.all()]
        assert store.events.all() == []
    with pytest.raises(OptionError, match="--resume"):
        update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0))
    report = update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0, resume=True))
    assert report.resumed_chunks == 1
    again = update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0, resume=True))
    assert again.events == report.events and again.session == report.session
    with Store.open(path) as store, Store.open(two) as whole:
        assert [(e.instance_id, e.kind) for e in store.events.all()] == [
            (e.instance_id, e.kind) for e in whole.events.all()
        ]
        assert [i.id for i in store.instances.all()] == [i.id for i in whole.instances.all()]
        assert store.verify() == []


@pytest.mark.slow
def test_an_interrupted_update_can_be_given_up(one: Path, walks: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "given-up.l3r"
    shutil.copy(one, path)

    interrupt(path, walks[1])
    with Store.open(path) as store:
        assert len(store.sessions.all()) == 2 and store.chunks.all(2)
    with pytest.raises(OptionError, match="give it up with --force"):
        update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0))
    report = update(path, walks[1], settings=SETTINGS, run=RunOptions(workers=0, force=True))
    assert report.resumed_chunks == 0 and report.session == 2
    with Store.open(path) as store:
        assert len(store.sessions.all()) == 2 and store.verify() == []


@pytest.mark.slow
def test_a_video_in_which_no_camera_is_placed_leaves_the_memory_as_it_was(one: Path, tmp_path: Path) -> None:
    path, black = tmp_path / "as-it-was.l3r", tmp_path / "black"
    shutil.copy(one, path)
    black.mkdir()
    for n in range(12):
        cv2.imwrite(str(black / f"{n:06d}.png"), np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(TrackingError, match=r"in any frame of .*; the memory is as it was"):
        update(
            path,
            black,
            settings=SETTINGS,
            run=RunOptions(workers=0),
            options=SourceOptions(intrinsics=(130.0, 130.0, 80.0, 60.0)),
        )
    assert run(["update", str(path), str(black), "--intrinsics", "130,130,80,60"]) == 2
    with Store.open(path) as store, Store.open(one) as before:
        assert [s.session_id for s in store.sessions.all()] == [1] and store.verify() == []
        assert len(store.chunks.all()) == len(before.chunks.all()) and len(store.frames.all()) == len(
            before.frames.all()
        )
        assert [(i.id, i.center.tolist()) for i in store.instances.all()] == [
            (i.id, i.center.tolist()) for i in before.instances.all()
        ]


def test_a_session_whose_poses_are_given_is_placed_in_the_world_of_the_first(
    one: Path, walks: tuple[Path, Path], tmp_path: Path
) -> None:
    path = tmp_path / "given.l3r"
    shutil.copy(one, path)
    settings = BuildSettings(poses="given", chunks=SETTINGS.chunks)
    report = update(path, walks[1], settings=settings, run=RunOptions(workers=0))
    assert report.placed == report.chunks
    assert report.posed == report.frames
    with Store.open(path) as store:
        assert {c.component for c in store.chunks.all()} == {store.chunks.all()[0].component}
        assert [e for e in store.events.all(2) if e.kind in ("removed", "moved")] == []

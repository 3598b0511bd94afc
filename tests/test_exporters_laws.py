"""What holds for every format of the registry, so also for one that is added to it."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import list3r
from list3r.api import SceneMemory
from list3r.exporters.registry import FORMATS
from list3r.memory.core.errors import ExportError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Observation
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, instance, local_instance, small_picture
from tests.test_exporters import installed

ALL = [
    pytest.param(name, marks=pytest.mark.skipif(not installed(form.package), reason=f"{form.package} is not installed"))
    for name, form in FORMATS.items()
]
LABEL = 'écran 椅子 كوب 🪴 <b> & "c", \\ #'


def place_of(name: str, folder: Path) -> Path:
    """Where a format is written to."""
    return folder / ("out" if FORMATS[name].folder else f"out{FORMATS[name].suffixes[0]}")


def held(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An empty folder."""
    (tmp_path / "out").mkdir()
    return tmp_path / "out"


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SceneMemory]:
    """One instance, its name in several scripts with signs that formats have a use for."""
    path = tmp_path_factory.mktemp("laws") / "one.l3r"
    with Store.create(path) as store, store.transaction():
        points = box_points((1.0, 0.0, 0.5), (0.3, 0.3, 0.3), 60, 0)
        local = local_instance(0, points, (200, 80, 40), np.arange(3))
        chunk = store.chunks.add(
            store.sessions.add("walk", "a", {}, 20), chunk_result(0, 0, 20, (local,), small_picture())
        )
        store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
        store.facts.scale_kind, store.facts.gravity = "metric", "known"
        store.instances.put([instance(1, (1.0, 0.0, 0.5), (0.3, 0.3, 0.3), (200, 80, 40), label=LABEL)])
        store.observations.set([Observation(1, chunk, 0)])
    with list3r.open(path) as memory:
        yield memory


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_an_empty_memory_gives_whole_files(name: str, out: Path, tmp_path: Path) -> None:
    with Store.create(tmp_path / "empty.l3r") as store, store.transaction():
        store.facts.scale_kind = "metric"
    with list3r.open(tmp_path / "empty.l3r") as memory:
        written = memory.export(name, place_of(name, out))
    assert written and {p.relative_to(out).as_posix() for p in written} == set(held(out))
    assert all(held(out).values()) or FORMATS[name].folder


@pytest.mark.parametrize("name", ALL)
def test_one_instance_with_a_name_in_any_script(name: str, single: SceneMemory, out: Path) -> None:
    written = single.export(name, place_of(name, out))
    assert {p.relative_to(out).as_posix() for p in written} == set(held(out))
    assert all(p.name.isascii() for p in written)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_an_export_replaces_its_like_and_nothing_else(name: str, single: SceneMemory, out: Path) -> None:
    place = place_of(name, out)
    single.export(name, place)
    first = set(held(out))
    single.export(name, place)
    assert set(held(out)) == first
    other = out / "mine"
    if FORMATS[name].folder:
        (other).mkdir()
        (other / "letter.txt").write_text("keep")
        (out / "file").write_text("keep")
        with pytest.raises(ExportError, match="is a file; name a folder"):
            single.export(name, out / "file")
        with pytest.raises(ExportError, match="holds other files"):
            single.export(name, other)
        assert (other / "letter.txt").read_text() == (out / "file").read_text() == "keep"
    else:
        wrong = place.with_stem("folder")
        wrong.mkdir()
        with pytest.raises(ExportError, match="is a folder; name a file"):
            single.export(name, wrong)
        assert not list(wrong.iterdir())


@pytest.mark.parametrize("name", ALL)
def test_a_place_that_cannot_be_written_is_one_line(name: str, single: SceneMemory, out: Path) -> None:
    (out / "file").write_text("mine")
    places = [out / "absent", out / "file", *([Path("/proc")] if Path("/proc/self").exists() else [])]
    for folder in places:
        with pytest.raises(ExportError, match=r"create it first|cannot be written|not writable") as caught:
            single.export(name, place_of(name, folder))
        assert "\n" not in str(caught.value)
    assert held(out) == {"file": b"mine"}


MOMENTS = (0.4, 0.97)
"""At which an export is interrupted: shares of the calls that it makes."""


class Interruption:
    """A real signal to this process at a call of the exporters, or within one; with no signal calls are counted."""

    def __init__(self, at: int, number: int) -> None:
        self.at, self.number, self.calls = at, number, 0

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        if event in ("call", "c_call") and "list3r/exporters" in frame.f_code.co_filename:
            self.calls += 1
            if self.calls == self.at:
                os.kill(os.getpid(), self.number)


def export_in_a_process(memory: Path, name: str, place: Path, interruption: Interruption) -> tuple[int, int]:
    """Export in a process of its own. Returns the signal that ended it (SIGINT: was obeyed), and its calls."""
    told, tells = os.pipe()
    child = os.fork()
    if child == 0:  # what is raised here must not come back to pytest
        signal.signal(signal.SIGINT, signal.default_int_handler)
        ended = 0
        try:
            with list3r.open(memory) as scene:
                sys.setprofile(interruption)
                scene.export(name, place)
        except KeyboardInterrupt:
            ended = signal.SIGINT
        except BaseException:
            traceback.print_exc()
            ended = 99
        sys.setprofile(None)
        os.write(tells, str(interruption.calls).encode())
        os._exit(ended)
    os.close(tells)
    with os.fdopen(told) as pipe:
        calls = pipe.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return abs(status), int(calls or 0)


PLACES = [
    pytest.param(name, suffix, marks=pytest.mark.skipif(not installed(form.package), reason=f"no {form.package}"))
    for name, form in FORMATS.items()
    for suffix in form.suffixes or ("",)
]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are copied")
@pytest.mark.parametrize(("name", "suffix"), PLACES)
def test_an_export_that_is_interrupted_or_killed_leaves_whole_files(
    name: str, suffix: str, single: SceneMemory, out: Path, tmp_path: Path
) -> None:
    for module in (f"list3r.exporters.{FORMATS[name].module}", *filter(None, [FORMATS[name].package])):
        importlib.import_module(module)  # once, not in every process

    def export(folder: Path, at: int = -1, number: int = 0) -> tuple[int, int]:
        return export_in_a_process(single.path, name, folder / f"out{suffix}", Interruption(at, number))

    ended, calls = export(out)
    whole = held(out)
    assert ended == 0 and whole
    (tmp_path / "new").mkdir()
    for number in (signal.SIGINT, signal.SIGKILL):
        for folder in (tmp_path / "new", out):  # where nothing stands, and where the whole stands
            for moment in MOMENTS:
                ended, _ = export(folder, 1 + int(moment * calls), number)
                assert ended in (number, 0)
                found = {file: content for file, content in held(folder).items() if not file.startswith(".")}
                if name != "rerun":  # which numbers its parts at random
                    assert all(whole[file] == content for file, content in found.items())
                if FORMATS[name].folder:
                    assert not found or set(found) == set(whole)
                if number == signal.SIGINT:
                    assert len(found) == len(held(folder)), "and nothing beside it"
                if folder == out:
                    assert FORMATS[name].folder or set(found) == set(whole)
    for folder in (tmp_path / "new", out):  # what a killed export has left, the next one takes away
        assert export(folder)[0] == 0
        assert set(held(folder)) == set(whole)


LIMITED = """
import resource, shutil, sys
from pathlib import Path
import list3r
from list3r.exporters.registry import FORMATS
from list3r.memory.core.errors import ExportError
folder = Path(sys.argv[2])
with list3r.open(sys.argv[1]) as memory:
    for name in sys.argv[3:]:
        path = folder / ("out" if FORMATS[name].folder else f"out{FORMATS[name].suffixes[0]}")
        if not FORMATS[name].folder:
            path.write_text("old")
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
        try:
            memory.export(name, path)
        except ExportError as error:
            assert "\\n" not in str(error) and "cannot be written" in str(error), error
        else:
            raise AssertionError(name)
        left = [(p.name, p.read_text()) for p in folder.iterdir()]
        assert left == ([] if FORMATS[name].folder else [(path.name, "old")]), (name, left)
        path.unlink(missing_ok=True)
"""
"""Every format against a disk that takes 100 bytes of a file."""


@pytest.mark.slow
def test_a_full_disk_leaves_what_was_there(single: SceneMemory, out: Path) -> None:
    pytest.importorskip("resource")
    names = [name for name, form in FORMATS.items() if name != "rerun" and installed(form.package)]
    command = [sys.executable, "-c", LIMITED, single.path, out, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

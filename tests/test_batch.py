"""Many videos: what is done is done once, a bad video fails alone, and every engine makes the same bytes."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from list3r.batch.engines.base import TaskResources
from list3r.batch.engines.choice import make_engine
from list3r.batch.engines.local import LocalEngine
from list3r.batch.ledger import Ledger
from list3r.batch.runner import BatchReport, BatchSettings, run_batch, run_here
from list3r.batch.sealing import batch_keys, file_hash, seal
from list3r.batch.storage import Output, fetched, listing
from list3r.batch.tasks import Asked, BatchTask, read_tasks
from list3r.batch.work import BatchJob, Outcome, run_task
from list3r.cli.app import run as list3r
from list3r.cli.build.source_options import SourceArguments
from list3r.memory.core.errors import List3rError, MemoryFileError, OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.pipeline.build import build
from list3r.pipeline.request import BuildRequest, RunOptions
from list3r.pipeline.workers import TaskPool, WorkerError
from list3r.pipeline.workers.ray_pool import RayPool
from list3r.simulation.dataset import WalkSettings, write_walk

ASKED = Asked(lambda fields: replace(SourceArguments(), **fields).options())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short walk, a file that is no video, and a manifest with two parts of the walk and that file."""
    root = tmp_path_factory.mktemp("batch")
    write_walk(root / "walk", WalkSettings(seed=1, frames=6, size=(128, 96)))
    (root / "poisoned.mp4").write_bytes(b"no video")
    lines = [{"source": "walk", "memory": name, "frames": part} for name, part in (("a", "0:4"), ("b", "2:6"))]
    text = "\n".join(["# three tasks", *map(json.dumps, lines), "", "poisoned.mp4"])
    (root / "videos.jsonl").write_text(text)
    return root


@pytest.fixture(scope="module")
def built(folder: Path) -> tuple[Path, BatchReport]:
    """The batch of the manifest, done by two processes."""
    out = folder / "memories"
    groups = read_tasks(str(folder / "videos.jsonl"), ASKED)
    return out, run_batch(groups, LocalEngine(TaskResources(), jobs=2), BatchSettings(str(out)))


class Here:
    """Does tasks in this process; the first attempts are lost before they begin."""

    window = 2

    def __init__(self, lost: int = 0) -> None:
        self.lost = lost
        self.jobs: list[BatchJob] = []
        self.cancelled = False

    def submit(self, job: BatchJob) -> None:
        self.jobs.append(job)
        assert len(self.jobs) <= self.window

    def as_completed(self) -> Iterator[Outcome]:
        while self.jobs:
            job = self.jobs.pop(0)
            self.lost -= 1
            yield run_task(job) if self.lost < 0 else Outcome(job.task, "lost", "ended from outside")

    def cancel(self) -> None:
        self.cancelled = True


def test_a_bad_video_fails_alone_with_its_reason(built: tuple[Path, BatchReport]) -> None:
    out, report = built
    assert (report.done, report.built, report.failed) == (2, 2, 1)
    states = {r.memory: (r.state, r.attempts) for r in report.tasks}
    assert states == {"a": ("done", 1), "b": ("done", 1), "poisoned": ("failed", 1)}
    assert "poisoned.mp4" in next(r.reason for r in report.tasks if r.state == "failed")
    assert sorted(p.name for p in out.glob("*.l3r")) == ["a.l3r", "b.l3r"]
    for row in report.tasks[:2]:
        assert file_hash(out / f"{row.memory}.l3r") == row.sha256
        with Store.open(out / f"{row.memory}.l3r") as store:
            assert store.verify() == []
            assert len(store.frames.all()) == row.frames == 4
    assert [p.name for p in (out / ".work").iterdir() if p.is_dir()] == ["poisoned"]


def test_what_is_done_is_not_done_again_without_the_manifest(folder: Path, built: tuple[Path, BatchReport]) -> None:
    out, before = built
    groups = read_tasks(str(folder / "videos.jsonl"), ASKED)[:2]
    inodes = {p: p.stat().st_ino for p in out.glob("*.l3r")}
    again = run_batch(groups, engine := Here(), BatchSettings(str(out)))
    assert (again.done, again.built, again.failed, engine.cancelled) == (2, 0, 0, True)
    assert [r.attempts for r in again.tasks] == [1, 1]
    other = run_batch(groups, Here(), BatchSettings(str(out), state=folder / "other.sqlite"))
    assert (other.done, other.built) == (2, 0)
    assert [r.sha256 for r in other.tasks] == [r.sha256 for r in before.tasks[:2]]
    assert {p: p.stat().st_ino for p in out.glob("*.l3r")} == inodes


def test_other_processes_and_tries_make_the_same_bytes(
    folder: Path, built: tuple[Path, BatchReport], tmp_path: Path
) -> None:
    group = read_tasks(str(folder / "videos.jsonl"), ASKED)[0]
    settings = BatchSettings(str(tmp_path / "out"))
    report = run_batch([group], Here(lost=2), settings)
    assert (report.done, report.built, report.tasks[0].attempts) == (1, 1, 3)
    assert file_hash(tmp_path / "out" / "a.l3r") == file_hash(built[0] / "a.l3r")
    with sqlite3.connect(settings.ledger()) as database:
        assert database.execute("SELECT outcome, built FROM attempts").fetchall() == [("lost", 0)] * 2 + [("done", 1)]


def test_what_was_under_way_when_a_batch_is_interrupted_is_pending(folder: Path, tmp_path: Path) -> None:
    class Interrupted(Here):
        def as_completed(self) -> Iterator[Outcome]:
            raise KeyboardInterrupt

    settings, group = BatchSettings(str(tmp_path / "out")), read_tasks(str(folder / "videos.jsonl"), ASKED)[0]
    with pytest.raises(KeyboardInterrupt):
        run_batch([group], engine := Interrupted(), settings)
    assert engine.cancelled
    with Ledger(settings.ledger()) as ledger:
        assert [(r.state, r.attempts) for r in ledger.rows()] == [("pending", 1)]


def test_a_task_that_is_lost_too_often_fails(folder: Path, tmp_path: Path) -> None:
    group = read_tasks(str(folder / "videos.jsonl"), ASKED)[0]
    report = run_batch([group], Here(lost=9), BatchSettings(str(tmp_path / "out"), retries=1))
    assert (report.done, report.failed, report.tasks[0].attempts) == (0, 1, 2)
    assert report.tasks[0].reason == "ended from outside"


def test_a_second_video_of_a_memory_is_a_session_of_it(folder: Path, built: tuple[Path, BatchReport]) -> None:
    lines = [{"source": f"{folder}/walk", "memory": "a", "frames": "0:4"}]
    (folder / "later.jsonl").write_text(json.dumps(lines[0]) + f'\n{{"source": "{folder}/walk2", "memory": "a"}}')
    (folder / "walk2").symlink_to(folder / "walk")
    out = folder / "two"
    out.mkdir()
    (out / "a.l3r").write_bytes((built[0] / "a.l3r").read_bytes())
    group = read_tasks(str(folder / "later.jsonl"), ASKED)
    assert len(group) == 1
    report = run_batch(group, Here(), BatchSettings(str(out)))
    assert (report.done, report.built) == (2, 1)
    assert batch_keys(out / "a.l3r") == tuple(t.key for t in group[0])
    with Store.open(out / "a.l3r") as store:
        assert [s.state for s in store.sessions.all()] == ["complete"] * 2


def test_memories_of_others_are_neither_replaced_nor_added_to(folder: Path, built: tuple[Path, BatchReport]) -> None:
    (task, *_), *_ = read_tasks(str(folder / "videos.jsonl"), ASKED)
    other = replace(task, settings_hash="of something else")
    before = file_hash(built[0] / "a.l3r")
    report = run_here([other], BatchSettings(str(built[0]), scratch=folder / "s"), lambda *_: None)
    assert report.failed == 1
    assert "--force" in report.tasks[0].reason
    assert file_hash(built[0] / "a.l3r") == before


def test_videos_and_memories_may_lie_on_a_store_of_fsspec(folder: Path, built: tuple[Path, BatchReport]) -> None:
    fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed")
    store = fsspec.filesystem("memory")
    store.put(str(folder / "walk"), "/videos/walk", recursive=True)
    store.pipe_file("/videos/list.jsonl", b'{"source": "walk", "memory": "far", "frames": "0:4"}\n')
    group = read_tasks("memory://videos/list.jsonl", ASKED)[0]
    assert group[0].source == "memory://videos/walk"
    assert group[0].source_hash
    settings = BatchSettings("memory://memories", scratch=folder / "far", state=folder / "far.sqlite")
    report = run_batch([group], Here(), settings)
    assert (report.done, report.built) == (1, 1)
    Output("memory://memories").fetch("far", folder / "far.l3r")
    assert file_hash(folder / "far.l3r") == report.tasks[0].sha256
    with Store.open(folder / "far.l3r") as far, Store.open(built[0] / "a.l3r") as near:
        assert far.sessions.all()[0].source == "memory://videos/walk"
        assert [i.description for i in far.instances.all()] == [i.description for i in near.instances.all()]
    assert run_here(group, settings, lambda *_: None).built == 0
    with pytest.raises(SourceError, match=r"nothing\.mp4 cannot be fetched"):
        fetched("memory://videos/nothing.mp4", folder / "none")
    with pytest.raises(OptionError, match="cannot be reached"):
        listing("nosuchstore://a/b")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "names no video"),
        ("{", "line 1: .* write a path or a JSON object"),
        ('{"memory": "a"}', "line 1: no source"),
        ('a.mp4\n{"source": "b.mp4", "lens": 2}', "line 2: lens is not an option"),
        ('{"source": "b.mp4", "intrinsics": "1,2"}', "line 1: .*--intrinsics"),
        ("one/walk.mp4\ntwo/walk.mp4", "second video would go to walk.l3r"),
        ('{"source": "a", "memory": "../a"}', "cannot be the name of a memory"),
        ('{"source": "a", "memory": "m"}\n{"source": "a", "memory": "m"}', "named a second time"),
    ],
)
def test_a_manifest_that_makes_no_sense_is_refused_by_its_line(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "list").write_text(text)
    with pytest.raises(OptionError, match=said):
        read_tasks(str(tmp_path / "list"), ASKED)


def test_one_batch_at_a_time_holds_the_manifest(tmp_path: Path) -> None:
    path = tmp_path / "batch.sqlite"
    with Ledger(path), pytest.raises(MemoryFileError, match="being written by this process"):
        Ledger(path)
    path.write_bytes(b"something else that is long enough to be read as a file of SQLite" * 20)
    with pytest.raises(MemoryFileError, match="not the state file of a batch"):
        Ledger(path)


def test_an_array_job_runs_the_command_for_each_memory(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["batch", str(folder / "videos.jsonl"), "--out", str(folder / "x y"), "--gpus", "1", "--task-memory", "1.5"]
    monkeypatch.setattr("sys.argv", ["list3r", *words, "--print", "slurm"])
    assert list3r([*words, "--print", "slurm"]) == 0
    script = capsys.readouterr().out
    assert "#SBATCH --array=0-2\n" in script
    assert "#SBATCH --mem=1536M\n" in script
    assert f"--out '{folder}/x y' --gpus 1 --task-memory 1.5 --only \"$SLURM_ARRAY_TASK_ID\"" in script
    assert list3r([*words, "--only", "3"]) == 2
    assert list3r([*words, "--only", "2", "--json"]) == 1
    assert "poisoned" in capsys.readouterr().out
    assert not (folder / "x y" / "batch.sqlite").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"name": "dask"}, "--engine dask"),
        ({"address": "a:1"}, "--address"),
        ({"jobs": 0}, "--jobs 0"),
        ({"resources": TaskResources(memory_gb=1e9)}, "more GiB of memory than this machine has"),
    ],
)
def test_engines_say_what_they_cannot_do(words: dict[str, Any], said: str) -> None:
    with pytest.raises(List3rError, match=said):
        make_engine(**{"name": "local", "resources": TaskResources(), "jobs": None, "address": None, **words})


def _die_once(where: str) -> str:
    if where and not Path(where).exists():
        Path(where).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return where


@pytest.mark.slow
def test_a_process_that_is_killed_costs_its_own_task_alone(tmp_path: Path) -> None:
    pool = TaskPool(_die_once, 1)
    flag = str(tmp_path / "died")
    for task in (flag, ""):
        pool.submit(task)
    found: list[tuple[str, object]] = []
    for task, result in pool.as_completed():
        found.append((task, result))
        if isinstance(result, WorkerError):
            pool.submit(task)
    pool.cancel()
    assert isinstance(found[0][1], WorkerError)
    assert sorted(found[1:]) == [("", ""), (flag, flag)]  # both may have ended before they were asked for


def test_ray_makes_the_same_files(folder: Path, built: tuple[Path, BatchReport]) -> None:
    pytest.importorskip("ray", reason="ray is not installed (240 MB, ten seconds to start): pip install '.[ray]'")
    groups: list[list[BatchTask]] = read_tasks(str(folder / "videos.jsonl"), ASKED)
    engine = make_engine("ray", TaskResources(), None, None)
    report = run_batch(groups, engine, BatchSettings(str(folder / "ray")))
    assert (report.done, report.built, report.failed) == (2, 2, 1)
    for row in report.tasks[:2]:
        assert (
            file_hash(folder / "ray" / f"{row.memory}.l3r") == row.sha256 == file_hash(built[0] / f"{row.memory}.l3r")
        )


def test_chunks_of_one_video_on_ray_make_the_same_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by a path from the folder that the command was given in; what is wrong with a video is said as ever."""
    pytest.importorskip("ray", reason="ray is not installed (240 MB, ten seconds to start): pip install '.[ray]'")
    monkeypatch.chdir(folder)
    request = BuildRequest(chunk=3, overlap=1)
    hashes = set()
    for name, run in (("here", RunOptions(workers=0)), ("ray", RunOptions(engine="ray"))):
        assert build("walk", tmp_path / f"{name}.l3r", settings=request, run=run).chunks == 3
        hashes.add(seal(tmp_path / f"{name}.l3r", tmp_path / f"{name}.sealed", ("key",), "walk"))
    assert len(hashes) == 1
    pool = RayPool(_refused)
    with pool, pytest.raises(SourceError, match=r"^no such frame$"):
        list(pool.map([1]))


def _refused(task: int) -> None:
    raise SourceError("no such frame")

"""What happens to a build in the wild: ended from outside at a chosen place, unheard, through links."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import list3r
from list3r.cli.build.progress import build_interrupted
from list3r.memory.store.store import Store
from tests.conftest import write_small_room
from tests.program import in_process as run
from tests.program import with_signals
from tests.test_cli_errors import write_frames


def build_ended(walk: Path, memory: Path, end: str, *more: str, first: str = "") -> subprocess.CompletedProcess[str]:
    """A build of the real program that is ended, by the statement `end`, as its first chunk is to be added."""
    program = f"""
import os, signal, sys
import list3r.pipeline.session
{first}
from list3r.cli import main
def add_chunk(*_, **__):
    {end}
list3r.pipeline.session.add_chunk = add_chunk
sys.argv[1:] = ["build", {str(walk)!r}, "-m", {str(memory)!r}, "--poses", "given", "--workers", "0", *{more!r}]
main()
"""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, preexec_fn=with_signals)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("walk") / "a walk #1 ü", count=4)


def write_room(path: Path) -> Path:
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


@pytest.mark.slow
def test_a_build_killed_before_its_first_chunk_can_be_opened_and_resumed(walk: Path, tmp_path: Path) -> None:
    memory = tmp_path / "killed.l3r"
    assert build_ended(walk, memory, "os._exit(9)").returncode == 9
    assert run("list", memory).returncode == 0
    assert "--resume" in run("verify", memory).stdout
    judged = run("eval", "trajectory", walk, memory)
    assert judged.returncode == 2 and "--resume" in judged.stderr
    assert run("build", walk, "-m", memory, "--poses", "given", "--workers", "0", "--resume").returncode == 0
    assert [p.name for p in tmp_path.iterdir()] == ["killed.l3r"]
    with list3r.open(memory) as scene:
        assert len(scene.store.trajectory.poses()) == 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_build_that_is_told_to_end_leaves_nothing_half_written(name: str, walk: Path, tmp_path: Path) -> None:
    workers = ["--workers", "1" if name == "SIGTERM" else "0"]
    result = build_ended(walk, tmp_path / "ended.l3r", f"os.kill(os.getpid(), signal.{name}); signal.pause()", *workers)
    assert result.returncode == 1
    assert "nothing was changed" in result.stderr and "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


SIGNALLED = """
import list3r.memory.store.store as module
def signalled(name, real):
    def first(*arguments, **named):
        os.kill(os.getpid(), signal.SIGINT)
        return real(*arguments, **named)
    setattr(module.{owner}, name, first)
signalled("{name}", module.{owner}.{name})
"""


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--force"]])
@pytest.mark.parametrize("where", ["Store.close", "Connection._connect"])
def test_ctrl_c_while_a_memory_is_made_or_given_up_leaves_none(
    where: str, more: list[str], walk: Path, tmp_path: Path
) -> None:
    memory = tmp_path / "room.l3r"
    if more:
        write_room(memory)
    owner, name = where.split(".")
    first = SIGNALLED.format(owner=owner, name=name) + "import list3r.pipeline.target\n"
    result = build_ended(walk, memory, "os.kill(os.getpid(), signal.SIGINT); signal.pause()", *more, first=first)
    assert result.returncode == 1 and "nothing was changed" in result.stderr and "Traceback" not in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["room.l3r"] * len(more)
    if more:
        with list3r.open(memory) as scene:
            assert len(scene.instances(structure=None)) == 6


def test_what_is_said_of_an_interrupted_build_is_true(tmp_path: Path) -> None:
    memory = tmp_path / "room.l3r"
    said = build_interrupted(memory, False)
    assert "nothing was changed" in said(False)
    Store.create(memory).close()
    assert "nothing was changed" not in said(False) and str(memory) in said(False)
    said = build_interrupted(memory, False)
    memory.rename(tmp_path / "room.l3r.replaced")
    Store.create(memory).close()
    assert "room.l3r.replaced" in said(False)


@pytest.mark.slow
def test_an_interrupted_replacement_leaves_the_old_memory(walk: Path, tmp_path: Path) -> None:
    memory = write_room(tmp_path / "room.l3r")
    result = build_ended(walk, memory, "raise KeyboardInterrupt", "--force")
    assert result.returncode == 1 and "nothing was changed" in result.stderr
    with list3r.open(memory) as scene:
        assert len(scene.instances(structure=None)) == 6
    assert [p.name for p in tmp_path.iterdir()] == ["room.l3r"]


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--force", "--resume"])
def test_a_killed_replacement_leaves_nothing_aside_in_the_end(option: str, walk: Path, tmp_path: Path) -> None:
    memory = write_room(tmp_path / "room.l3r")
    build_ended(walk, memory, "os._exit(9)", "--force")
    assert (tmp_path / "room.l3r.replaced").exists()
    result = run("build", walk, "-m", memory, "--poses", "given", "--workers", "0", option)
    assert result.returncode == 0, result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["room.l3r"]


def test_an_old_memory_set_aside_is_put_back_where_no_new_one_came(walk: Path, tmp_path: Path) -> None:
    write_room(tmp_path / "room.l3r.replaced")
    result = run("build", walk, "-m", tmp_path / "room.l3r")
    assert result.returncode == 2 and "--force" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["room.l3r"]


def test_a_memory_behind_a_link_is_written_there(walk: Path, tmp_path: Path) -> None:
    real, link = tmp_path / "real.l3r", tmp_path / "link.l3r"
    link.symlink_to(real)
    for more in ([], ["--force"]):
        result = run("build", walk, "-m", link, "--poses", "given", "--workers", "0", *more)
        assert result.returncode == 0, result.stderr
        assert link.is_symlink() and not real.is_symlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.l3r", "real.l3r"]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["list", "info", "verify", "relations"])
def test_output_that_nobody_reads_is_no_failure(command: str, tmp_path: Path) -> None:
    memory = write_room(tmp_path / "room.l3r")
    process = subprocess.Popen(
        [sys.executable, "-m", "list3r", *command.split(), str(memory)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(timeout=60) == 0


def test_ctrl_c_in_any_command_is_said_and_is_a_failure(tmp_path: Path) -> None:
    program = """
import os, signal, sys
import list3r.api
list3r.api.SceneMemory.export = lambda *_, **__: os.kill(os.getpid(), signal.SIGINT) or signal.pause()
from list3r.cli import main
main()
"""
    out = tmp_path / "room.json"
    arguments = ["export", str(write_room(tmp_path / "room.l3r")), "--to", "json", "--out", str(out)]
    command = [sys.executable, "-c", program, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, preexec_fn=with_signals)
    assert (result.returncode, result.stdout, result.stderr.strip()) == (1, "", "interrupted")

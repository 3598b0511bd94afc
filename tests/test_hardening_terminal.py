"""What is printed is shown and not obeyed; what cannot be printed loses nothing and is said."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from list3r.cli.app import run
from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, MergeDecision
from list3r.memory.store.store import Store
from tests.conftest import write_small_room

Make = Callable[..., Path]
EVIL = "mug\x1b[2J\x1b]0;owned\x07\n9  forged  row\r\u202eleft\x9b31m"
COMMANDS = [
    ["list"],
    ["list", "--structure"],
    ["show", "2"],
    ["show", "3"],
    ["info"],
    ["info", "--loops"],
    ["merges"],
    ["verify"],
    ["find", "mug"],
    ["nearest", "3"],
    ["within", "--view", "3"],
    ["seen", "2"],
    ["relations"],
    ["path", "3", "1"],
    ["changes"],
]


def evil_memory(path: Path) -> Path:
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
        store.connection._database.execute("UPDATE instances SET label = ?, description = ?", (EVIL, EVIL))
        store.connection._database.execute("UPDATE sessions SET source = ?", (EVIL,))
        store.connection._database.execute("UPDATE relations SET predicate = predicate || ? WHERE subject = 4", (EVIL,))
        store.merges.add(1, MergeDecision("merge", EVIL, EVIL, {}, EVIL))
        store.edges.add([Edge(1, 1, "loop", Sim3.identity(), 0.5, 0.0, 0, 0.0, False, EVIL, {}, None)])
    return path


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_no_text_of_a_memory_reaches_the_terminal_raw(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = evil_memory(tmp_path / "evil\x1b[31m\nname.l3r")
    place = 2 if command[0] == "edit" else 1
    run([*command[:place], str(path), *command[place:]])
    message = capsys.readouterr()
    for text in (message.out, message.err):
        assert all(line.isprintable() for line in text.split("\n")), repr(text)
        assert not any(line.strip().startswith("9  forged") for line in text.split("\n"))


@pytest.mark.parametrize(("to", "ending"), [("plan", ".png"), ("usd", ".usda"), ("json", ".json"), ("csv", ".csv")])
def test_no_text_of_a_memory_breaks_an_export(to: str, ending: str, tmp_path: Path) -> None:
    path, out = evil_memory(tmp_path / "evil.l3r"), tmp_path / f"out{ending}"
    assert run(["export", str(path), "--to", to, "--out", str(out)]) == 0
    if to in ("usd", "json"):
        assert b"\x1b" not in out.read_bytes()


def test_printable_text_is_shown_as_it_is() -> None:
    assert shown("Café 杯子 🫖") == "Café 杯子 🫖"
    assert shown("a\tb\x00\udcff") == "a\\tb\\x00\\udcff"


def program(*arguments: str | Path | bytes, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "list3r", *arguments]
    return subprocess.run(  # type: ignore[call-overload,no-any-return]
        command, text=True, errors="backslashreplace", timeout=60, check=False, stdin=subprocess.DEVNULL, **options
    )


def test_letters_that_the_terminal_lacks_are_escaped(make_memory: Make) -> None:
    path = make_memory()
    assert run(["edit", "label", str(path), "2", "Café"]) == 0
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    for command in (["list", path], ["find", path, "Café"]):
        message = program(*command, env=environment, capture_output=True)
        assert message.returncode == 0 and "Caf\\xe9" in message.stdout, message.stderr


def test_a_path_that_is_no_text_is_refused_in_one_line(make_memory: Make, tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"r\xffom.l3r")
    with pytest.raises(MemoryFileError, match="rename it"):
        Store.create(path)
    make_memory().rename(path)
    for command in (
        ["list", path],
        ["edit", "label", path, "2", "mug"],
        ["verify", path],
        ["list", tmp_path / os.fsdecode(b"n\xff")],
    ):
        told = program(*command, capture_output=True)
        assert told.returncode == 2 and told.stderr.count("\n") == 1 and "Traceback" not in told.stderr
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
@pytest.mark.parametrize("state", ["closed", "full"])
def test_output_that_cannot_be_written_is_said_where_it_can(stream: str, state: str, make_memory: Make) -> None:
    path = make_memory()
    descriptor = 1 if stream == "stdout" else 2
    where = f"{descriptor}>&-" if state == "closed" else f"{descriptor}>/dev/full"
    command = f"{sys.executable} -m list3r edit label {path} 2 mug {where}"
    message = subprocess.run(["sh", "-c", command], text=True, capture_output=True, timeout=60, check=False)
    assert "Traceback" not in message.stderr and "Exception" not in message.stderr
    assert message.returncode == (1 if (stream, state) == ("stdout", "full") else 0)
    if message.returncode:
        assert "cannot be written" in message.stderr and "is done" in message.stderr
    with Store.open(path) as store:
        assert store.instances.get(2).label == "mug"


def test_blanks_within_a_name_make_no_column(make_memory: Make, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        store.instances.put([replace(store.instances.get(3), label="mug   9.00  9.00")])
    assert run(["list", str(path)]) == 0
    assert r"3   mug \x20\x209.00 \x209.00  " in capsys.readouterr().out


def test_a_server_without_standard_input_ends(make_memory: Make) -> None:
    pytest.importorskip("mcp")
    command = f"{sys.executable} -m list3r mcp {make_memory()} <&-"
    message = subprocess.run(["sh", "-c", command], text=True, capture_output=True, timeout=60, check=False)
    assert (message.returncode, message.stdout, message.stderr) == (0, "", "")


def test_clocks_a_day_from_greenwich_are_clocks(make_memory: Make) -> None:
    """Python has no time zone of 24 hours, which systems allow."""
    path = make_memory()
    environment = {**os.environ, "TZ": "<+24>-24"}
    for command in (["edit", "label", path, "2", "desk"], ["info", path], ["edit", "log", path], ["seen", path, "2"]):
        message = program(*command, env=environment, capture_output=True)
        assert (message.returncode, message.stderr) == (0, "")


def test_links_that_lead_to_themselves_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = tmp_path / "loop.l3r"
    loop.symlink_to(loop)
    for command in (["list", str(loop)], ["repair", str(loop)], ["build", str(tmp_path), "-m", str(loop)]):
        assert run(command) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_names_that_are_no_text_are_not_written(make_memory: Make, capsys: pytest.CaptureFixture[str]) -> None:
    path, name = make_memory(), os.fsdecode(b"w\xffalk")
    with Store.open(path, writable=True) as store, pytest.raises(OptionError, match="not valid UTF-8"):
        with store.transaction():
            store.sessions.add(name, "", {}, 4)
    assert run(["edit", "label", str(path), "2", name]) == 2 and "error: " in capsys.readouterr().err
    with Store.open(path) as store:
        assert len(store.sessions.all()) == 1 and store.verify() == []

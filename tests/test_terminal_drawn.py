"""What is drawn on a terminal, a real one of a given width. Anything else gets plain lines, as ever."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import struct
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest

from list3r.cli.app import run

fcntl = pytest.importorskip("fcntl")
pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")

Make = Callable[..., Path]
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
PLAIN = """\
id  what            centre x y z (m)      size (m)              confidence  frames  kind  state
2   [red]x[/red]      2.00   0.00   0.36    1.20   0.80   0.72  0.900       12
3   杯子杯子杯子杯子杯子杯子杯子    1.80   0.10   0.77    0.08   0.08   0.10  0.900       12
4   mug               2.20  -0.10   0.77    0.08   0.08   0.10  0.900       12
"""


def on_terminal(*command: str, width: int = 100, status: int = 0, **environment: str) -> str:
    """Return what a command writes on a terminal, escapes and all."""
    main, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 50, width, 0, 0))
    kept = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "TERM")}
    told = {**kept, "TERM": "xterm-256color", "PYTHONUTF8": "1", **environment}
    program = subprocess.Popen(command, stdin=side, stdout=side, stderr=side, env=told)
    os.close(side)
    out = b""
    with contextlib.suppress(OSError):  # the end of a terminal
        while block := os.read(main, 1 << 16):
            out += block
    os.close(main)
    assert program.wait(60) == status, out
    return out.decode().replace("\r\n", "\n")


def list3r(*words: str | Path) -> tuple[str, ...]:
    return (sys.executable, "-m", "list3r", *map(str, words))


def letters(line: str) -> int:
    """Return how wide a line is on a terminal."""
    return sum(1 + (unicodedata.east_asian_width(c) in "WF") for c in line)


@pytest.fixture
def named(make_memory: Make) -> Path:
    """A room whose table and mug have names that terminals and `rich` read otherwise."""
    path = make_memory()
    assert run(["edit", "label", str(path), "2", "[red]x[/red]"]) == 0
    assert run(["edit", "label", str(path), "3", "杯子" * 7]) == 0
    return path


def test_labels_are_drawn_as_they_are_and_columns_stand_under_each_other(named: Path) -> None:
    drawn = on_terminal(*list3r("list", named))
    head, rule, *rows = ESCAPES.sub("", drawn).splitlines()
    assert head.split()[:2] == ["id", "what"] and set(rule) == {"─"}
    assert "[red]x[/red]" in rows[0] and "杯子" * 7 in rows[1]
    assert len({letters(row) for row in rows}) == 1
    assert "kind" not in head, "a column that says nothing is left out"


def test_a_narrow_terminal_folds_words_and_keeps_numbers_whole(named: Path) -> None:
    width = 78
    _, _, *rows = ESCAPES.sub("", on_terminal(*list3r("list", named), width=width)).splitlines()
    assert max(map(letters, rows)) <= width
    assert [row.split()[0] for row in rows if row[:2].strip()] == ["2", "3", "4", "5"]
    assert all(re.search(r"\d+\.\d\d +\d+\.\d\d +\d+\.\d\d  ", row) for row in rows if row[:2].strip())
    assert "".join(re.findall("[杯子]", "".join(rows))) == "杯子" * 7


@pytest.mark.slow
@pytest.mark.parametrize(("width", "environment"), [(40, {}), (100, {"TERM": "dumb"})])
def test_a_terminal_that_cannot_show_a_table_gets_plain_lines(
    width: int, environment: dict[str, str], named: Path
) -> None:
    piped = subprocess.run(list3r("list", named), capture_output=True, check=True).stdout.decode()
    assert on_terminal(*list3r("list", named), width=width, **environment) == piped


def test_a_long_table_is_plain(tmp_path: Path) -> None:
    code = "from list3r.cli.common import print_table; print_table([[n, 'box'] for n in range({})], ['id', 'what'])"
    assert "─" in on_terminal(sys.executable, "-c", code.format(200))
    assert "─" not in on_terminal(sys.executable, "-c", code.format(201))


def test_a_pipe_gets_the_lines_that_it_always_got(named: Path) -> None:
    piped = subprocess.run(list3r("list", named), capture_output=True, check=True).stdout.decode()
    assert piped.startswith(PLAIN)


def test_a_question_that_is_piped_starts_without_the_drawing(named: Path) -> None:
    command = [sys.executable, "-X", "importtime", *list3r("nearest", named, "3")[1:]]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    assert not re.search(r"\brich\b", told.stderr), "rich takes a fifth of the start"


WORK = """
import sys, time
from list3r.cli.bar import progress_bar
from list3r.cli.terminal import note
with progress_bar("building", "frames") as bar:
    bar.show(0, 1000)
    time.sleep(0.4)
    bar.show(300, 1000)
    note("note: [red]the camera[/red]")
    time.sleep(0.6)
    bar.stage("looking for names")
    time.sleep(0.6)
print("done")
"""


@pytest.mark.parametrize("width", [80, 140])
def test_work_says_its_stage_how_much_is_done_the_rate_and_the_time_left(width: int) -> None:
    drawn = on_terminal(sys.executable, "-c", WORK, width=width)
    told = ESCAPES.sub("", drawn)
    assert re.search(r"building .*300/1000 frames  \d+\.\d frames/s  0:00:0\d left", told)
    assert "note: [red]the camera[/red]\n" in told
    assert re.search(r"looking for names .*0:00:00", told)
    assert told.splitlines()[-1] == "done"
    assert drawn.rfind("\x1b[?25h") > drawn.rfind("\x1b[?25l") >= 0, "the cursor is left visible"


def test_work_that_nobody_looks_at_draws_nothing() -> None:
    told = subprocess.run([sys.executable, "-c", WORK], capture_output=True, text=True, check=True)
    assert (told.stdout, told.stderr) == ("done\n", "note: [red]the camera[/red]\n")


def test_a_process_that_is_killed_leaves_the_cursor() -> None:
    code = f"import os, signal\n{WORK.split('    note')[0]}    os.kill(os.getpid(), signal.SIGKILL)\n"
    drawn = on_terminal(sys.executable, "-c", code, status=-signal.SIGKILL)
    assert drawn.rfind("\x1b[?25h") > drawn.rfind("\x1b[?25l") >= 0

"""A small install: a memory is asked without the packages that only builds, exports and networks take."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from list3r.memory.core.errors import EXTRA_OF_PACKAGE

ROOT = Path(__file__).resolve().parents[1]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The program in a Python that has none of the extras' packages."""
    blocked = f"import sys; sys.modules.update(dict.fromkeys({list(EXTRA_OF_PACKAGE)!r}))"
    program = f"{blocked}; from list3r.cli.app import run; sys.exit(run({list(arguments)!r}))"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=ROOT)


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> str:
    from tests.test_edits import built

    path = tmp_path_factory.mktemp("small") / "m.l3r"
    built(path).close()
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("info", "{}"),
        ("list", "{}"),
        ("show", "{}", "1"),
        ("nearest", "{}", "--point", "0,0,1"),
        ("find", "{}", "white"),
        ("relations", "{}"),
        ("verify", "{}"),
        ("edit", "label", "{}", "1", "mug"),
    ],
)
def test_asking_takes_none_of_the_extras(words: tuple[str, ...], memory: str) -> None:
    said = run(*(word.format(memory) for word in words))
    assert said.returncode == 0 and "error" not in said.stderr, said.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (("inspect", "tests/fixtures"), "build"),
        (("export", "{}", "--to", "usd", "--out", "{}.usda"), "export"),
        (("export", "{}", "--to", "glb", "--out", "{}.glb"), "export"),
    ],
)
def test_what_is_missing_is_named_with_its_extra(words: tuple[str, ...], extra: str, memory: str) -> None:
    said = run(*(word.format(memory) for word in words))
    assert said.returncode == 2 and said.stderr.count("\n") == 1
    assert f"pip install '.[{extra}]'" in said.stderr

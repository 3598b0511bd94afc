"""Every command on a small memory, for people and for machines."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import list3r
from list3r.cli.app import FIRST, MODULES, REST, commands
from list3r.exporters.registry import FORMATS
from list3r.instances.registry import DISCOVERERS, FEATURES, TRACKERS
from list3r.memory.core.records import Relation
from list3r.memory.store.store import Store
from list3r.models.presets import PRESETS
from tests.conftest import write_small_room
from tests.program import as_user, in_process

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small room as a file."""
    path = tmp_path_factory.mktemp("cli") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


def run(*arguments: str | Path) -> str:
    result = in_process(*arguments)
    assert result.returncode == 0, result.stderr
    return result.stdout


def ask(*arguments: str | Path) -> Any:
    """The matches of an answer."""
    return answer(*arguments)["matches"]


def answer(*arguments: str | Path) -> Any:
    """The whole answer."""
    told = json.loads(run(*arguments, "--json"))
    assert told["schema"] == "list3r/answer/1" and {"units", "matches", "notes"} <= set(told)
    return told


def one(*arguments: str | Path) -> Any:
    """The only match of an answer."""
    (match,) = ask(*arguments)
    return match


COMMANDS = (
    "inspect build demo info list show export verify doctor nearest within relations similar"
    " eval.trajectory eval.cloud eval.instances eval.revisits find seen path changes update repair"
    " edit.log edit.undo edit.merge edit.split edit.label edit.delete edit.scale"
    " embed detect precompute models.list models.fetch batch"
    " catalog.add catalog.remove catalog.list catalog.check catalog.rebuild serve"
).split()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str) -> None:
    text = run(*command.split("."), "--help")
    assert f"Example: list3r {command.replace('.', ' ')}" in text


def test_every_command_is_in_one_section_of_the_help() -> None:
    grouped = [name for names in (FIRST | REST).values() for name in names]
    assert sorted(grouped) == sorted(name for names in MODULES.values() for name in names)


def listed(help_text: str) -> list[str]:
    """The commands that a page of help lists."""
    sections = help_text.partition("Build:")[2]
    return re.findall(r"^  (\S+)  ", sections, re.MULTILINE)


def test_the_first_screen_of_help_has_at_most_15_commands_and_all_shows_the_rest() -> None:
    first, everything = listed(run("--help")), listed(run("--all"))
    assert first == [name for names in FIRST.values() for name in names]
    assert len(first) <= 15 and {"find", "nearest", "relations", "changes", "similar"} <= set(first)
    assert sorted(everything) == sorted(commands().commands)  # type: ignore[attr-defined]
    assert "--all" in run("--help")


def test_every_command_and_group_has_help() -> None:
    paths = [[name] for name in commands().commands]  # type: ignore[attr-defined]
    for path in paths:
        assert f"Usage: list3r {' '.join(path)} " in run(*path, "--help")
        if len(path) == 1:
            paths += [[*path, name] for name in getattr(commands().commands[path[0]], "commands", {})]  # type: ignore[attr-defined]


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{p.name}" for p in sorted((ROOT / "docs").glob("*.md")))])
def test_every_command_line_of_the_documents_is_understood(page: str) -> None:
    for line in command_lines((ROOT / page).read_text(encoding="utf-8")):
        words = shlex.split(line.replace("|", "_"), comments=True)
        words = words[: words.index(">")] if ">" in words else words
        if any(set("[]<>") & set(word) for word in words) or "..." in line:
            continue
        command, path = commands(), ["list3r"]
        while hasattr(command, "commands") and words and not words[0].startswith("-"):
            assert words[0] in command.commands, (page, line)
            path.append(words[0])
            command, words = command.commands[words[0]], words[1:]
        if words and not hasattr(command, "commands"):
            options = [o for p in command.params for o in (*p.opts, *p.secondary_opts)]
            asked = [word.partition("=")[0] for word in words if word.startswith("-")]
            assert [word for word in asked if word not in (*options, "--help", "-h")] == [], (page, line)


def command_lines(text: str) -> list[str]:
    """What follows `list3r` in blocks and in `code`."""
    blocks = re.findall(r"^(?:    )?(?:\$ )?list3r ([a-z-].*)$", text, re.MULTILINE)
    return [*blocks, *re.findall(r"`list3r ([a-z-][^`]*)`", text)]


def test_the_readme_names_every_command() -> None:
    text = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
    assert [c for c in COMMANDS if not re.search(rf"`[^`]*\b{c.replace('.', ' ')}\b", text)] == []


def test_the_page_of_commands_names_every_command_and_option_and_no_other() -> None:
    page = (Path(__file__).resolve().parents[1] / "docs/commands.md").read_text(encoding="utf-8")
    told = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", " ".join(re.findall(r"`[^`]*`", page))))
    assert told == options_of(commands()) | {"-h", "--help", "--version", "--install-completion", "--show-completion"}
    assert [c for c in COMMANDS if not re.search(rf"`[^`]*\b{c.split('.')[-1]}\b", page)] == []


def options_of(command: Any) -> set[str]:
    """Options of a command and of those under it."""
    own = {o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("-")}
    return own.union(*(options_of(c) for c in getattr(command, "commands", {}).values()))


def test_every_json_answer_names_things_alike(room: Path) -> None:
    report = one("info", room, "--loops")
    assert report["memory"] == str(room) == one("verify", room)["memory"]
    assert report["components"] == len(report["parts"]) == 1
    assert one("verify", room)["sessions"] == [{"id": 1, "state": report["sessions"][0]["state"]}]


def test_help_is_quick_and_loads_nothing_heavy() -> None:
    heavy = ("torch", "open3d", "cv2", "numpy")
    loaded = f"print([m for m in {heavy} if m in sys.modules])"
    code = f"import sys; from list3r.cli.app import commands; commands(); {loaded}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_info_names_scale_gravity_and_frames(room: Path) -> None:
    report = one("info", room)
    assert (report["scale"], report["gravity"], report["frames"], report["instances"]) == ("metric", "estimated", 20, 4)
    assert "sensor depth" in run("info", room)
    assert one("info", room, "--loops")["edges"] == []


def test_list_and_show(room: Path) -> None:
    assert [i["id"] for i in ask("list", room)] == [2, 3, 4, 5]
    assert [i["id"] for i in ask("list", room, "--structure")] == [1, 2, 3, 4, 5, 6]
    assert ask("list", room, "--min-confidence", "0.95") == []
    mug = one("show", room, "3")
    assert mug["description"] == "mug"
    assert {(r["subject"], r["predicate"], r["object"]) for r in mug["relations"]} == {(3, "on", 2)}
    assert re.search(r"mug \(3\) on table \(2\)", run("show", room, "3"))


def test_show_says_of_each_other_thing_what_tells_most(room: Path, tmp_path: Path) -> None:
    copy = tmp_path / "room.l3r"
    shutil.copy(room, copy)
    with Store.open(copy, writable=True) as store, store.transaction():
        said = [(2, "near", 5), (2, "next_to", 5), (2, "near", 3), (2, "supports", 3)]
        store.relations.replace(None, [Relation(a, predicate, b, 0.9, 0.1) for a, predicate, b in said])
    told = [line for line in run("show", copy, "2").splitlines() if "margin" in line]
    assert [re.sub(r" +confidence.*", "", line).strip() for line in told] == [
        "table (2) supports mug (3)",
        "table (2) next to chair (5)",
    ]


def test_the_help_shows_the_choices_there_are() -> None:
    text = run("build", "--help")
    for known in (PRESETS, DISCOVERERS, TRACKERS, FEATURES):
        assert "|".join(known) in text


def test_nearest_gives_surface_and_centre_distances(room: Path) -> None:
    first, second = ask("nearest", room, "--point", "1.8,0.1,0.90", "-k", "2")
    assert first["id"] == 3
    assert first["distance"] == pytest.approx(0.08, abs=0.01)
    assert first["center_distance"] == pytest.approx(0.13, abs=1e-6)
    assert second["center_distance"] > first["center_distance"]
    assert [m["id"] for m in ask("nearest", room, "3", "-k", "2")] == [2, 4]
    assert {m["id"] for m in ask("nearest", room, "mug")} == {3, 4}
    assert ask("nearest", room, "elephant") == []
    assert ask("nearest", room, "--point", "9,9,9", "--max-distance", "1") == []


def test_within_relations_and_similar(room: Path) -> None:
    assert {m["id"] for m in ask("within", room, "--point", "2,0,0.77", "--radius", "0.3")} >= {3, 4}
    assert {m["id"] for m in ask("within", room, "--box", "1.7,0,0.7,1.9,0.2,0.9")} >= {3}
    told = answer("relations", room, "--predicate", "on", "--object", "2")
    assert {r["subject"] for r in told["matches"]} == {3, 4}
    assert (told["gravity"], told["state"], told["units"]) == ("estimated", "known", "m")
    assert len(ask("similar", room, "3", "-k", "2")) == 2
    for words in (
        ("within", room, "--point", "2,0,0.77", "--radius", "0.3"),
        ("relations", room),
        ("similar", room, "3"),
    ):
        assert "mug" in run(*words)


@pytest.mark.parametrize("name", ["json", "csv", "plan"])
def test_every_format_is_written(name: str, room: Path, tmp_path: Path) -> None:
    path = tmp_path / f"room{FORMATS[name].suffixes[0]}"
    report = ask("export", room, "--to", name, "--out", path)[0]
    assert report["path"] == str(path) and report["bytes"] == path.stat().st_size > 0


def test_verify_and_doctor(room: Path) -> None:
    assert one("verify", room)["sound"] is True
    assert {"numpy", "typer"} <= {row["part"] for row in ask("doctor")}


def test_verify_ends_with_1_on_damage(room: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.l3r"
    damaged.write_bytes(room.read_bytes())
    with contextlib.closing(sqlite3.connect(damaged)) as database, database:
        database.execute("UPDATE supports SET rgb = zeroblob(length(rgb)) WHERE local_id = 0")
    result = as_user("verify", damaged)
    assert result.returncode == 1
    assert "is not as it was written" in result.stdout


def test_a_directory_of_read_only_memories_can_be_asked(room: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.l3r"
    copy.write_bytes(room.read_bytes())
    copy.chmod(0o444)
    assert len(ask("list", copy)) == 4


def test_the_face_for_python(room: Path) -> None:
    with list3r.open(room) as memory:
        assert memory.units == "m"
        assert [m.instance.id for m in memory.nearest("mug", k=1)] == [3]
        assert [m.instance.id for m in memory.nearest(3, k=1)] == [2]
        assert memory.nearest([1.8, 0.1, 0.9], k=1)[0].instance.id == 3
        assert {r.subject for r in memory.relations(object=2, predicate="on")} == {3, 4}
        assert len(memory.similar(3, k=2)) == 2
        assert memory.relation_graph().number_of_nodes() >= 4
        assert memory.merge_graph().number_of_nodes() == 6
        assert memory.support(3).points.shape == (400, 3)


def test_the_version_is_the_package_s() -> None:
    assert as_user("--version").stdout.strip() == f"list3r {list3r.__version__}"


COMPLETING = """
eval "$(list3r --show-completion)"
complete_words() {
    COMP_WORDS=(list3r "$@"); COMP_CWORD=$#; COMPREPLY=(); _list3r_completion list3r; echo "${COMPREPLY[@]}"
}
complete_words query ne
complete_words export a.l3r --to no
complete_words build a --preset li
"""


@pytest.mark.skipif(shutil.which("bash") is None or os.name != "posix", reason="there is no bash")
def test_bash_completes_commands_and_formats(tmp_path: Path) -> None:
    program = tmp_path / "list3r"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m list3r "$@"\n')
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    bash = subprocess.run(["bash"], input=COMPLETING, env=environment, capture_output=True, text=True)
    assert bash.stdout.split("\n") == ["nearest", "node-link", "light", ""], bash.stderr

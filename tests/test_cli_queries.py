"""find, seen, path, and what cameras and viewpoints answer, through the program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from list3r.cli.app import run
from list3r.memory.store.store import Store
from tests.conftest import write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("queries") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


@pytest.fixture
def ask(room: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """A function that runs `list3r COMMAND room ...` and gives (status, standard output, standard error)."""

    def asked(command: str, *arguments: object) -> tuple[int, str, str]:
        status = run([command, str(room), *map(str, arguments)])
        out = capsys.readouterr()
        return status, out.out, out.err

    return asked


@pytest.mark.parametrize("command", ["find", "seen", "path", "relations", "within", "nearest", "similar"])
def test_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([command, "--help"]) == 0
    assert f"Example: list3r {command}" in capsys.readouterr().out


def test_find(ask: Any) -> None:
    status, out, err = ask("find", "mug on table")
    assert status == 0 and "on #2 table" in out and "2 instances match" in err
    found = json.loads(ask("find", "mug on table", "--json")[1])
    assert [m["id"] for m in found["matches"]] == [MUG, TWIN] and found["ambiguous"]
    assert found["total"] == 2 and found["matches"][0]["best_view"]["frame"] == 3
    status, out, err = ask("find", "mug", "-k", 1)
    assert json.loads(ask("find", "mug", "-k", 1, "--json")[1])["total"] == 2 and "the best 1 of 2" in err
    nothing = json.loads(ask("find", "elephant on table", "--json")[1])
    assert nothing["matches"] == [] and nothing["unknown_words"] == ["elephant"]
    assert "nothing found" in ask("find", "elephant")[1]


def test_seen(ask: Any) -> None:
    status, out, _ = ask("seen", MUG)
    assert status == 0 and "20 frames" in out
    assert json.loads(ask("seen", MUG, "--json")[1])["matches"][0]["spans"] == [
        {"session": 1, "from_s": 0.0, "to_s": 0.633333}
    ]
    status, out, err = ask("seen", "--time", "0.1")
    assert status == 0 and "frame 3 of session 1, 0.10 s" in err
    at = json.loads(ask("seen", "--pose", "0,0,0.9,0.5,-0.5,0.5,-0.5", "--json")[1])
    assert {TABLE, MUG, TWIN} <= {m["id"] for m in at["matches"]}


def test_within_a_view(ask: Any) -> None:
    found = json.loads(ask("within", "--view", 3, "--no-occlusion", "--structure", "--json")[1])
    assert TABLE in [m["id"] for m in found["matches"]]
    assert all(m["view"]["frame"] == 3 for m in found["matches"]) and found["total"] == len(found["matches"])


def test_relations_from_somewhere_and_between(ask: Any) -> None:
    found = json.loads(ask("relations", "--predicate", "left_of", "--object", TWIN, "--from", "0,0,1", "--json")[1])
    assert found["state"] == "known" and MUG in [r["subject"] for r in found["matches"]]
    status, out, err = ask("relations", "mug", "--from", "camera")
    assert status == 0 and "left_of" in out and "as seen from frame 19" in err
    assert (
        json.loads(ask("relations", "--predicate", "between", "--object", MUG, "--and", TWIN, "--json")[1])["matches"]
        == []
    )


def test_path(ask: Any) -> None:
    found = json.loads(ask("path", MUG, CHAIR, "--json")[1])
    assert [r["predicate"] for r in found["matches"]] == ["on", "next_to"]
    assert "no relations connect them" in ask("path", MUG, WALL)[2]


@pytest.mark.parametrize(
    "arguments",
    [
        ("find", ""),
        ("find", "!?"),
        ("find", "mug", "-k", "0"),
        ("seen",),
        ("seen", 99),
        ("seen", 3, "--time", "1"),
        ("seen", "--time", "nan"),
        ("seen", "--view", 4711),
        ("seen", "--pose", "1,2,3"),
        ("seen", "--pose", "0,0,0,0,0,0,0"),
        ("within", "--view", 3, "--point", "0,0,0", "--radius", "1"),
        ("within", "--point", "0,0,0", "--radius", "1", "--max-depth", "1"),
        ("relations", "--predicate", "left_of"),
        ("relations", "--predicate", "between", "--object", 2),
        ("relations", "--from", "nowhere"),
        ("path", 3, 99),
        ("path", 3, 10**30),
    ],
)
def test_what_makes_no_sense_is_said_in_one_line(ask: Any, arguments: tuple[object, ...]) -> None:
    status, out, err = ask(*arguments)
    assert status == 2 and out == ""
    assert err.startswith("error: ") and err.count("\n") == 1


def test_words_that_nothing_bears_are_named(ask: Any) -> None:
    for arguments in (("nearest", "zebra"), ("relations", "zebra"), ("find", "zebra")):
        status, out, err = ask(*arguments)
        assert status == 0 and "has the word 'zebra'" in err and "zebra" not in out
    status, out, err = ask("nearest", "zebra", "--json")
    told = json.loads(out)
    assert status == 0 and told["matches"] == [] and "has the word 'zebra'" in told["notes"][0] and err == ""


def test_with_json_an_error_is_an_answer_too(ask: Any) -> None:
    for arguments, kind in (
        (("path", 3, 99), "UnknownIdError"),
        (("find", "mug", "-k", "0"), "OptionError"),
        (("find", "mug", "--no-such-option"), "OptionError"),
    ):
        status, out, err = ask(*arguments, "--json")
        told = json.loads(out)
        assert status == 2 and told["schema"] == "list3r/answer/1" and told["matches"] == [] and told["units"] is None
        assert told["error"]["kind"] == kind and told["error"]["status"] == 2
        assert err == f"error: {told['error']['message']}\n"


def test_nearest_takes_words_that_say_more_than_names(ask: Any) -> None:
    for words, wanted in (("mug on table", [MUG, TWIN]), ("biggest thing", [TABLE])):
        assert [m["id"] for m in json.loads(ask("nearest", words, "--json")[1])["matches"]] == wanted
    near = json.loads(ask("nearest", "mug on table", "--point", "2.2,-0.1,0.8", "--json")[1])["matches"]
    assert [m["id"] for m in near] == [TWIN, MUG] and near[0]["distance"] < near[1]["distance"]


def test_why_does_not_repeat_the_columns_beside_it(ask: Any) -> None:
    for arguments, reason in ((("nearest", MUG), f"from #{MUG}"), (("similar", MUG), "cosine in test@1/16")):
        _, table, _ = ask(*arguments)
        matches = json.loads(ask(*arguments, "--json")[1])["matches"]
        assert {m["reason"] for m in matches} == {reason} and table.count(reason) == len(matches)


def test_tables_name_things_alike_and_label_places(ask: Any) -> None:
    assert "centre x y z (m)" in ask("list")[1] and "confidence" in ask("list")[1]
    assert "centre      x 1.80  y 0.10  z 0.77 m" in ask("show", MUG)[1]
    assert "confidence" in ask("relations")[1].splitlines()[0]


def test_a_box_has_six_numbers(ask: Any) -> None:
    status, _, err = ask("within", "--box", "0,0,0,1,1")
    assert status == 2 and "six numbers" in err and len(err.splitlines()) == 1
    assert ask("within", "--box", "1.5,-1,0,2.5,1,2")[0] == 0

"""Thousands of questions that nobody would ask: an answer, or an error that names what is wrong, never else."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import list3r
from list3r.api import SceneMemory
from list3r.cli.app import run
from list3r.memory.core.errors import List3rError
from list3r.memory.store.store import Store
from list3r.queries.finding.tokens import table
from list3r.queries.match import Filters, Match
from list3r.queries.relations import ALL_PREDICATES
from tests.conftest import THOROUGH, write_small_room


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fuzz") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


@pytest.fixture(scope="module")
def memory(room: Path) -> Iterator[SceneMemory]:
    with list3r.open(room) as opened:
        yield opened


WORDS = st.one_of(
    st.sampled_from(
        [*table()["relations"], *ALL_PREDICATES, "the", "and", "a", "mug", "table", "white", "small", "biggest", "wall"]
    ),
    st.sampled_from(
        ["#3", "2", "77", "-1", "0", "9" * 40, "thing", "chairs", "huge", "elephant", "between", "", "\x00"]
    ),
    st.text(max_size=8),
)
SENTENCES = st.sampled_from(
    [
        "mug",
        "mug on table",
        "mug on the table near 4",
        "table next to chair",
        "thing on 2",
        "#3",
        "wall",
        "biggest thing",
    ]
)
TEXTS = st.one_of(SENTENCES, st.lists(WORDS, max_size=9).map(" ".join), st.text(max_size=30))
NUMBERS = st.one_of(st.floats(), st.floats(-5, 5), st.sampled_from([0.0, 1e308, -1e308, 5e-324, math.inf, math.nan]))
INSIDE = st.tuples(st.floats(0, 4), st.floats(-2, 2), st.floats(0, 2)).map(list)
POINTS = st.one_of(INSIDE, st.lists(NUMBERS, min_size=3, max_size=3), st.lists(NUMBERS, max_size=4))
IDS = st.one_of(st.integers(-2, 9), st.integers())
THINGS = st.one_of(IDS, TEXTS)
VIEWPOINTS = st.one_of(st.none(), IDS, POINTS, st.sampled_from(["camera", "camera:3", "camera:99", "#4"]), TEXTS)
PLAIN_FILTERS = st.fixed_dictionaries(
    {},
    optional={
        "structure": st.booleans(),
        "min_confidence": st.floats(0, 1),
        "state": st.sampled_from([None, "present", "any"]),
        "label": st.sampled_from(["mug", "table"]),
        "color": st.just("white"),
        "max_size": st.floats(0.05, 5),
    },
)
WILD_FILTERS = st.fixed_dictionaries(
    {},
    optional={
        "structure": st.booleans(),
        "min_confidence": NUMBERS,
        "state": st.one_of(st.none(), st.sampled_from(["present", "moved", "gone"])),
        "label": TEXTS,
        "color": st.one_of(st.just("white"), TEXTS),
        "min_size": NUMBERS,
        "max_size": NUMBERS,
        "component": st.integers(-1, 3),
        "dynamic": st.booleans(),
    },
)
FILTERS = st.one_of(st.just({}), PLAIN_FILTERS, WILD_FILTERS)


def often(examples: int) -> settings:
    """So many examples, the same each time; ten times as many in a thorough run (`LIST3R_TEST_PROFILE`)."""
    examples *= 10 if THOROUGH else 1
    return settings(
        max_examples=examples, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=not THOROUGH
    )


def answers(ask: Callable[[], Any]) -> Any:
    """The answer, or nothing after an error in one line; numbers in answers are finite."""
    try:
        found = ask()
    except List3rError as error:
        assert "\n" not in str(error)
        assert str(error)
        return None
    for match in found if isinstance(found, list) else []:
        if isinstance(match, Match):
            numbers = (match.score, match.distance_m or 0.0, match.center_distance_m or 0.0)
            assert all(math.isfinite(n) for n in numbers)
            assert match.reason
    return found


@often(50)
@given(place=INSIDE, radius=st.floats(0.01, 3), filters=PLAIN_FILTERS)
def test_what_makes_sense_is_answered_and_answers_agree(
    memory: SceneMemory, place: list[float], radius: float, filters: Any
) -> None:
    """What lies in a sphere is what is no further than its radius, the same with and without a box around it."""
    near = answers(lambda: memory.nearest(place, 9, max_distance=radius, **filters))
    inside = answers(lambda: memory.within(center=place, radius=radius, **filters))
    low, high = [x - radius for x in place], [x + radius for x in place]
    boxed = answers(lambda: memory.within(lower=low, upper=high, **filters))
    assert near is not None and inside is not None and boxed is not None
    assert {m.instance.id for m in near} == {m.instance.id for m in inside} <= {m.instance.id for m in boxed}


SOMETHING = st.sampled_from([None, "mug", "table", 2, 3, "#4"])


@often(50)
@given(subject=SOMETHING, predicate=st.sampled_from([None, "on", "supports", "next_to"]), object=SOMETHING)
def test_relations_that_make_sense_are_the_stored_ones(memory: SceneMemory, **asked: Any) -> None:
    named = {"mug": {3, 4}, "table": {2}, "#4": {4}}
    ends = [None if x is None else named.get(x, {x}) for x in (asked["subject"], asked["object"])]
    expected = {
        (r.subject, r.predicate, r.object)
        for r in memory.store.relations.all()
        if (ends[0] is None or r.subject in ends[0]) and (ends[1] is None or r.object in ends[1])
    }
    found = answers(lambda: memory.relations(**asked))
    wanted = {r for r in expected if asked["predicate"] in (None, r[1])}
    assert found is not None and {(r.subject, r.predicate, r.object) for r in found} == wanted


@often(250)
@given(text=TEXTS, k=st.integers(-1, 5), viewpoint=VIEWPOINTS)
def test_find(memory: SceneMemory, text: str, k: int, viewpoint: Any) -> None:
    found = answers(lambda: memory.find(text, k, viewpoint=viewpoint))
    if found is not None:
        assert len(found) <= k
        assert [m.score for m in found] == sorted((m.score for m in found), reverse=True)


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@often(100)
@given(target=st.one_of(THINGS, POINTS), k=st.integers(-1, 2**70), limit=st.one_of(st.none(), NUMBERS), filters=FILTERS)
def test_nearest(memory: SceneMemory, target: Any, k: int, limit: float | None, filters: Any) -> None:
    found = answers(lambda: memory.nearest(target, k, max_distance=limit, **filters))
    if found is not None:
        assert len(found) <= k
        keys = [(m.distance_m, m.instance.id) if m.distance_m is not None else (-m.score, 0) for m in found]
        assert [key[0] for key in keys] == sorted(key[0] for key in keys)
        assert limit is None or all(m.distance_m is not None and m.distance_m <= limit for m in found)
        assert all(Filters(**{**filters, "structure": True}).passes(m.instance) for m in found)


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@often(100)
@given(one=POINTS, two=POINTS, radius=NUMBERS, sphere=st.booleans(), filters=FILTERS)
def test_within(memory: SceneMemory, one: Any, two: Any, radius: float, sphere: bool, filters: Any) -> None:
    region = {"center": one, "radius": radius} if sphere else {"lower": one, "upper": two}
    found = answers(lambda: memory.within(**region, **filters))
    assert found is None or all(0.0 < m.score <= 1.0 and Filters(**filters).passes(m.instance) for m in found)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@often(50)
@given(
    place=POINTS, quat=st.lists(NUMBERS, min_size=3, max_size=4), depth=st.one_of(st.none(), NUMBERS), filters=FILTERS
)
def test_within_what_a_camera_sees(memory: SceneMemory, place: Any, quat: Any, depth: Any, filters: Any) -> None:
    found = answers(
        lambda: memory.within(camera=memory.camera(position=place, quat_wxyz=quat), max_depth=depth, **filters)
    )
    assert found is None or all(0.0 < m.score <= 1.0 and Filters(**filters).passes(m.instance) for m in found)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@often(100)
@given(
    subject=st.one_of(st.none(), THINGS),
    predicate=st.one_of(st.none(), st.sampled_from(ALL_PREDICATES), TEXTS),
    object=st.one_of(st.none(), THINGS),
    other=st.one_of(st.none(), THINGS),
    viewpoint=VIEWPOINTS,
    least=st.one_of(st.just(0.0), NUMBERS),
)
def test_relations(memory: SceneMemory, **arguments: Any) -> None:
    least = arguments.pop("least")
    for r in answers(lambda: memory.relations(min_confidence=least, **arguments)) or []:
        assert 0.0 <= r.confidence <= 1.0
        assert math.isfinite(r.margin)


@often(70)
@given(one=IDS, two=IDS, gap=NUMBERS, structure=st.booleans())
def test_path_and_seen(memory: SceneMemory, one: int, two: int, gap: float, structure: bool) -> None:
    way = answers(lambda: memory.path_between(one, two, structure=structure))
    assert not way or {one, two} & {way[0].subject, way[0].object}
    sightings = answers(lambda: memory.seen(one, gap_s=gap))
    assert sightings is None or all(start <= end for _, start, end in sightings.spans_s)
    alike = answers(lambda: memory.similar(one, two))
    assert alike is None or (len(alike) <= two and one not in {m.instance.id for m in alike})


COMMANDS = [
    ["edit", "log"],
    *([name] for name in "find nearest within relations similar seen path changes".split()),
    *([name] for name in "info list show verify".split()),
]
VALUES = st.one_of(TEXTS, NUMBERS.map(repr), IDS.map(str), POINTS.map(lambda p: ",".join(map(repr, p))))
LINES = st.tuples(
    st.sampled_from(COMMANDS),
    st.lists(VALUES, max_size=2),
    st.lists(
        st.tuples(
            st.sampled_from(
                "--point -k --radius --box --view --time --pose --session --from --object --and"
                " --predicate --max-depth --max-distance --label --color --min-size --structure --no-occlusion"
                " --max-size --min-confidence --state --component --image --since --at --json".split()
            ),
            VALUES,
        ),
        max_size=3,
    ),
)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@often(120)
@given(line=LINES)
def test_the_command_line(room: Path, line: tuple[list[str], list[str], list[tuple[str, str]]]) -> None:
    command, values, options = line
    flags = ("--structure", "--no-occlusion", "--json")
    arguments = [part for name, value in options for part in ((name,) if name in flags else (name, value))]
    words = [*command, str(room), *values, *arguments]
    assert run(words) in (0, 2), shlex.join(words)

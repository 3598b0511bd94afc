"""Findings 5 to 7: damaged memories that answered, and sound ones that were called damaged."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any

from hostile.findings.place import Place, first, spoil

_DAMAGES = {
    "instances": "UPDATE instances SET confidence = 0.123 WHERE id = 3",
    "surfaces": "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 1",
    "masks": "UPDATE local_instances SET track = zeroblob(length(track))",
    "cameras": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 3",
    "places": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "calibration": "UPDATE chunks SET fx = 7",
}
_QUESTIONS: dict[str, Callable[[Any], object]] = {
    "instances": lambda scene: scene.instances(),
    "find": lambda scene: scene.find("mug"),
    "nearest": lambda scene: scene.nearest((0.0, 0.0, 0.0)),
    "support": lambda scene: scene.support(2),
    "seen": lambda scene: scene.seen(2),
    "visible": lambda scene: scene.visible(scene.camera(frame=3), min_visible=0.0),
    "relations": lambda scene: scene.relations(3),
}


def _wrong(place: Place, question: str, damage: str) -> str:
    """Ask a damaged memory five times on one handle; the first wrong answer."""
    opened, ask = importlib.import_module("list3r").open, _QUESTIONS[question]
    with opened(place.memory("sound.l3r")) as scene:
        sound = repr(ask(scene))
    memory = place.memory()
    spoil(memory, _DAMAGES[damage])
    found = ""
    try:
        with opened(memory) as scene:
            for n in range(1, 6):
                try:
                    message = repr(ask(scene))
                except Exception as error:
                    found = found or ("" if "repair" in str(error) else f"{type(error).__name__}: {error}"[:100])
                    continue
                if message != sound:
                    found = found or f"call {n} answers with the damaged value"
    except Exception as error:
        found = found or ("" if "repair" in str(error) else f"{type(error).__name__}: {error}"[:100])
    return found


def _asked(question: str, damage: str) -> Callable[[Place], str]:
    return lambda place: _wrong(place, question, damage)


def _swallowed(*words: object) -> Callable[[Place], str]:
    """Masks are damaged: the answer must be that of the sound file, or none."""

    def look(place: Place) -> str:
        sound = place.ask("query", words[0], place.memory("sound.l3r"), *words[1:])
        assert sound.status == 0, sound
        memory = place.memory()
        spoil(memory, _DAMAGES["masks"])
        ended = place.ask("query", words[0], memory, *words[1:])
        wrong = ended.status == 0 and ended.out != sound.out
        return first(ended.bad, "another answer, status 0" if wrong else "")

    return look


def large_files(place: Place) -> str:
    """Every question of every damage, in a file without whole-table checks."""
    for module in list(sys.modules.values()):
        if getattr(module, "WHOLE_BYTES", None):
            module.WHOLE_BYTES = 0  # type: ignore[attr-defined]
    pairs = [(q, d) for q in _QUESTIONS for d in _DAMAGES]
    wrong = [f"{q} of damaged {d}" for q, d in pairs if _wrong(place, q, d)]
    return f"{len(wrong)} of {len(pairs)} answer wrongly: {wrong[0]}, ..." if wrong else ""


def an_error_of_the_callers_own(place: Place) -> str:
    opened = importlib.import_module("list3r").open
    try:
        with opened(place.two_sessions(), at=1) as scene:
            scene.instances()
            raise KeyError("mine")
    except Exception as error:
        return "" if isinstance(error, KeyError) else f"becomes: {error}"[:120].replace(str(place.folder), "")


def verify_of_the_past(place: Place) -> str:
    with importlib.import_module("list3r").open(place.two_sessions(), at=1) as scene:
        found = scene.store.verify()
    return f"lists {len(found)} damages of a sound file" if found else ""


def past_and_present_mixed(place: Place) -> str:
    """Another process deletes an object while the past is read: it is there in all tables or in none."""
    memory = place.two_sessions()
    with importlib.import_module("list3r").open(memory, at=1) as scene:
        scene.instances()
        place.ask("delete", memory, 4)
        place.ask("label", memory, 2, "plate")
        ids = {i.id for i in scene.instances()}
        related = {n for r in scene.relations() for n in (r.subject, r.object)}
    return "" if related <= ids else f"relations of {sorted(related - ids)}, which are no instances"


ROWS: dict[str, Callable[[Place], str]] = {
    "5 a damaged row is asked for again: instances": _asked("instances", "instances"),
    "5 a damaged row is asked for again: find": _asked("find", "instances"),
    "5 a damaged row is asked for again: support": _asked("support", "surfaces"),
    "6 what a frame shows, of a file with damaged masks": _asked("visible", "masks"),
    "6 query within --view of a file with damaged masks": _swallowed("within", "--view", 3, "--no-occlusion"),
    "6 files above 128 MiB: 42 questions about damage": large_files,
    "7 an error of the caller's own inside open(at=)": an_error_of_the_callers_own,
    "7 verify() inside open(at=) of a sound file": verify_of_the_past,
    "7 open(at=) while another process edits": past_and_present_mixed,
}

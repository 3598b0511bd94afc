"""What is asked of a build: written once, and what a resumed or later session takes from the memory."""

from dataclasses import fields, replace
from pathlib import Path
from typing import get_type_hints

import pytest

from list3r.cli.app import commands
from list3r.frames.base import Camera, SourceInfo
from list3r.frames.chunking.chunks import ChunkSettings
from list3r.frames.options import SourceOptions
from list3r.memory.core.errors import OptionError
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings
from list3r.memory.store.store import Store
from list3r.pipeline.choice import (
    check_beside,
    look_doubts,
    settings_asked,
    settings_beside,
    settings_resumed,
    stored_sessions,
)
from list3r.pipeline.finishing import check_run
from list3r.pipeline.request import BuildRequest, RunArguments, RunOptions
from list3r.pipeline.settings import AssociationSettings, BuildSettings

INFO = SourceInfo("tum", "walk", 100, 30.0, Camera(320, 240, 260.0, 260.0, 159.5, 119.5), True, True, "f")
BEGUN = BuildSettings(
    "rgbd", "given", chunks=ChunkSettings(40, 12), keep_pictures=False, association=AssociationSettings(solved_whole=9)
)


def test_python_takes_the_words_of_the_run_by_the_same_names_and_types() -> None:
    assert get_type_hints(RunArguments) == get_type_hints(RunOptions)


@pytest.mark.parametrize("command", ["build", "update"])
def test_every_field_that_can_be_asked_is_an_option_of_the_command(command: str) -> None:
    parameters = {p.name: p for p in commands().commands[command].params}  # type: ignore[attr-defined]
    for f in (*fields(BuildRequest), *fields(RunOptions)):
        help_ = f.metadata["help"]
        assert parameters[f.name].help == help_.text
        assert parameters[f.name].opts == [(help_.flag or f"--{f.name.replace('_', '-')}").split("/")[0]]


def test_what_is_left_out_is_what_was_before() -> None:
    settings, notes = settings_asked(BuildRequest(), INFO, "research")
    assert settings == BuildSettings(poses="auto", discovery="learned") and notes == []


def test_a_resumed_session_goes_on_with_its_own_settings() -> None:
    assert settings_resumed(BuildRequest(), BEGUN, INFO, "research") == (BEGUN, [])
    assert settings_resumed(BuildRequest(chunk=50), BEGUN, INFO, "research")[0].chunks == ChunkSettings(50, 15)
    named, notes = settings_resumed(BuildRequest(preset="cpu", poses="estimate"), BEGUN, INFO, "research")
    assert named == replace(BEGUN, reconstruction="auto", poses="estimate", discovery="learned") and notes


def test_a_later_session_takes_the_stages_of_the_first_and_what_is_asked_for() -> None:
    asked = BuildSettings("sfm", "auto", chunks=ChunkSettings(20, 5))
    later = settings_beside(asked, BEGUN)
    assert later.association == BEGUN.association and (later.reconstruction, later.poses) == ("sfm", "auto")
    assert later.chunks == asked.chunks and later.keep_pictures
    check_beside(later, BEGUN)
    with pytest.raises(OptionError, match="redundancy"):
        check_beside(replace(BEGUN, library=ConsolidationSettings(redundancy=RedundancySettings(chunks=3))), BEGUN)


def test_frames_of_a_later_session_are_described_as_the_first_ones_or_it_is_said() -> None:
    first = replace(BEGUN, features="dinov2", frame_look="network")
    same = settings_beside(BuildSettings(features="dinov2", frame_look="network"), first)
    assert same.frame_look == "network" and look_doubts(same, first) == []
    for other in ("geometric", "dinov3"):
        later = settings_beside(BuildSettings(features=other, frame_look="network"), first)
        assert later.frame_look == "local"
        (said,) = look_doubts(later, first)
        assert "by dinov2" in said and "--features dinov2" in said
    later = settings_beside(BuildSettings(features="dinov2", frame_look="network"), BEGUN)
    assert later.frame_look == "local" and look_doubts(later, BEGUN) == []
    resumed, _ = settings_resumed(BuildRequest(features="geometric"), first, INFO, "research")
    assert resumed.frame_look == "local"


def test_the_sessions_of_a_memory_say_how_they_were_made(tmp_path: Path) -> None:
    path = tmp_path / "m.l3r"
    assert stored_sessions(path) == (None, None)
    with Store.create(path) as store, store.transaction():
        store.sessions.complete(store.sessions.add("walk", "1", BEGUN.as_plain(), 100))
        store.sessions.add("walk", "2", BuildSettings().as_plain(), 100)
    assert stored_sessions(path) == (BEGUN, BuildSettings())


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (RunOptions(workers=-1), "--workers -1"),
        (RunOptions(resume=True, force=True), "give one of them"),
        (RunOptions(scale_anchor="long"), "long"),
        (RunOptions(detector_classes=Path("names.txt")), "--detector FILE"),
        (RunOptions(detector=Path("none.param")), "none.param"),
    ],
)
def test_what_cannot_be_done_is_said_before_hours_are_spent(run: RunOptions, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        check_run(run)


def test_depth_options_are_refused_where_there_is_no_depth() -> None:
    options = SourceOptions(depth_scale=1000.0, registered=True)
    options.check_fits(INFO)
    with pytest.raises(OptionError, match="no depth; leave out --depth-scale and --registered"):
        options.check_fits(replace(INFO, has_depth=False))

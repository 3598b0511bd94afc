"""What is done to a memory once its video is in: its scale anchored, its things named."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from list3r.cli.edit.scale import anchor_scale
from list3r.cli.models.detect import run_detector

if TYPE_CHECKING:
    from list3r.frames.options import SourceOptions
    from list3r.memory.errors import List3rError


def finish(
    memory: Path,
    source: str,
    options: SourceOptions,
    *,
    scale_anchor: str | None,
    detector: Path | None,
    classes: Path | None,
    quiet: bool,
) -> tuple[tuple[str, ...], List3rError | None]:
    """Notes for the report, and what went wrong: the memory is there all the same, and that is to be told first."""
    from list3r.memory.errors import List3rError

    notes: list[str] = []
    failure = None
    try:
        if scale_anchor is not None:
            notes.append(anchor_scale(memory, scale_anchor).text)
    except List3rError as error:
        failure = error
        notes.append(f"the scale is not anchored; `list3r scale {memory} --anchor ANCHOR` does it")
    try:
        if detector is not None:
            seen = run_detector(memory, detector, classes, source, options, quiet=quiet)
            notes.append(f"{seen.detector} named {len(seen.labels)} things")
    except List3rError as error:
        failure = failure or error
    return tuple(notes), failure

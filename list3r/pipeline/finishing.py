"""What is done to a memory once its video is in: its scale is anchored and its things are named."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from list3r.frames.options import SourceOptions
from list3r.memory.core.errors import List3rError, OptionError, check_choice
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels
from list3r.memory.library.maintenance.edits import EditReport, scale
from list3r.memory.library.world.gravity import Gravity
from list3r.memory.library.world.guess import GUESS, guess_metre
from list3r.memory.library.world.scale import main_part, parse_anchor, rescale
from list3r.memory.store.store import Store
from list3r.pipeline.request import Progress, RunOptions, Watch
from list3r.semantics.detection import DetectReport, detect, open_sources

if TYPE_CHECKING:
    from list3r.pipeline.reports import RunReport
    from list3r.semantics.detector import Detector
    from list3r.semantics.nanodet import NanoDet

R = TypeVar("R", bound="RunReport")


class FinishingError(List3rError):
    """The memory is built, but its scale could not be anchored or its things could not be named."""

    def __init__(self, error: List3rError, report: object) -> None:
        super().__init__(str(error))
        self.report = report
        """The `RunReport`: the memory is there all the same."""


def check_run(run: RunOptions, note: Callable[[str], None] = lambda _: None) -> None:
    """Raise `OptionError` for what cannot be done, before hours are spent."""
    if run.workers is not None and run.workers < 0:
        raise OptionError(f"--workers {run.workers}: give the number of worker processes, 0 for none")
    if run.engine not in ("local", "ray"):
        raise OptionError(f"--engine {run.engine} is not known; choose local or ray")
    if run.engine == "ray" and run.workers == 0:
        raise OptionError("--workers 0 is for --engine local; with ray leave it out or give 1 or more")
    if run.engine != "ray" and run.address is not None:
        raise OptionError(f"--address {run.address} needs --engine ray")
    if run.resume and run.force:
        raise OptionError("--resume continues what is there and --force discards it; give one of them")
    if run.scale_anchor is not None:
        parse_anchor(run.scale_anchor)
    naming = _naming(run)
    if run.live and run.names != "none":
        raise OptionError(f"--names {run.names} needs the whole video; run `list3r names MEMORY` when it is built")
    if naming is not None:
        load_naming(naming, run.detector, run.detector_classes, note)
    elif run.detector_classes is not None:
        raise OptionError(f"--detector-classes {run.detector_classes} needs a detector: --detector FILE")


def finish(report: R, memory: Path, source: str | Path, options: SourceOptions, run: RunOptions, watch: Watch) -> R:
    """Anchor the scale and name things if asked to; return the report with notes. Raises `FinishingError` with it."""
    notes = [*report.notes]
    failure: List3rError | None = None
    try:
        if run.scale_anchor is not None:
            notes.append(anchor_scale(memory, run.scale_anchor).text)
    except List3rError as error:
        failure = error
        notes.append(f"the scale is not anchored; `list3r edit scale {memory} --anchor ANCHOR` does it")
    try:
        naming = _naming(run)
        if naming is not None:
            network = load_naming(naming, run.detector, run.detector_classes)
            seen = name_things(memory, network, str(source), options, watch.looking("names"))
            notes.append(f"{seen.detector} named {len(seen.labels)} things")
            guess_anew(memory)
        else:
            notes += _unnamed(memory)
    except List3rError as error:
        failure = failure or error
    report = replace(report, notes=tuple(notes))
    if failure is not None:
        raise FinishingError(failure, report)
    return report


def anchor_scale(memory: Path, anchor: str, author: str | None = None) -> EditReport:
    """Say how long something in a memory is; return what was edited."""
    with Store.open(memory, writable=True) as store:
        return scale(store, anchor, author)


def guess_anew(memory: Path) -> None:
    """Guess a metre once more where nobody knows one, now that things have names."""
    with Store.open(memory, writable=True) as store, store.transaction():
        estimate, before = store.facts.gravity_estimate, store.facts[GUESS]
        if store.facts.scale_kind not in ("relative", "guessed") or not store.chunks.all():
            return
        up, floor = (np.array([0.0, 0.0, 1.0]), None) if estimate is None else (estimate.up, estimate.floor_height)
        gravity = Gravity(store.facts.gravity, up, floor, "")
        S_graph_world = store.facts.S_world_graph.inverse()
        S_graph_chunk = {c.chunk_id: S_graph_world @ c.S_world_chunk for c in store.chunks.all()}
        found = guess_metre(store, main_part(store.chunks.all()), S_graph_chunk, gravity)
        if found is None or found == before:
            return
        store.facts[GUESS] = found
        if rescale(store):
            apply_labels(store, written=consolidate(store).written)


def name_things(
    memory: Path, network: Detector, source: str | None, options: SourceOptions | None, progress: Progress | None = None
) -> DetectReport:
    """Let a detector look at a memory: at frames of the source's session where one is named, else at all pictures.

    Of a memory with several sessions, those that the source is not of keep their votes.
    """
    with Store.open(memory, writable=True) as store:
        opened = None if source is None else open_sources(store, source, options)
        chunks = None if opened is None else [c.chunk_id for c in store.chunks.all() if c.session_id in opened]
        return detect(store, network, opened, chunks=chunks, progress=progress)


def load_naming(
    by: str, weights: Path | None, classes: Path | None, note: Callable[[str], None] = lambda _: None
) -> Detector:
    """Return the detector that is asked for, its weights fetched where none are given; `note` hears of that before.

    The environment's `LIST3R_NANODET` names a file of NanoDet to use instead. Raises `OptionError`.
    """
    check_choice("--names", by, ("detector", "open"))
    if by == "open":
        from list3r.models.cache import locate, resolve
        from list3r.models.cards import find_card
        from list3r.semantics.open_vocabulary import OpenVocabulary

        card = find_card("owlv2", "detector")
        asked = None if weights is None else str(weights)
        return OpenVocabulary(locate(resolve(asked, card.weights[0] if card else None, "--names open")))
    from list3r.semantics.nanodet import PUBLISHED
    from list3r.weights import fetch_files

    file = weights or (Path(own) if (own := os.environ.get("LIST3R_NANODET")) else None)
    if file is None:
        file = fetch_files("NanoDet (Apache-2.0)", PUBLISHED, note) / next(iter(PUBLISHED))
    return load_detector(file, classes)


def _naming(run: RunOptions) -> str | None:
    """Return who names things: a detector's file alone asks for the detector."""
    check_choice("--names", run.names, ("none", "detector", "open"))
    if run.names == "none":
        return None if run.detector is None else "detector"
    return run.names


def _unnamed(memory: Path) -> list[str]:
    """Say how many things have no name, and how to get names."""
    with Store.open(memory) as store:
        things = [i for i in store.instances.all() if i.structure is None and i.state != "removed"]
    missing = sum(i.label is None for i in things)
    how = f"`list3r names {memory} --by detector` looks for 80 kinds of things (2 MB are fetched once)"
    return [f"{missing} of {len(things)} things have no name; {how}"] if missing else []


def load_detector(file: Path, classes: Path | None) -> NanoDet:
    """Return a box detector with its classes, those of COCO unless a file names others. Raises `OptionError`."""
    from list3r.memory.core.description.coco import COCO_80
    from list3r.semantics.nanodet import NanoDet, read_class_names

    return NanoDet(file, COCO_80 if classes is None else read_class_names(classes))

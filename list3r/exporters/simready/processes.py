"""Make many props: in this process, or in several, which are handed surface points and write the files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from list3r.exporters.simready.prop import Prop, PropFacts, write_prop
from list3r.exporters.solids.solid import Solids, Surroundings, solid_of
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.pipeline.workers import OrderedPool, default_workers

Some = Sequence[tuple[Instance, Surroundings]]
_AT_ONCE = 50
"""Instances that a process makes at a time; of fewer than four times as many no process is started unasked."""


@dataclass(frozen=True)
class Making:
    """How props are made."""

    workers: int | None
    """Worker processes; 0 for none, None for none with few props and one per core, at most 4, with many."""
    progress: Callable[[int, int], None] | None
    """Called with how many of the instances are done, and how many there are."""


def write_props(store: Store, shown: Sequence[Instance], folder: Path, facts: PropFacts, making: Making) -> list[Prop]:
    """Write a prop below `folder` for each instance with enough points for a mesh; in their order."""
    blocks = [shown[n : n + _AT_ONCE] for n in range(0, len(shown), _AT_ONCE)]
    solids = Solids(store)
    some = ([(i, solids.around(i)) for i in block] for block in blocks)
    workers = making.workers if making.workers is not None else default_workers() if len(blocks) >= 4 else 0
    props, done = [], 0
    for block, made in zip(blocks, _made(some, partial(_write_some, folder, facts), workers), strict=True):
        props += made
        done += len(block)
        if making.progress is not None:
            making.progress(done, len(shown))
    return props


def _made(some: Iterator[Some], work: Callable[[Some], list[Prop]], workers: int) -> Iterator[list[Prop]]:
    if workers == 0:
        yield from map(work, some)
        return
    with OrderedPool(work, workers) as pool:
        yield from pool.map(some)


def _write_some(folder: Path, facts: PropFacts, some: Some) -> list[Prop]:
    """Write the props of some instances, in the process that makes them."""
    solids = ((i, solid_of(i, around)) for i, around in some)
    return [write_prop(folder, i, solid, facts) for i, solid in solids if solid is not None]

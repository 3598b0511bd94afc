"""Judge left_of, right_of, in_front_of and behind from a viewpoint, and what is between two instances.

The frame of reference: the viewer stands at a place (a point, the centre of an instance, or a camera) and looks level
towards the middle of the two centres. `right` is to the viewer's right hand, `front` is towards the viewer. A thing is
left of another when their centres lie further apart across the line of sight than half the width of the wider of the
two; in front of it when they lie further apart along it than half the depth of the deeper. So left_of and right_of,
in_front_of and behind are inverses, two things can be both (in front and to the left), and of two things that overlap
none is said. The margin is how far the centres lie beyond that bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Instance, Relation
from list3r.memory.library.relations.scene import certainty

VIEWPOINT = ("left_of", "right_of", "in_front_of", "behind")
"""Predicates that hold from a viewpoint only."""


@dataclass(frozen=True)
class Viewpoint:
    """The viewpoint of a question."""

    place: Array
    """World. Shape (3,)."""
    up: Array
    """Unit vector, world. Shape (3,)."""
    name: str
    """In words: `#12`, `frame 40`, `the point 0, 0, 1`."""
    instance_id: int | None = None
    """Of the instance from which it looks: of that nothing is said."""
    component: int | None = None
    """The part of the memory where it stands; None for a point, which stands in all."""


@dataclass(frozen=True)
class BetweenRelation(Relation):
    """subject between object and other."""

    other: int = -1
    """The second of the two."""


def viewed(viewer: Viewpoint, subject: Instance, object: Instance, noise: float) -> list[Relation] | None:
    """Return the viewpoint relations of two things; None where they are undefined: the viewer stands above, below or
    amidst them, or they are in different connected components.

    `noise` is the standard deviation of a position, world units.
    """
    components = {subject.component, object.component} | ({viewer.component} - {None})
    if len(components) > 1 or viewer.instance_id in (subject.id, object.id):
        return None
    sight = (subject.center + object.center) / 2.0 - viewer.place
    ahead = sight - (sight @ viewer.up) * viewer.up
    length = float(np.linalg.norm(ahead))
    if length <= max(2.0 * noise, 1e-9):
        return None
    ahead = ahead / length
    right = np.cross(ahead, viewer.up)
    sure = [x for x in (subject.position_sigma_m, object.position_sigma_m) if x is not None]
    spread = math.hypot(noise, *sure)
    out = []
    for axis, less, more in ((right, "left_of", "right_of"), (ahead, "in_front_of", "behind")):
        offset = float((subject.center - object.center) @ axis)
        margin = abs(offset) - 0.5 * max(_extent(subject, axis), _extent(object, axis))
        if margin > 0.0:
            confidence = round(certainty(margin, spread), 4)
            out.append(Relation(subject.id, less if offset < 0.0 else more, object.id, confidence, round(margin, 5)))
    return out


def between(subject: Instance, a: Instance, b: Instance, noise: float) -> BetweenRelation | None:
    """Tell whether a thing lies between two others: in the gap between their boxes it meets the tube that the thinner
    of the two sweeps along the line of the centres, and is not so long as to be under or behind both. The margin is how
    deep; None when it does not.
    """
    line = b.center - a.center
    length = float(np.linalg.norm(line))
    if len({subject.component, a.component, b.component}) > 1 or length <= max(2.0 * noise, 1e-9):
        return None
    along = line / length
    foot = float((subject.center - a.center) @ along)
    start, end = 0.5 * _extent(a, along), length - 0.5 * _extent(b, along)
    if not start < foot < end or _extent(subject, along) >= length:
        return None
    off = subject.center - a.center - foot * along
    away = float(np.linalg.norm(off))
    aside = off / away if away > 1e-9 else np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    half = 0.5 * (_extent(subject, aside) + min(_extent(a, aside), _extent(b, aside)))
    margin = min(half - away, foot - start, end - foot)
    if margin <= 0.0:
        return None
    confidence = round(certainty(margin, noise), 4)
    return BetweenRelation(subject.id, "between", a.id, confidence, round(margin, 5), b.id)


def _extent(instance: Instance, axis: Array) -> float:
    """Return the full length of a thing's box along a direction."""
    return float(np.ptp(instance.box.corners() @ axis))

"""Decision boundaries of relations. Metres become units of a relative memory by what a metre is there.

The source of a boundary is named where it is known; `benchmarks/relations.py` measures all of them together.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SupportSettings:
    """When a surface holds an instance from below."""

    reach_m: float = 0.05
    """Boxes may lie further apart than the contact tolerance by this: they leave out strays."""
    aside_m: float = 0.25
    """How far the middle of an instance may lie beside what holds it, and how far above a surface hidden feet end."""
    hold_m: float = 0.02
    """How far the middle may lie outside the hull of the surface; sparse surfaces have up to `aside_m` more."""
    around_m: float = 0.06
    """Width of the border round the footprint in which the height of the surface is measured,"""
    around_spacings: float = 2.0
    """or this many spacings of its points."""
    lowest: float = 0.01
    """Share of the lowest points that noise may misplace."""
    above: float = 0.6
    """Share of the points of an instance that must lie above the surface,"""
    sunk: float = 0.7
    """give or take this share of how far it may sink in."""
    beside: float = 0.6
    """Confidence left where the surface is seen on one side only: what lies beside an instance on a table is as high as
    the table, but does not go round it."""
    sectors: int = 7
    """Of eight directions, this many with a surface make it certain."""
    hidden: float = 0.8
    """Confidence that an instance stands on feet that were not seen."""
    beneath_m: float = 0.05
    """A surface under the middle has points nearer to it than this, seen from above,"""
    beneath_spacings: float = 3.0
    """or nearer than this many spacings."""


@dataclass(frozen=True)
class ContainmentSettings:
    """When an instance is in another one."""

    most_volume: float = 0.7
    """Volume of its box over that of the container."""
    slack_m: float = 0.01
    """How far points may lie outside the container's box."""
    trim: float = 0.03
    """Share of the points at the ends of its height that noise may misplace."""
    side_noises: float = 2.5
    """Sides are looked for above its lowest part by this many deviations of the noise,"""
    side_height: float = 0.3
    """or this share of its height, and as far above its top; the container has points below that much of its height."""
    clear: float = 0.25
    """What lies nearer to its middle than this share of its width is part of it, not a side."""
    middle: float = 0.3
    """Half width of the middle of a container, over its width."""
    depth: float = 0.25
    """How far below the rim the middle of an open container lies, over its height; an instance in it likewise over its
    own, and as far over its width its middle may lie outside the container's outline."""
    boards: float = 0.9
    """Confidence of what lies between two boards."""
    most_footprint: float = 0.8
    """Footprint of an instance over that of the open container."""
    sure_sides: float = 0.8
    """Share of directions with a side that makes it certain."""


@dataclass(frozen=True)
class SymmetrySettings:
    """When an instance is round about the vertical."""

    most_noise: float = 0.7
    """Deviation of the distances from the axis over the noise of a point,"""
    most_uneven: float = 0.13
    """and over the radius."""
    most_radius: float = 1.5
    """Radius over half the width that was seen: a flat side would make it wider."""


@dataclass(frozen=True)
class RelationSettings:
    """Noise of the measurements, and the decision boundaries of all relations."""

    noise_m: float = 0.015
    """Standard deviation of a height or gap: depth noise and drift between chunks."""
    computed_noise_m: float = 0.03
    """The same where depth was computed from colour: 2 % at 1.5 m, alike over an instance and other in each chunk."""
    contact_m: float = 0.035
    """An instance may float or sink by this much and still stand on a surface: its lowest points are rarely seen."""
    contact_per_height: float = 0.12
    """More of it for tall instances, whose thin legs are rarely seen."""
    hidden_feet: float = 0.6
    """An instance that stands on nothing and touches no wall stands on the floor if its lowest visible point is nearer
    to it than this share of its longest edge: legs under a table are often not seen."""
    hidden_feet_m: float = 0.8
    """And nearer than this."""
    least_base: float = 0.25
    """Least area of the surface under an instance over the instance's own footprint: a floor does not stand on table
    legs."""
    enclosed_deg: float = 75.0
    """A container goes round an instance but for at most this: the back and arms of a sofa leave more."""
    inside: float = 0.8
    """Share of an instance's points inside its container's box."""
    hollow: float = 0.5
    """Share of the surface over the middle of an open container that lies well below its rim, where it is seen."""
    overhead: float = 0.4
    """Share of an instance's points that have something over them, to be under it."""
    most_wider: float = 3.0
    """A container that holds an instance by its sides alone, without the instance being inside its box, is at most this
    much wider than the instance: a bowl, not a sofa with arms."""
    around: float = 0.4
    """Share of directions in which such a container has a side: of a bowl, only the far half is often seen."""
    uneven: float = 0.35
    """Deviation of the distances to those sides over their mean."""
    open_m: float = 0.8
    """Longest edge of such a container."""
    above_m: float = 1.5
    """Higher than this over something is no longer said to be above it."""
    covering_m: float = 0.06
    """What lies on the floor and is lower than this is a rug: instances stand on it or near it, not next to it."""
    next_to_m: tuple[float, float] = (0.1, 0.4)
    """Gap between surfaces: half the mean size of the two, within these."""
    near_m: tuple[float, float] = (0.15, 0.4)
    """The same for near."""
    sure: float = 0.65
    """Least confidence of near and next_to: a gap that is measured at the bound is as likely beyond it, and is one of
    the many that lie there."""
    grain: float = 0.3
    """The nearest points of two surfaces lie further apart than the surfaces, as surfaces are sampled, less what the
    noise of the points makes up for: by this share of the spacing of the coarser one's points."""
    attached_m: float = 0.05
    """An instance nearer to a wall than this touches it."""
    over_m: float = 0.03
    """Points of two outlines nearer than this, seen from above, lie over each other,"""
    over_spacings: float = 1.5
    """or nearer than this many spacings of the coarser outline's points."""
    trim: float = 0.1
    """Share of the points at the ends of a height that noise may misplace."""
    side_by_side: float = 0.3
    """Share of the shorter one's height that two instances that stand side by side have in common, less the noise."""
    on: SupportSettings = field(default_factory=SupportSettings)
    within: ContainmentSettings = field(default_factory=ContainmentSettings)
    symmetry: SymmetrySettings = field(default_factory=SymmetrySettings)

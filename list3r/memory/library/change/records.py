"""What the matching of changes works with: its settings, and what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import MergeDecision
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.visibility import VisibilitySettings


@dataclass(frozen=True)
class ChangeSettings:
    """When two sessions show one instance, and when an instance has changed.

    Chosen on pairs of simulated homes (decision 0023).
    """

    small_m: float = 0.7
    """Diagonal of an instance that a session sees whole."""
    most_truncated: float = 0.5
    """Share of its frames in which the border may cut an instance that is seen whole."""
    other_color: float = 25.0
    """Between median colours (CIE L*a*b*, lightness at half weight) of two whole instances that are not one;"""
    other_size: float = 2.0
    """or the ratio of their diagonals."""
    meets: float = 0.2
    """Share of an instance's surface that lies on another one, from which the colours of what meets are compared;"""
    meets_m: float = 0.03
    """points within this meet."""
    other_surface: float = 15.0
    """Median distance of colours where surfaces of two sessions meet (CIE L*a*b*, lightness at half weight), from which
    they are two surfaces: of one it is 3.7, and 7 in 95 of 100 (decision 0059);"""
    other_surface_noise: float = 4.0
    """but so many times what all that meets has, where the light has changed."""
    seen_through: float = 0.2
    """Share of an instance's surface that another session sees through, from which nothing found there is it."""
    pure: float = 0.5
    """Share of what is seen through, beside the mean of all members, from which a member tells of what changed."""
    side_share: tuple[float, float, float] = (0.04, 0.04, 0.02)
    """Deviation of larger side, smaller side and height of one instance in two places, as a share of them,"""
    side_m: tuple[float, float, float] = (0.012, 0.012, 0.008)
    """and beside that."""
    other_palette: float = 10.0
    """Distance of colours, see `palette_distance`, of two instances that are not one."""
    side_most: float = 3.0
    """Squared deviations that one side counts at most: what hides a part of an instance says nothing against it,"""
    side_longer: float = 3.0
    """unless another side is longer than that of the whole by this many deviations."""
    least_changed: float = 0.3
    """Share of an instance's points that must have changed, for the others to be left out of its size."""
    foot_m: float = 0.04
    """Height above what it stands on up to which depth does not tell that an instance came or went."""
    palette: float = 4.0
    """Deviation of the colours of one instance in two places, see `palette_distance`."""
    hues: float = 0.04
    """What of `hue_distance` counts as one squared deviation."""
    most_deviations: float = 12.5
    """Sum of squared deviations up to which two are one instance."""
    left_unseen: float = 0.1
    """Chance that an instance has left a place of which frames tell nothing."""
    placed_deviations: float = 2.0
    """Deviations of how surely the sessions lie on each other. Within this many nothing moved, and what is gone must
    be gone wherever the session may lie (decision 0058)."""
    replaced: float = 0.4
    """Share of a new instance's surface that must lie where an instance stood that is gone, to be new there;"""
    replaced_slack_m: float = 0.02
    """within this."""
    mostly_new: float = 0.5
    """Share of a new instance's surface that earlier sessions see through, from which it is not mixed with what stood
    there before."""
    displaced: float = 0.5
    """Share of what an instance showed that lies within something new of other looks, from which that has its place."""
    explained: float = 0.7
    """Share of an instance's surface that must be seen through, or lie at what is new, for that to stand in its
    place;"""
    replaced_link_m: float = 0.045
    """within this."""
    told: float = 0.5
    """Share of all of an instance's surface of which frames must tell for it to be removed."""
    part: float = 0.7
    """Share of its surface inside the box of a larger instance of the same fate from which it is a scrap of that."""
    least_frames: int = 12
    """Frames in which an instance must have been seen for its absence or presence to be an event."""
    half_sure_frames: float = 4.0
    """Frames that make it half certain that an instance was seen again,"""
    least_sure: float = 0.3
    """and the least certainty, frames aside, that one is gone."""
    most_structure: float = 0.5
    """Share of its members flagged as structure up to which an instance can come and go."""
    points: int = 200
    """Surface points of an instance that frames are asked about."""
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)
    computed_noise: float = 0.05
    """`visibility.noise_share` from the first session on of which depth is computed: in the red kitchen half of it is
    off by more than 2.2 %."""


@dataclass(frozen=True)
class OverlapGroups:
    """Instances by overlap alone, before it is asked which of them moved between sessions."""

    groups: Sequence[Sequence[Key]]
    shown: Sequence[bool]
    """Which of them count."""
    moving: frozenset[Key] = frozenset()
    """First members of those that were seen moving, of which their tracks tell where they are."""


@dataclass(frozen=True)
class Change:
    """An event before its instance has an id."""

    first: Key
    """First member of the group that it is about."""
    session_id: int
    kind: str
    from_box: OrientedBox | None
    to_box: OrientedBox | None
    frames: tuple[tuple[int, int], ...]
    confidence: float
    reason: str


@dataclass(frozen=True)
class Changes:
    """What sessions have changed."""

    groups: list[list[Key]]
    """The groups, those that moved joined."""
    current: dict[Key, tuple[Key, ...]]
    """By first member of a group that moved: the members that show it where it is now."""
    states: dict[Key, str]
    """By first member: the state of a group, where it is not `present`."""
    events: tuple[Change, ...]
    decisions: list[MergeDecision]

"""When two local instances are one instance."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MergeSettings:
    """What makes two local instances one instance."""

    min_overlap: float = 0.3
    """Of the less covered one, for two views of one instance."""
    min_containment: float = 0.5
    """Of the better covered one, for two views of one instance."""
    part_containment: float = 0.8
    """Of a smaller one inside a larger one, for a partial view."""
    min_truncated: float = 0.5
    """Share of its frames in which the image's border must cut a partial view."""
    same_mask_containment: float = 0.2
    """Of the better covered one, for two views whose masks agree in shared frames."""
    piece_containment: float = 0.05
    """Of the better covered one, for two pieces of one plane."""
    apart_overlap: float = 0.1
    """Of the less covered one, below which two whole views may lie apart."""
    max_part_color: float = 22.0
    """Between the median colours of a part and of the whole, CIE L*a*b* with lightness at half weight."""
    min_part_size: float = 0.3
    """Of a part that the border does not cut, over the size of the whole."""
    min_cosine: float = 0.0
    """Of the features; spaces without calibration only tell opposites apart."""
    max_center_offset: float = 0.45
    """Between the centres of two whole views of one instance that share no surface, over the diagonal of its
    extents."""
    max_size_ratio: float = 2.5
    """Of two whole views of one instance."""
    min_shared_frames: int = 3
    """Frames that two chunks share, before what the masks do in them counts."""
    same_mask_iou: float = 0.5
    """Mean IoU of the boxes in shared frames that makes up for poor overlap in space."""
    max_whole_m: float = 1.6
    """Diagonal up to which a view that the border does not cut is taken for whole; the far end of a larger instance is
    hidden or out of range."""
    max_conflicts: float = 0.25
    """Share of the pairs across two clusters that may contradict joining them."""
    max_apart: float = 2.0
    """Chunks that tell two clusters apart, for each that sees them as one, up to which they are joined."""
    max_angle_deg: float = 10.0
    """Between the normals of two pieces of one plane."""
    most_span_m: float = 20.0
    """Along the longest edge of its box: a floor or wall that goes on beyond is continued by another one. So no
    instance grows with the memory: its points stay dense, its box says where it is, and a new chunk touches only what
    is near.
    """

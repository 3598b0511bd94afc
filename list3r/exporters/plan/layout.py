"""Place map and legend on the page of a plan view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import OptionError


@dataclass(frozen=True)
class PlanSettings:
    """How the picture is laid out; lengths in px of the finished picture."""

    width_px: int = 1600
    legend_px: int = 470
    """Width of a column of the legend, at least."""
    margin_px: int = 32
    header_px: int = 78
    footer_px: int = 64
    row_px: int = 22
    max_legend_px: int = 960
    """The map grows up to this height for the sake of a legend beside it."""
    max_rows_below: int = 16
    """At most so many rows of a legend below the map; things that are not listed are drawn all the same."""
    max_tags: int = 80
    """The things seen most have tags; where there are more, the others are faint outlines."""
    min_map_px: int = 420
    max_map_px: int = 1400
    wide: float = 0.62
    """A scene whose height on the page is under this share of its width has the legend below."""
    points_per_instance: int = 8000
    """At most this many points of each thing are drawn."""
    points_of_instances: int = 10_000_000
    """At most this many points of all things together, the same share of each: more than a page has pixels."""
    points_per_structure: int = 40000
    """At most this many points of a floor, a wall and the like."""

    def __post_init__(self) -> None:
        least = self.legend_px + 3 * self.margin_px + 300
        if self.width_px < least:
            raise OptionError(f"the picture is {self.width_px} px wide; at least {least} px are needed")


@dataclass(frozen=True)
class Layout:
    """Places on the finished page, px."""

    map_px: tuple[int, int]
    """Width and height of the map."""
    legend_xy: tuple[int, int]
    """Upper left corner of the legend."""
    column_px: int
    """Width of a column of the legend."""
    columns: int
    rows: int
    """Rows of a column."""
    height_px: int
    """Height of the page."""


def choose_layout(span: NDArray[np.float64], things: int, settings: PlanSettings) -> Layout:
    """Place legend beside the map, or below it for a wide scene. `span` is (width, height) of the scene, any unit."""
    s = settings
    ratio = float(span[1] / span[0])
    if ratio < s.wide:
        width = s.width_px - 2 * s.margin_px
        height = int(np.clip(width * ratio, s.min_map_px, s.max_map_px))
        columns = max(1, (width + s.margin_px) // (s.legend_px + s.margin_px))
        rows = min(-(-things // columns), s.max_rows_below)
        top = s.header_px + height + s.footer_px
        column = (width - (columns - 1) * s.margin_px) // columns
        return Layout((width, height), (s.margin_px, top), column, columns, rows, top + rows * s.row_px + 64)
    width = s.width_px - s.legend_px - 3 * s.margin_px
    height = int(np.clip(width * ratio, s.min_map_px, s.max_map_px))
    height = max(height, min(things * s.row_px + 50, s.max_legend_px))
    corner = (s.width_px - s.margin_px - s.legend_px, s.header_px)
    page = s.header_px + height + s.footer_px
    return Layout((width, height), corner, s.legend_px, 1, (height - 50) // s.row_px, page)

"""Shared options of the eval commands, and output of pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from list3r.cli.measure.inputs import scale_of
from list3r.cli.terminal import note

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Truth = Annotated[Path, typer.Argument(metavar="TRUTH", show_default=False)]
Estimate = Annotated[Path, typer.Argument(metavar="ESTIMATE", show_default=False)]
PlotOption = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Also draw a picture: .png, .pdf or .svg.")
]
Scale = Literal["auto", "free", "fixed"]
ScaleOption = Annotated[
    Scale,
    typer.Option(
        "--scale",
        metavar="auto|free|fixed",
        help="free: Sim(3); fixed: SE(3); auto: free for a memory of relative scale.",
    ),
]
EveryOption = Annotated[
    int | None,
    typer.Option("--every", min=1, metavar="N", help="Read every N-th frame of a source; default: about 250 in all."),
]


def share(value: float | None) -> str:
    """A share in two decimals, a dash for none."""
    return "-" if value is None else f"{value:.2f}"


def check_plot(plot: Path | None) -> None:
    """Raises `OptionError` or `ExportError` before any work when the picture cannot be written."""
    if plot is None:
        return
    from list3r.evaluation.figures import check_ending
    from list3r.exporters.output import check_target

    check_target(check_ending(plot))


def save_picture(figure: Figure, path: Path) -> None:
    """Write a picture whole or not at all, and say so."""
    from list3r.evaluation.figures import save
    from list3r.exporters.output import replacing

    with replacing(path) as temporary:
        save(figure, temporary)
    note(f"note: {path} written")


def free_scale(scale: Scale, estimate: Path) -> bool:
    """Whether the scale of an alignment is free: as asked, or by `auto` for a memory of relative scale."""
    return scale == "free" or (scale == "auto" and scale_of(estimate) == "relative")

"""Figures of evaluations, as PNG, PDF or SVG by the file's ending."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.evaluation.boxes import footprint
from list3r.evaluation.trajectory import Trajectory
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import OrientedBox

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from list3r.evaluation.revisits import RevisitJudgement

Array = NDArray[np.float64]

ENDINGS = (".png", ".pdf", ".svg")
_GREY, _FOUND, _MISSED, _FALSE = "#8a8f98", "#2a9d5c", "#d1495b", "#9aa0a8"
_MOST_POINTS = 60_000


UPRIGHT: tuple[Array, str] = (np.eye(3)[:2], "seen along -z")
"""The page of a world with z up, see `page_axes`."""


def check_ending(path: str | Path) -> Path:
    """Return path of a picture. Raises `OptionError` for an ending that is no kind of picture that is written here."""
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise OptionError(f"--plot {path}: the picture must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    return path


def save(figure: Figure, path: str | Path) -> None:
    """Write a picture; the same bytes for the same picture."""
    import matplotlib

    kind = Path(path).suffix.lower().lstrip(".")
    dates = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    with matplotlib.rc_context({"svg.hashsalt": "list3r", "svg.fonttype": "none"}):
        figure.savefig(path, dpi=150, format=kind, metadata=dates[kind])


def page_axes(T_world_cam: Array) -> tuple[Array, str]:
    """Return page's right and up in the world for a view from above, shape (2, 3), and the viewing direction in words.

    Up is taken from the cameras: the axis of the world nearest to their mean up if it is within 30 degrees, else that
    mean.
    """
    up = -T_world_cam[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    if not length > 0.3:
        return UPRIGHT
    up = up / length
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) > np.cos(np.deg2rad(30)):
        sign = float(np.sign(up[axis]))
        right = np.eye(3)[(axis + 1) % 3]
        return np.stack([right, np.cross(sign * np.eye(3)[axis], right)]), f"seen along {'-' * (sign > 0)}{'xyz'[axis]}"
    right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)]), "seen along the cameras' mean down"


def trajectory_figure(truth: Trajectory, moments: Array, positions: Array, errors: Array, title: str) -> Figure:
    """Return the estimate over the truth from above, coloured by error, and the error over time beneath.

    `moments` (P,), aligned `positions` (P, 3) and `errors` (P,) are those of the associated poses, metres.
    """
    from matplotlib.collections import LineCollection

    figure, (above, below) = _sheet(figsize=(8.0, 8.4), rows=2, heights=(3.0, 1.0))
    axes, note = page_axes(truth.T_world_cam)
    path, xy = truth.positions() @ axes.T, positions @ axes.T
    above.plot(*path.T, color=_GREY, linewidth=1.0, label="truth", zorder=1)
    unit, factor = ("cm", 100.0) if np.max(errors) < 1.0 else ("m", 1.0)
    joined = ~_gaps(moments)
    segments = np.stack([xy[:-1], xy[1:]], axis=1)[joined]
    colors = (factor * (errors[:-1] + errors[1:]) / 2)[joined]
    lines = LineCollection(list(segments), array=colors, cmap="viridis", linewidth=2.4, zorder=2)
    lines.set_clim(0.0, factor * float(np.max(errors)))
    above.add_collection(lines)
    above.plot(*path[0], "o", color="black", markersize=6, label="start", zorder=3)
    above.plot([], [], color="#3b9a8f", linewidth=2.4, label="estimate, by error")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(loc="best", fontsize=8, frameon=False)
    above.set_title(title, fontsize=11)
    above.set_xlabel(f"m, {note}", fontsize=9)
    figure.colorbar(lines, ax=above, label=f"position error, {unit}", fraction=0.045, pad=0.02)
    time_s = moments - moments[0]
    shown = np.insert(factor * errors, np.flatnonzero(_gaps(moments)) + 1, np.nan)
    at = np.insert(time_s, np.flatnonzero(_gaps(moments)) + 1, np.nan)
    below.plot(at, shown, color="#31688e", linewidth=1.2)
    below.axhline(factor * float(np.sqrt(np.mean(errors**2))), color=_MISSED, linewidth=1, linestyle="--", label="RMSE")
    below.set_ylim(bottom=0)
    below.set_xlim(0, max(float(time_s[-1]), 1e-9))
    below.set_xlabel("time, s", fontsize=9)
    below.set_ylabel(f"error, {unit}", fontsize=9)
    below.legend(loc="upper right", fontsize=8, frameon=False)
    return figure


def _gaps(moments: Array) -> NDArray[np.bool_]:
    """Return which steps are gaps in which there are no poses: over three times the usual step. Shape (P-1,)."""
    steps = np.diff(moments)
    return np.asarray(steps > 3 * np.median(steps))


def cloud_figure(
    clouds: tuple[Array, Array],
    distances: tuple[Array, Array],
    limit_m: float,
    title: str,
    page: tuple[Array, str],
) -> Figure:
    """Estimate and truth from above, every point in the colour of its distance to the other cloud.

    Points (N, 3) and (M, 3), distances (N,) and (M,), metres; the colours end at `limit_m`. `page` as of `page_axes`.
    """
    axes, note = page
    flat = [points @ axes.T for points in clouds]
    low, high = np.quantile(np.concatenate(flat), [0.001, 0.999], axis=0)
    margin = 0.03 * float(np.max(high - low)) + 1e-6
    ratio = float(np.clip((high - low + margin)[1] / max((high - low + margin)[0], 1e-9), 0.25, 1.6))
    figure, panels = _sheet(figsize=(11.0, 4.9 * ratio + 1.4), columns=2)
    drawn: Any = None
    names = ("estimate: distance to the truth (accuracy)", "truth: distance to the estimate (completeness)")
    for axis, points, xy, distance, name in zip(panels, clouds, flat, distances, names, strict=True):
        rows = np.arange(len(points))
        if len(rows) > _MOST_POINTS:
            rows = np.sort(np.random.default_rng(0).choice(rows, _MOST_POINTS, replace=False))
        rows = rows[np.argsort(points[rows] @ np.cross(*axes), kind="stable")]
        color = np.minimum(100 * distance[rows], 100 * limit_m)
        drawn = axis.scatter(
            *xy[rows].T, c=color, s=1.2, cmap="viridis", vmin=0, vmax=100 * limit_m, linewidths=0, rasterized=True
        )
        axis.set_aspect("equal")
        axis.set_xlim(low[0] - margin, high[0] + margin)
        axis.set_ylim(low[1] - margin, high[1] + margin)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel(f"m, {note}", fontsize=9)
    figure.colorbar(drawn, ax=list(panels), label="distance, cm", fraction=0.03, pad=0.02, extend="max")
    figure.suptitle(title, fontsize=11)
    return figure


def instances_figure(
    truth: dict[int, tuple[OrientedBox, str]],
    estimate: dict[int, tuple[OrientedBox, str]],
    matches: Sequence[tuple[int, int, float]],
    title: str,
) -> Figure:
    """Return a plan of boxes by id: true ones found green and missed red (filled), estimated ones outlined with their
    ids.

    `matches` are (true id, estimated id, IoU). False and duplicate estimates are grey.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    corners = [footprint(box) for box, _ in (*truth.values(), *estimate.values())]
    extent = np.ptp(np.concatenate(corners), axis=0) if corners else np.ones(2)
    ratio = float(np.clip(extent[1] / max(extent[0], 1e-9), 0.3, 1.3))
    figure, axis = _sheet(figsize=(9.5, 8.5 * ratio + 1.6))
    found, used = {t for t, _, _ in matches}, {e for _, e, _ in matches}
    for k in sorted(truth, key=lambda k: -float(np.prod(truth[k][0].size[:2]))):
        color = _FOUND if k in found else _MISSED
        outline = footprint(truth[k][0])
        axis.fill(*outline.T, facecolor=color, alpha=0.22, edgecolor=color, linewidth=1.0)
        if k not in found:
            _tag(axis, outline.mean(axis=0), f"{truth[k][1]} ({k})", _MISSED)
    for k in sorted(estimate, key=lambda k: -float(np.prod(estimate[k][0].size[:2]))):
        outline = footprint(estimate[k][0])
        color, style = (_FOUND, "-") if k in used else (_FALSE, "--")
        axis.plot(*np.vstack([outline, outline[:1]]).T, color=color, linewidth=1.3, linestyle=style)
        _tag(axis, outline[2], str(k), color)
    axis.set_aspect("equal")
    axis.set_title(title, fontsize=11)
    axis.set_xlabel("m, seen along -z", fontsize=9)
    handles = [
        Patch(facecolor=_FOUND, alpha=0.4, label=f"true, found ({len(found)})"),
        Patch(facecolor=_MISSED, alpha=0.4, label=f"true, missed ({len(truth) - len(found)})"),
        Line2D([], [], color=_FOUND, label="estimated, matched"),
        Line2D([], [], color=_FALSE, linestyle="--", label=f"estimated, false ({len(estimate) - len(used)})"),
    ]
    figure.legend(handles=handles, fontsize=8, loc="outside lower center", ncol=4, frameon=False)
    return figure


def _tag(axis: Axes, xy: Array, text: str, color: str) -> None:
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2, foreground="white")]
    axis.text(float(xy[0]), float(xy[1]), text, color=color, fontsize=7, ha="center", va="center", path_effects=halo)


def revisits_figure(
    frame: NDArray[np.int64], share: NDArray[np.float32], judged: RevisitJudgement, title: str
) -> Figure:
    """Return covisibility of all pairs of frames in grey; above the diagonal the loop candidates by verdict and truth.

    `frame` (F,) and directed shares (F, F) as in `Covisibility`.
    """
    figure, axis = _sheet(figsize=(8.0, 8.0))
    mutual = np.nan_to_num(np.minimum(share, share.T))
    edges = (float(frame[0]), float(frame[-1]))
    drawn = axis.imshow(mutual, cmap="Greys", vmin=0, vmax=1, extent=(*edges, *edges), origin="lower")
    c = judged.candidates
    pair = np.sort(c.frames, axis=1)
    for wanted, label, color, mark, name in (
        (True, 1, _FOUND, "o", "accepted, right"),
        (True, 0, _MISSED, "X", "accepted, wrong"),
        (True, -1, "#e0a030", "o", "accepted, open"),
        (False, 1, "#3573b9", "^", "rejected, yet a revisit"),
        (False, 0, "#5b6470", "v", "rejected, right"),
        (False, -1, "#e0a030", ".", "rejected, open"),
    ):
        rows = (c.accepted == wanted) & (judged.frame_labels == label)
        if rows.any():
            axis.scatter(
                pair[rows, 0],
                pair[rows, 1],
                s=34,
                color=color,
                marker=mark,
                label=f"{name} ({rows.sum()})",
                clip_on=False,
            )
    figure.colorbar(drawn, ax=axis, label="share of the surface seen in both frames", fraction=0.045, pad=0.02)
    axis.set_xlabel("frame", fontsize=9)
    axis.set_ylabel("frame", fontsize=9)
    axis.set_title(title, fontsize=11)
    if len(c.accepted):
        axis.legend(fontsize=8, loc="lower right")
    return figure


def _sheet(
    figsize: tuple[float, float], rows: int = 1, columns: int = 1, heights: tuple[float, ...] = (1.0,)
) -> tuple[Figure, Any]:
    """Return a page without a window behind it, and its panels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=figsize, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, gridspec_kw={"height_ratios": heights})
    for axis in np.ravel(panels):
        axis.tick_params(labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, panels

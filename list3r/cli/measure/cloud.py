"""eval cloud: the five measures of a cloud."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, print_table
from list3r.cli.measure.inputs import is_source, read_points, read_trajectory
from list3r.cli.measure.options import (
    Estimate,
    EveryOption,
    PlotOption,
    Scale,
    ScaleOption,
    Truth,
    check_plot,
    free_scale,
    save_picture,
)
from list3r.cli.terminal import say
from list3r.exporters.output import is_database
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from list3r.evaluation.cloud import CloudErrors
    from list3r.evaluation.point_clouds import PointCloud
    from list3r.evaluation.trajectory import Trajectory
    from list3r.memory.core.geometry import Sim3


def cloud(
    truth: Truth,
    estimate: Estimate,
    align: Annotated[
        list[str] | None,
        typer.Option(
            "--align",
            metavar="TRAJECTORY|icp|none",
            help="How to align the estimate: by its camera path, by its surfaces (ICP), or, given twice, by one after "
            "the other. Default: by the path if TRUTH is a source, else none.",
        ),
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option("--path", metavar="TRAJECTORY", help="Camera path of the estimate, if it is not a memory."),
    ] = None,
    scale: ScaleOption = "auto",
    threshold: Annotated[float, typer.Option("--threshold", help="Distance threshold of the F-score, metres.")] = 0.05,
    truncate: Annotated[
        float | None, typer.Option("--truncate", help="Cap each distance at this, metres; default: no cap.")
    ] = None,
    voxel: Annotated[
        float, typer.Option("--voxel", help="Thin both clouds to one point per cell of this size, metres; 0: keep all.")
    ] = 0.01,
    points: Annotated[int, typer.Option("--points", help="Most points of either cloud, drawn at random.")] = 1_000_000,
    every: EveryOption = None,
    plot: PlotOption = None,
    json: JsonOption = False,
) -> None:
    """Accuracy, completeness, Chamfer, normal consistency, F-score. TRUTH: a cloud or mesh, a memory, or a source with
    depth and poses; ESTIMATE: a cloud or a memory (all supports of its instances and surfaces, in the world).

    Example: list3r eval cloud truth.ply house.l3r --align walk/groundtruth.txt --plot cloud.png
    """
    from list3r.evaluation.cloud import cloud_distances, evaluate_cloud
    from list3r.evaluation.point_clouds import thinned

    check_plot(plot)
    _check_lengths(threshold=threshold, truncate=truncate)
    found, _ = read_points(estimate)
    true, true_path = read_points(truth, every)
    true = thinned(true, voxel, points)
    true = replace(true, normals=_normals(true))
    S_truth_estimate, how = _cloud_alignment(align, scale, (true, true_path, truth), (found, path or estimate))
    found = thinned(found.moved(S_truth_estimate), voxel, points)
    distances = cloud_distances(true.points, found.points)
    errors = evaluate_cloud(true.points, found.points, (true.normals, _normals(found)), threshold, truncate, distances)
    if plot is not None:
        title = (
            f"{estimate.name} against {truth.name}: Chamfer {errors.chamfer_cm:.2f} cm, F {100 * errors.f_score:.1f} %"
        )
        gaps = (distances.to_truth, distances.to_estimate)
        save_picture(_figure(found, true, gaps, 2 * threshold, title, true_path), plot)
    if json:
        used = {"truth": true.text, "estimate": found.text, "alignment": how, "voxel_m": voxel}
        counts = {"truth_points": len(true.points), "estimate_points": len(found.points)}
        print_answer([{**errors.as_dict(), **used, **counts, "scale": float(S_truth_estimate.scale)}])
        return
    say(f"truth     {true.text}; {len(true.points):,} compared")
    say(f"estimate  {found.text}; {len(found.points):,} compared")
    say(f"aligned   {how}")
    _print_errors(errors)


def _print_errors(errors: CloudErrors) -> None:
    consistency = "-" if errors.normal_consistency is None else f"{errors.normal_consistency:.3f}"
    shares = f"precision {100 * errors.precision:.2f}, recall {100 * errors.recall:.2f}"
    rows = [
        ["accuracy", f"{errors.accuracy_cm:.3f} cm", f"median {errors.accuracy_median_cm:.3f}"],
        ["completeness", f"{errors.completeness_cm:.3f} cm", f"median {errors.completeness_median_cm:.3f}"],
        ["Chamfer distance", f"{errors.chamfer_cm:.3f} cm", "mean of the two"],
        ["normal consistency", consistency, "mean |cosine|, both ways"],
        [f"F at {errors.threshold_cm:g} cm", f"{100 * errors.f_score:.2f} %", shares],
    ]
    print_table(rows, ["measure", "value", ""])


def _figure(
    found: PointCloud,
    true: PointCloud,
    distances: tuple[Any, Any],
    limit_m: float,
    title: str,
    true_path: Trajectory | None,
) -> Figure:
    from list3r.evaluation.figures import UPRIGHT, cloud_figure, page_axes

    page = UPRIGHT if true_path is None else page_axes(true_path.T_world_cam)
    return cloud_figure((found.points, true.points), distances, limit_m, title, page)


def _cloud_alignment(
    align: list[str] | None,
    scale: Scale,
    truth: tuple[PointCloud, Trajectory | None, Path],
    estimate: tuple[PointCloud, Path],
) -> tuple[Sim3, str]:
    """S_truth_estimate, and how it was found."""
    from list3r.evaluation.icp import IcpSettings, register
    from list3r.evaluation.scene import alignment_of
    from list3r.memory.core.geometry import Sim3

    (true, true_path, source), (found, estimate_path) = truth, estimate
    by_source = align is None and is_source(source) and true_path is not None
    chosen = align or (["path"] if by_source else ["none"])
    free = free_scale(scale, estimate_path)
    kind = "Sim(3)" if free else "SE(3)"
    S, steps = Sim3.identity(), []
    for word in chosen:
        if word == "none":
            continue
        if word == "icp":
            near = found.moved(S).points
            S = register(true.points, _normals(true), near, with_scale=free, settings=IcpSettings()) @ S
            steps.append(f"{kind} by point-to-plane ICP")
            continue
        if not is_database(estimate_path) and not estimate_path.suffix.lower() == ".txt":
            raise OptionError(f"--align {word}: {estimate_path} has no camera path; give one with --path")
        goal = true_path if by_source and true_path is not None else read_trajectory(Path(word))
        S = alignment_of(goal, read_trajectory(estimate_path), with_scale=free)
        steps.append(f"{kind} by the camera's path")
    if not steps:
        return S, "not: both are in one frame of reference"
    return S, f"{', then '.join(steps)}; scale {float(S.scale):.4f}"


def _normals(points: PointCloud) -> Any:
    from list3r.evaluation.point_clouds import estimate_normals

    return estimate_normals(points.points) if points.normals is None else points.normals


def _check_lengths(**lengths: float | None) -> None:
    for name, value in lengths.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise OptionError(f"--{name} {value:g}: give a length above 0, in metres")

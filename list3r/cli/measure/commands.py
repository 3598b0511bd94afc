"""eval trajectory, cloud, instances, revisits: results against truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, open_memory, print_table
from list3r.cli.measure.cloud import cloud
from list3r.cli.measure.inputs import align_by_path, mask_frames, read_scene_of, read_trajectory
from list3r.cli.measure.options import (
    Estimate,
    PlotOption,
    ScaleOption,
    Truth,
    check_plot,
    free_scale,
    save_picture,
    share,
)
from list3r.cli.measure.revisits import revisits
from list3r.cli.terminal import say
from list3r.exporters.output import is_database
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from list3r.evaluation.trajectory import Trajectory
    from list3r.memory.core.geometry import Sim3


# ---------------------------------------------------------------------------------------------- trajectory


def trajectory(
    truth: Truth,
    estimate: Estimate,
    delta: Annotated[
        str, typer.Option("--delta", help="Distance between the poses that RPE compares: 10 (frames), 0.5m or 2s.")
    ] = "1",
    tolerance: Annotated[
        float, typer.Option("--tolerance", min=0.0, help="Largest time difference of associated poses, seconds.")
    ] = 0.01,
    scale: ScaleOption = "auto",
    plot: PlotOption = None,
    json: JsonOption = False,
) -> None:
    """ATE and RPE of a trajectory. TRUTH and ESTIMATE: a file (TUM, EuRoC, KITTI), a memory, or a source with poses.

    Example: list3r eval trajectory walk/groundtruth.txt house.l3r --delta 1m --plot path.png
    """
    from list3r.evaluation.trajectory import Delta, evaluate_trajectory

    check_plot(plot)
    apart = Delta.parse(delta)
    true, found = read_trajectory(truth), read_trajectory(estimate)
    errors = evaluate_trajectory(true, found, tolerance, delta=apart)
    if plot is not None:
        free = free_scale(scale, estimate)
        save_picture(
            _trajectory_figure(true, found, tolerance, f"{estimate.name} against {truth.name}", free=free), plot
        )
    scores = errors.as_dict()
    if json:
        print_answer([scores])
        return
    covered = errors.covered
    say(f"{errors.pairs} poses associated; scale {errors.scale:.4f}; RPE over {apart}")
    gaps = f"{covered.gaps} gap{'s' * (covered.gaps != 1)}, the longest stretch without poses"
    missing = "" if covered.longest_gap_s == 0 else f"; {gaps} {covered.longest_gap_s:.2f} s"
    say(f"the estimate covers {100 * covered.truth:.1f} % of the truth's time{missing}")
    if errors.coverage < 1:
        say(f"{100 * errors.coverage:.1f} % of its poses have a true one within {tolerance:g} s")
    names = ("ate_se3_m", "ate_sim3_m", "rpe_translation_m", "rpe_translation_sim3_m", "rpe_rotation_deg")
    keys = ("rmse", "mean", "median", "std", "max")
    print_table([[name, *[f"{scores[name][key]:.4f}" for key in keys]] for name in names], ["", *keys])


def _trajectory_figure(truth: Trajectory, estimate: Trajectory, tolerance: float, title: str, *, free: bool) -> Figure:
    from list3r.evaluation.figures import trajectory_figure
    from list3r.evaluation.trajectory import align, associated, position_errors

    a, b = associated(truth, estimate, tolerance)
    S_truth_estimate = align(a, b, with_scale=free)
    errors = position_errors(a, b, S_truth_estimate)
    kind = f"Sim(3), scale {float(S_truth_estimate.scale):.4f}" if free else "SE(3)"
    title_text = f"{title}\nATE {float((errors**2).mean() ** 0.5):.4f} m RMSE over {len(errors)} poses, {kind}"
    return trajectory_figure(truth, b.time_s, S_truth_estimate.apply(b.positions()), errors, title_text)


# ---------------------------------------------------------------------------------------------- instances


def instances(
    truth: Truth,
    estimate: Estimate,
    align: Annotated[
        str | None,
        typer.Option(
            "--align",
            metavar="TRAJECTORY|none",
            help="True camera path, by which a memory is aligned. Default: groundtruth.txt next to TRUTH, if present.",
        ),
    ] = None,
    scale: ScaleOption = "auto",
    ids: Annotated[
        Path | None,
        typer.Option(
            "--ids",
            metavar="FOLDER",
            help="Folder with images of true ids, to count the id switches of a memory. Default: ids/ next to TRUTH.",
        ),
    ] = None,
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Compare ids in every N-th frame.")] = 1,
    plot: PlotOption = None,
    json: JsonOption = False,
) -> None:
    """Recall, precision, duplicates, merges, id switches; relations. TRUTH: a truth.json; ESTIMATE: a memory or scene
    JSON.

    Example: list3r eval instances walk/truth.json rooms.l3r --plot found.png
    """
    from list3r.evaluation.scene import evaluate_scene, read_scene

    if align not in (None, "none") and estimate.is_file() and not is_database(estimate):
        raise OptionError(f"--align {align} aligns a memory; {estimate} is not one and has no camera path")
    check_plot(plot)
    true, found = read_scene(truth), read_scene_of(estimate)
    groundtruth = truth.parent / "groundtruth.txt"
    if align is None and is_database(estimate) and groundtruth.is_file():
        align = str(groundtruth)
    free = free_scale(scale, estimate)
    S_truth_scene = None if align in (None, "none") else align_by_path(Path(str(align)), estimate, free=free)
    scores = evaluate_scene(found, true, S_truth_scene)
    scores["identities"] = _identities(true, truth, estimate, ids, every)
    if plot is not None:
        save_picture(
            _instances_figure(true, found, scores, S_truth_scene, f"{estimate.name} against {truth.name}"), plot
        )
    if json:
        print_answer([scores])
        return
    if S_truth_scene is not None:
        say(f"placed by the camera's path in {align}, scale {float(S_truth_scene.scale):.4f}")
    print_table(score_rows(scores), ["", "recall", "precision", "more"])
    for missed in scores["missed"]:
        say(f"missed: {missed['label']} ({missed['id']})")
    identities = scores["identities"]
    if identities is not None:
        say(f"{identities['switches']} id switches of {identities['objects']} objects in {identities['frames']} frames")
        labels = {int(e["id"]): e.get("label") for e in true["instances"]}
        for k, several in identities["several_ids"].items():
            say(f"several ids: {labels.get(k)} ({k}) was {', '.join(map(str, several))}")


def _identities(
    true: dict[str, Any], truth: Path, estimate: Path, ids: Path | None, every: int
) -> dict[str, Any] | None:
    """Id switches, None where there are no true ids of pixels or the estimate has no masks."""
    from list3r.evaluation.identity import evaluate_identities

    folder = ids or truth.parent / "ids"
    if ids is not None and not ids.is_dir():
        raise OptionError(f"--ids {ids} is not a folder; give the folder with one picture of true ids per frame")
    if not is_database(estimate):
        if ids is not None:
            raise OptionError(f"--ids: {estimate} has no masks; id switches are measured on a memory")
        return None
    if not folder.is_dir():
        return None
    wanted = {int(e["id"]) for e in true["instances"] if not e.get("structure")}
    with open_memory(estimate) as scene:
        return evaluate_identities(mask_frames(scene.store, folder, every), wanted).as_dict()


def _instances_figure(
    true: dict[str, Any], found: dict[str, Any], scores: dict[str, Any], S_truth_scene: Sim3 | None, title: str
) -> Figure:
    from list3r.evaluation.figures import instances_figure
    from list3r.evaluation.scene import scene_boxes

    labels = {int(e["id"]): str(e.get("label") or e.get("description") or "") for e in true["instances"]}
    matches = scores["matched_ids"]
    counted = {t for t, _, _ in matches} | {m["id"] for m in scores["missed"]}
    true_boxes = {k: (box, labels[k]) for k, box in scene_boxes(true).items() if k in counted}
    boxes = {k: (box, "") for k, box in scene_boxes(found, S_truth_scene).items()}
    loose = scores["instances_0.25"]
    title_text = f"{title}: recall {loose['recall']:.2f}, precision {loose['precision']:.2f} at IoU 0.25"
    return instances_figure(true_boxes, boxes, matches, title_text)


def score_rows(scores: dict[str, Any]) -> list[list[object]]:
    """Rows (what, recall, precision, more) of the scores of a scene."""
    rows: list[list[object]] = []
    for threshold in ("0.25", "0.50"):
        entry = scores[f"instances_{threshold}"]
        more = f"{entry['duplicates']} duplicates, {entry['merged_pairs']} merged pairs"
        rows.append([f"objects at IoU {threshold}", share(entry["recall"]), share(entry["precision"]), more])
    for name, entry in scores["relations"]["by_predicate"].items():
        rows.append([f"{name}, of matched objects", share(entry["recall"]), share(entry["precision"]), ""])
    return rows


measures = typer.Typer(help="Compare a result with ground truth.", no_args_is_help=True, rich_markup_mode=None)
for command in (trajectory, cloud, instances, revisits):
    measures.command(command.__name__)(command)

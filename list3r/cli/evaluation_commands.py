"""eval trajectory, instances: results against truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.common import JsonOption, open_memory, print_json, print_table

if TYPE_CHECKING:
    from list3r.evaluation.trajectory import Trajectory

Truth = Annotated[Path, typer.Argument(metavar="TRUTH", show_default=False)]
Estimate = Annotated[Path, typer.Argument(metavar="ESTIMATE", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    group = typer.Typer(help="Measure a result against truth.", no_args_is_help=True, rich_markup_mode=None)
    group.command("trajectory")(trajectory)
    group.command("instances")(instances)
    app.add_typer(group, name="eval")


def trajectory(
    truth: Truth,
    estimate: Estimate,
    delta: Annotated[int, typer.Option("--delta", help="Distance of the poses that RPE relates, frames.")] = 1,
    tolerance: Annotated[float, typer.Option("--tolerance", help="Greatest gap of associated times, seconds.")] = 0.01,
    json: JsonOption = False,
) -> None:
    """ATE and RPE of a trajectory. TRUTH and ESTIMATE: a TUM file, a memory, or a source with poses.

    Example: list3r eval trajectory walk/groundtruth.txt house.l3r
    """
    from list3r.evaluation.trajectory import evaluate_trajectory

    errors = evaluate_trajectory(_trajectory(truth), _trajectory(estimate), tolerance, delta).as_dict()
    if json:
        print_json(errors)
        return
    print(f"{errors['pairs']} poses associated; scale {errors['scale']:.4f}; RPE over {delta} frame(s)")
    names = ("ate_se3_m", "ate_sim3_m", "rpe_translation_m", "rpe_rotation_deg")
    keys = ("rmse", "mean", "median", "std", "max")
    print_table([[name, *[f"{errors[name][key]:.4f}" for key in keys]] for name in names], ["", *keys])


def instances(
    truth: Truth,
    estimate: Estimate,
    truth_trajectory: Annotated[
        Path | None, typer.Option("--align", metavar="TRAJECTORY", help="True trajectory, to place a memory by.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Recall, precision, duplicates of instances and relations. TRUTH: a truth.json; ESTIMATE: a memory or scene JSON.

    Example: list3r eval instances walk/truth.json rooms.l3r --align walk/groundtruth.txt
    """
    from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene

    S_truth_scene = None
    if truth_trajectory is not None:
        S_truth_scene = alignment_of(_trajectory(truth_trajectory), _trajectory(estimate), with_scale=False)
    scores = evaluate_scene(_scene(estimate), read_scene(truth), S_truth_scene)
    if json:
        print_json(scores)
        return
    print_table(score_rows(scores), ["", "recall", "precision", "more"])
    for missed in scores["missed"]:
        print(f"missed: {missed['label']} ({missed['id']})")


def score_rows(scores: dict[str, Any]) -> list[list[object]]:
    """Rows (what, recall, precision, more) of the scores of a scene."""
    rows: list[list[object]] = []
    for threshold in ("0.25", "0.50"):
        entry = scores[f"instances_{threshold}"]
        more = f"{entry['duplicates']} duplicates, {entry['merged_pairs']} merged pairs"
        rows.append([f"things at IoU {threshold}", _share(entry["recall"]), _share(entry["precision"]), more])
    for name, entry in scores["relations"]["by_predicate"].items():
        rows.append([f"{name}, of matched things", _share(entry["recall"]), _share(entry["precision"]), ""])
    return rows


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _is_memory(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(16) == b"SQLite format 3\x00"


def _scene(path: Path) -> dict[str, Any]:
    from list3r.evaluation.scene import read_scene
    from list3r.exporters.scene_json import scene_dict

    if not _is_memory(path):
        return read_scene(path)
    with open_memory(path) as scene:
        return scene_dict(scene.store)


def _trajectory(path: Path) -> Trajectory:
    from list3r.evaluation.trajectory import read_tum

    if path.is_dir() or path.suffix.lower() in (".mp4", ".mov", ".mkv", ".webm"):
        return _given(path)
    return _stored(path) if _is_memory(path) else read_tum(path)


def _stored(path: Path) -> Trajectory:
    import numpy as np

    from list3r.evaluation.trajectory import Trajectory
    from list3r.memory.errors import OptionError

    with open_memory(path) as scene:
        poses = scene.store.camera_poses()
    if not poses:
        raise OptionError(f"{path} has no frame with a pose; finish its build with --resume")
    return Trajectory(np.array([f.time_s for f, _ in poses]), np.stack([S.as_matrix() for _, S in poses]))


def _given(path: Path) -> Trajectory:
    """The poses that come with a source."""
    import numpy as np

    from list3r.evaluation.trajectory import Trajectory
    from list3r.frames.base import Frame
    from list3r.frames.source import open_source
    from list3r.memory.errors import OptionError

    source = open_source(path)
    if not source.info.has_poses:
        raise OptionError(f"{path} has no poses; give a TUM trajectory file, a memory, or a source with poses")
    frames = [f for f in source.read(0, source.info.frame_count) if isinstance(f, Frame) and f.T_source_cam is not None]
    poses = [f.T_source_cam for f in frames if f.T_source_cam is not None]
    return Trajectory(np.array([f.time_s for f in frames]), np.stack(poses))

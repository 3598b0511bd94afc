"""The demo: a simulated walk, its memory, questions, exports, and the score against the known truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from list3r.api import SceneMemory
from list3r.cli.bar import progress_bar
from list3r.cli.build.progress import build_interrupted, report_lines, watching
from list3r.cli.common import open_memory, print_table
from list3r.cli.measure.commands import score_rows
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import BuildRequest, RunOptions

EXPORTS = (("json", "json"), ("usd", "usdc"), ("plan", "png"), ("glb", "glb"), ("ply", "ply"), ("tum", "txt"))


def run_demo(out: Path, *, seed: int, frames: int | None, workers: int | None, quiet: bool) -> dict[str, Any]:
    """Make `out/walk`, `out/rooms.l3r` and the exports next to it; returns the results, for JSON."""
    from list3r.pipeline.target import make_folder

    make_folder(out)
    walk, memory = out / "walk", out / "rooms.l3r"
    say(f"1. a simulated walk through two furnished rooms, seed {seed}: {walk}")
    _render(walk, seed=seed, frames=frames, workers=workers, quiet=quiet)
    say("", f"2. list3r build {walk} -m {memory} --poses estimate")
    from list3r.pipeline.build import build

    request, run = BuildRequest(poses="estimate"), RunOptions(workers=workers, resume=memory.exists())
    interrupted = build_interrupted(memory, run.resume)
    with watching("building", interrupted, quiet=quiet, notes=False) as watch:
        report = build(walk, memory, settings=request, run=run, watch=watch)
    say(*report_lines(memory, report))
    with open_memory(memory) as scene:
        _ask(scene, memory)
        written = _export(scene, out)
        scores = _score(out, walk)
    say("", f"A picture of the result: {written['plan']}")
    return {"memory": str(memory), "walk": str(walk), "build": report.as_dict(), "exports": written, "scores": scores}


def _render(walk: Path, *, seed: int, frames: int | None, workers: int | None, quiet: bool) -> None:
    from list3r.pipeline.workers import default_workers
    from list3r.simulation.dataset import WalkSettings, write_walk

    settings = WalkSettings(seed=seed, frames=frames)
    done = walk / "made.json"
    made = {"seed": seed, "frames": frames}
    if done.exists():
        if json.loads(done.read_text(encoding="utf-8")) == made:
            return
        raise OptionError(f"{walk} holds another walk; name another folder with --out, or remove it")
    if walk.exists():
        _remove_unfinished(walk)
    count, rendered = len(settings.poses()[0]), 0
    with progress_bar("rendering", "frames", quiet=quiet) as bar:

        def progress(more: int) -> None:
            nonlocal rendered
            rendered += more
            bar.show(rendered, count)

        write_walk(walk, settings, workers=workers or default_workers(), progress=progress)
    done.write_text(json.dumps(made), encoding="utf-8")


def _remove_unfinished(walk: Path) -> None:
    """Delete leftovers of an interrupted demo: only files and folders that the simulation writes."""
    for name in ("rgb", "depth", "ids"):
        shutil.rmtree(walk / name, ignore_errors=True)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "truth.json"):
        (walk / name).unlink(missing_ok=True)


def _ask(scene: SceneMemory, memory: Path) -> None:
    objects = scene.instances()
    names = {i.id: i.label or i.description for i in scene.instances(structure=None)}
    say("", f"3. list3r list {memory}")
    print_table([[i.id, names[i.id], i.confidence] for i in objects], ["id", "what", "confidence"])
    say("", f"4. list3r relations {memory} --predicate on")
    rows = [[names[r.subject], "on", names[r.object], r.confidence] for r in scene.relations(predicate="on")]
    print_table(rows, ["subject", "", "object", "confidence"])
    if not objects:
        return
    first = min(objects, key=lambda i: float(i.box.size.prod()))
    say("", f"5. list3r nearest {memory} {first.id} -k 3        (nearest to the {names[first.id]})")
    matches = scene.nearest(first.id, k=3)
    print_table([[m.instance.id, names[m.instance.id], m.distance_m] for m in matches], ["id", "what", "surface (m)"])


def _export(scene: SceneMemory, out: Path) -> dict[str, str]:
    say("", "6. exports")
    written = {}
    for name, suffix in EXPORTS:
        path = out / f"rooms.{suffix}"
        scene.export(name, path)
        written[name] = str(path)
        say(f"   {name:5} {path}  {path.stat().st_size / 1e6:.2f} MB")
    return written


def _score(out: Path, walk: Path) -> dict[str, Any]:
    """The truth of a simulated walk is known, so say how far the memory is from it."""
    from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene
    from list3r.evaluation.trajectory import evaluate_trajectory, read_tum

    truth, estimate = read_tum(walk / "groundtruth.txt"), read_tum(out / "rooms.txt")
    errors = evaluate_trajectory(truth, estimate)
    S_truth_scene = alignment_of(truth, estimate, with_scale=False)
    scene = evaluate_scene(read_scene(out / "rooms.json"), read_scene(walk / "truth.json"), S_truth_scene)
    say("", "7. against the known truth")
    say(f"   camera    {errors.ate_se3_m.rmse * 100:.1f} cm RMSE over {errors.pairs} frames, SE(3) alignment")
    print_table([["  ", *row] for row in score_rows(scene)], ["", "", "recall", "precision", ""])
    return {"trajectory": errors.as_dict(), "scene": scene}

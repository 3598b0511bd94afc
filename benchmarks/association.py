"""Association on simulated videos with known truth: VGGT-Long, the paper's steps, and ours, one row each.

python benchmarks/association.py --presets kidnap,twins --seeds 1,2,3 --json FILE [--plot FILE]
python benchmarks/association.py --quick --json FILE        # two presets, two seeds, all rows

An interrupted run resumes with the same `--json` and commit.

The presets opposite, night, alike, moved, halls and seasons are videos that return to a place of changed appearance
(`benchmarks.simulation.returns`), with masks as of discovery in unseen homes. The simulated network aligns places
without shared surface by look-alike objects, which is right where they are the same objects; with `--joint surfaces` it
aligns only shared surfaces, and else assumes a still camera.

Every video goes through the real pipeline (`mapping.add_chunk` on a real memory file); only the reconstruction model
and the instance tracker are simulated (`benchmarks.feedforward_sim.feedforward`). All rows get the same video, chunks,
descriptors and joint windows, and chunks end at cuts in all of them but the first:

- vggt-long: as published, `benchmarks/peers/vggt_long.py`, which detects no cuts;
- vggt-long-cuts: the same on chunks that end at cuts;
- paper: `--association paper`, all of the paper's steps as it writes them (`list3r/association/paper`);
- frames: `--association frames`, the product's rule without any instance, by VGGT-Long's threshold and alignment;
- ilrd-paper: loops accepted by s_loop alone, all else as `ilrd`;
- verified: loops proposed by frame similarity and verified by geometry, no instance anywhere;
- ilrd: + instances rank candidates and reject relations;
- iasm-paper: instance-aware merging as in the paper: instances with a large delta(o) are removed, and the support is
  sampled by confidence and coverage;
- iasm: the instance-aware support of builds instead;
- cwgo-paper: iasm with the paper's weights of edges in the graph;
- graph: iasm with covariances as weights and switchable loops;
- full: + nodes within chunks, as in builds;
- full-no-instances: full with all instance evidence off (no `s_sem` and `s_rel`, no layout, no kinds, no registration
  by objects), the same estimator on points whose instance labels are erased: the difference of the two is the value of
  instances.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import STARTED_AT, machine, write_json
from numpy.typing import NDArray

from list3r.pipeline.workers import OrderedPool

Array = NDArray[np.float64]
PRESETS = ("calm", "loop", "kidnap", "dynamic", "twins", "sparse", "corridor")
RETURNS = ("opposite", "night", "alike", "moved", "halls", "seasons")
TITLES = {
    "vggt-long": "VGGT-Long as published",
    "vggt-long-cuts": "VGGT-Long, cuts given",
    "paper": "the paper as written",
    "frames": "frames alone (product)",
    "ilrd-paper": "loops by s_loop alone (paper)",
    "verified": "verified loops, no instances",
    "ilrd": "+ instances in loops (ILRD)",
    "iasm-paper": "IASM as the paper writes it",
    "iasm": "+ instance-aware support (IASM)",
    "cwgo-paper": "IASM, the paper's weights",
    "graph": "+ covariances, robust (CWGO)",
    "full": "+ nodes within chunks (full)",
    "full-no-instances": "full, instances off",
}
VARIANTS = tuple(TITLES)
FALSE_M = 0.5
"""A loop with a camera error above this is false; chunks are deformed by a few centimetres."""
SHOWN = ("ate_sim3_m", "rte_m", "rre_deg", "completeness_cm", "chamfer_cm", "f_at_5cm", "false_loops", "worst_loop_m")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--seeds", default="1,2,3,4,5,6,7,8")
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--joint", choices=("look-alikes", "surfaces"), default="look-alikes")
    parser.add_argument("--quick", action="store_true", help="presets kidnap and twins, seeds 1 and 2")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path, help="picture of the table: ATE of every seed by preset and variant")
    args = parser.parse_args()
    if args.quick:
        args.presets, args.seeds = "kidnap,twins", "1,2"
    presets, variants = args.presets.split(","), args.variants.split(",")
    for given, known in ((presets, (*PRESETS, *RETURNS)), (variants, TITLES)):
        if unknown := sorted(set(given) - set(known)):
            parser.error(f"unknown: {', '.join(unknown)}; choose from {', '.join(known)}")
    rows = _resumed(args.json)
    done_jobs = {(r["preset"], r["seed"]) for r in rows}
    jobs = [(preset, int(seed), tuple(variants), args.joint) for seed in args.seeds.split(",") for preset in presets]
    jobs = [job for job in jobs if job[:2] not in done_jobs]
    with OrderedPool(run_video, args.workers) as pool:
        for done in pool.map(jobs):
            rows += done
            ates = "  ".join(f"{r['variant']} {r['ate_sim3_m']:.3f}" for r in done)
            print(f"{done[0]['preset']} seed {done[0]['seed']}: ATE m  {ates}", flush=True)
            write_json(args.json, {"unfinished": True, "joint": args.joint, "runs": rows})
    judgements = [(r["preset"], r["variant"], _judgement(r.pop("judgement"))) for r in rows]
    summary = summarise(rows, presets, variants)
    print_tables(summary, presets, variants)
    revisits = revisit_table(judgements, presets, "full" if "full" in variants else variants[-1])
    print(machine())
    write_json(args.json, {"joint": args.joint, "summary": summary, "revisits": revisits, "runs": rows})
    if args.plot is not None:
        plot(args.plot, rows, presets, variants)


def _resumed(path: Path | None) -> list[dict[str, Any]]:
    """The rows of an unfinished run of this commit."""
    if path is None or not path.exists():
        return []
    found = json.loads(path.read_text(encoding="utf-8"))
    return list(found["runs"]) if found.get("unfinished") and found.get("commit") == STARTED_AT else []


def _plain_judgement(judged: Any) -> dict[str, Any]:
    """Ground truth of the candidates of a video, for JSON."""
    c = judged.candidates
    return {
        "chunks": c.chunks.tolist(),
        "frames": c.frames.tolist(),
        "accepted": c.accepted.tolist(),
        "s_det": np.nan_to_num(c.scores.get("s_det", np.full(len(c.accepted), np.nan)), nan=-1.0).round(4).tolist(),
        "frame_labels": judged.frame_labels.tolist(),
        "chunk_labels": judged.chunk_labels.tolist(),
        "true_pairs": sorted(judged.true_pairs),
    }


def _judgement(plain: dict[str, Any]) -> Any:
    """The judgement of `_plain_judgement`."""
    from list3r.evaluation.revisits import Candidates, RevisitJudgement

    candidates = Candidates(
        chunks=np.array(plain["chunks"], np.int64).reshape(-1, 2),
        frames=np.array(plain["frames"], np.int64).reshape(-1, 2),
        accepted=np.array(plain["accepted"], bool),
        scores={"s_det": np.where(np.array(plain["s_det"]) < 0, np.nan, np.array(plain["s_det"]))},
    )
    labels = [np.array(plain[key], np.int8) for key in ("frame_labels", "chunk_labels")]
    return RevisitJudgement(candidates, labels[0], labels[1], frozenset((u, v) for u, v in plain["true_pairs"]))


def run_video(job: tuple[str, int, Sequence[str], str]) -> list[dict[str, Any]]:
    """All variants on one simulated video."""
    from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
    from benchmarks.simulation.presets import make_video
    from benchmarks.simulation.returns import make_return

    preset, seed, variants, joint_by = job
    video = make_return(preset, seed) if preset in RETURNS else make_video(preset, seed)
    errors = FeedForwardSettings.unseen_home(preset == "halls") if preset in RETURNS else FeedForwardSettings()
    if joint_by == "surfaces":
        errors = replace(errors, poses=replace(errors.poses, alike_least_score=float("inf")))
    model = FeedForwardModel(video, errors, seed=seed)
    return run_variants(video, model, variants, most_deg=180.0 if preset in RETURNS else None)


def run_variants(
    video: Any, model: Any, variants: Sequence[str], *, most_deg: float | None = None, length: Any = None
) -> list[dict[str, Any]]:
    """Variants on one video and what a network makes of it, in chunks of a `length` (`ChunkSettings`)."""
    from benchmarks.feedforward_sim.cuts import cuts_by_descriptor
    from benchmarks.shared_work import SharedWork
    from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks

    truth = _Truth(video, most_deg)
    work = SharedWork()
    joint = work.joint(model)
    cuts = cuts_by_descriptor(model.descriptors)
    chunks: dict[Any, Any] = {}
    rows = []
    for variant in variants:
        spans = plan_chunks(len(video.time_s), length or ChunkSettings(), () if variant == "vggt-long" else cuts)
        for span in spans:
            if span not in chunks:
                chunks[span] = model.chunk(span)
        started = time.process_time()
        with work.used():
            row = run_variant(variant, [chunks[s] for s in spans], model, joint, truth)
        seconds = round(time.process_time() - started, 2)
        rows.append({"preset": video.preset, "seed": video.seed, "variant": variant, "cpu_s": seconds, **row})
    return rows


def variant_settings(variant: str) -> Any:
    """Return the product's settings with the parts that a variant lacks switched off."""
    from list3r.association.graph.edge_information import WeightSettings
    from list3r.pipeline.settings import ASSOCIATIONS, AssociationSettings

    if variant in ASSOCIATIONS:
        return AssociationSettings.by_method(variant)
    full = AssociationSettings()
    methods = {"verified": "plain", "ilrd-paper": "plain", "ilrd": "plain", "iasm-paper": "paper"}
    edges = replace(full.edges, method=methods.get(variant, "instances"))
    loops = _without_instances(full.revisits) if variant in ("verified", "full-no-instances") else full.revisits
    if variant == "ilrd-paper":
        loops = replace(loops, rule="score")
    rule = "confidence" if variant == "cwgo-paper" else "equal"
    simple = replace(full.graph, weights=WeightSettings(rule=rule), robust=False)
    return AssociationSettings(
        revisits=replace(loops, window=replace(loops.window, edges=edges)),
        edges=edges,
        graph=full.graph if variant in ("graph", "full", "full-no-instances") else simple,
        nodes=full.nodes if variant.startswith("full") else replace(full.nodes, enabled=False),
    )


def _without_instances(revisits: Any) -> Any:
    """Return settings under which as many candidates are verified, ranked by frame similarity alone."""
    cross = replace(revisits.window.cross, least_kinds=10**6)
    return replace(
        revisits,
        lambda_=1.0,
        layout_pairs=10**6,
        instances=replace(revisits.instances, enabled=False),
        window=replace(revisits.window, cross=cross),
    )


def run_variant(variant: str, results: Sequence[Any], model: Any, joint: Any, truth: _Truth) -> dict[str, Any]:
    """Build a memory of the chunks (placed only) and measure it."""
    from list3r.association.overlap.motion import flag_dynamic
    from list3r.frames.base import Camera
    from list3r.memory.store.store import Store
    from list3r.pipeline.mapping import add_chunk, finish_session

    settings = variant_settings(variant)
    peer = variant.startswith("vggt-long")
    with tempfile.TemporaryDirectory() as scratch, Store.create(Path(scratch) / "memory.l3r") as store:
        with store.transaction():
            store.facts.scale_kind = "relative"
            store.facts.gravity = "unknown"
            store.facts.poses = "estimate"
            session = store.sessions.add("simulation", "", {}, truth.frames)
        if peer:
            _place_as_vggt_long(store, session, results, model.descriptors, joint)
        for result in () if peer else results:
            chunk = result
            if variant == "full-no-instances":
                chunk = _unlabelled(chunk)
            elif settings.edges.method == "instances":
                height, width = result.image_size
                camera = Camera(width, height, *result.intrinsics)
                chunk = replace(result, library=flag_dynamic(result.samples, result.library, camera))
            add_chunk(store, session, chunk, joint, settings, library=False)
        if not peer:
            finish_session(store, session, settings, library=False)
        return truth.measure(store)


def _unlabelled(chunk: Any) -> Any:
    """A chunk whose points and library tell of no instance."""
    samples = replace(chunk.samples, instance=np.full_like(chunk.samples.instance, -1))
    return replace(chunk, samples=samples, library=replace(chunk.library, instances=()))


def _place_as_vggt_long(store: Any, session: int, results: Sequence[Any], descriptors: Any, joint: Any) -> None:
    """Store the chunks where VGGT-Long places them, with its loops as edges."""
    from benchmarks.peers.vggt_long import place
    from list3r.memory.core.records import Edge

    placed, loops, _ = place(results, descriptors, joint)
    with store.transaction():
        ids = [store.chunks.add(session, result) for result in results]
        edges = []
        for loop in loops:
            w = loop.window
            ends = ((ids[w.chunk_b], w.frames_b), (ids[w.chunk_a], w.frames_a))
            (u, frames_u), (v, frames_v) = ends  # the later chunk of a loop is a
            middles = (sum(frames_u) // 2, sum(frames_v) // 2)
            S_v_u = loop.S_b_a.inverse()
            edges.append(Edge(u, v, "loop", S_v_u, 1.0, 1.0, 0, 0.0, True, "as VGGT-Long", {"s_det": 1.0}, middles))
        store.edges.add(edges)
        store.chunks.place(dict(zip(ids, placed, strict=True)), dict.fromkeys(ids, ids[0]), {})


class _Truth:
    """Measures of a memory against a simulated video."""

    def __init__(self, video: Any, most_deg: float | None = None) -> None:
        from benchmarks.simulation.covisibility import MOST_DEG, seen_share
        from list3r.evaluation.covisibility import Covisibility

        self.frames = len(video.time_s)
        self._video = video
        self._cloud = _true_cloud(video)
        rows = np.arange(0, self.frames, 10)
        self._covisibility = Covisibility(rows, video.time_s[rows], seen_share(video, rows, rows, most_deg or MOST_DEG))

    def measure(self, store: Any) -> dict[str, Any]:
        """Errors of all frames in the one frame of the memory: parts that were not joined count as they are."""
        from list3r.evaluation.cloud import evaluate_cloud
        from list3r.evaluation.revisits import Candidates, judge, score
        from list3r.evaluation.trajectory import Trajectory, align, evaluate_trajectory

        placed = store.trajectory.poses()
        rows = np.array([f.frame_index for f, _ in placed])
        poses = np.stack([_rigid(S) for _, S in placed])
        truth = Trajectory(rows.astype(float), self._video.T_world_cam[rows])
        estimate = Trajectory(rows.astype(float), poses)
        S_truth_world = align(truth, estimate, with_scale=True)
        scaled = Trajectory(estimate.time_s, _moved(S_truth_world, poses))
        errors = evaluate_trajectory(truth, scaled, delta_frames=30)
        cloud = evaluate_cloud(self._cloud, S_truth_world.apply(_points(store)))
        edges = store.edges.all()
        loops = [e for e in edges if e.kind == "loop"]
        spans = {c.chunk_id: (c.first_frame, c.last_frame) for c in store.chunks.all()}
        candidates = Candidates.of_edges(edges)
        judged = judge(candidates, self._covisibility, spans)
        errors_m = np.array(
            [self._loop_error(store, e) if e.accepted else np.nan for e in loops if e.frames is not None]
        )
        judged = replace(judged, chunk_labels=_right_is_no_error(judged.chunk_labels, candidates.chunks, errors_m))
        revisits = score([judged])
        return {
            "posed": len(rows) / self.frames,
            "components": len({c.component for c in store.chunks.all()}),
            "ate_sim3_m": round(errors.ate_sim3_m.rmse, 5),
            "rte_m": round(errors.rpe_translation_m.rmse, 5),
            "rre_deg": round(errors.rpe_rotation_deg.rmse, 4),
            "completeness_cm": round(cloud.completeness_cm, 3),
            "chamfer_cm": round(cloud.chamfer_cm, 3),
            "f_at_5cm": round(100 * cloud.f_score, 2),
            "candidates": len(loops),
            "true_loops": revisits.chunks.correct,
            "false_loops": int((errors_m > FALSE_M).sum()),
            "worst_loop_m": round(float(np.nanmax(errors_m, initial=0.0)), 3),
            "revisits": revisits.chunks.true,
            "judgement": _plain_judgement(judged),
        }

    def _loop_error(self, store: Any, edge: Any) -> float:
        """How far a loop edge puts the camera of its frame in v from the truth, as seen from u; metres."""
        ends = [store.chunks.samples(k) for k in (edge.u, edge.v)]
        to_truth = [self._placed(samples, frame) for samples, frame in zip(ends, edge.frames, strict=True)]
        if None in to_truth:
            return 0.0
        k = int(np.searchsorted(ends[1].camera_frames, edge.frames[1]))
        center = ends[1].T_chunk_cam[k, :3, 3]
        error = (to_truth[0] @ edge.S_v_u.inverse()).apply(center) - to_truth[1].apply(center)
        return float(np.linalg.norm(error))

    def _placed(self, samples: Any, frame: int) -> Any:
        """The similarity from a chunk to the truth, by its points within ten frames of one; None with too few."""
        from list3r.memory.core.errors import DegenerateError
        from list3r.memory.core.geometry import umeyama

        video, near = self._video, np.abs(samples.frame - frame) <= 10
        index = samples.frame[near]
        row, column = np.divmod(samples.pixel[near], video.camera.width)
        points = video.points(index, row, column)
        known = (video.depth[index, row, column] > 0) & ~np.isin(
            video.ids[index, row, column], [m.id for m in video.movers]
        )
        try:
            found = umeyama(samples.points[near][known], points[known], with_scale=True)
            off = np.linalg.norm(found.apply(samples.points[near][known]) - points[known], axis=1)
            good = off <= 2 * np.median(off)
            return umeyama(samples.points[near][known][good], points[known][good], with_scale=True)
        except DegenerateError:
            return None


def _right_is_no_error(labels: NDArray[np.int8], chunks: NDArray[np.int64], errors_m: Array) -> NDArray[np.int8]:
    """Pairs of chunks with hardly a shared view but a correct measured relation are ignored."""
    from list3r.evaluation.revisits import FALSE, OPEN

    pairs = np.sort(chunks, axis=1)
    right = {tuple(pair) for pair in pairs[errors_m <= FALSE_M].tolist()}
    measured = np.array([tuple(pair) in right for pair in pairs.tolist()], bool)
    return np.where((labels == FALSE) & measured, np.int8(OPEN), labels)


def _rigid(S: Any) -> Array:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = S.rotation, S.translation
    return out


def _moved(S: Any, poses: Array) -> Array:
    out = poses.copy()
    out[:, :3, :3] = S.rotation @ poses[:, :3, :3]
    out[:, :3, 3] = S.apply(poses[:, :3, 3])
    return out


def _points(store: Any) -> Array:
    """Points where the frames that saw them are, the bending of chunks undone."""
    from list3r.memory.core.geometry import Sim3

    parts, bends = [], store.bends.all()
    for chunk in store.chunks.all():
        samples = store.chunks.samples(chunk.chunk_id)
        kept = np.flatnonzero(samples.confidence > 0.3)[::5]
        points = samples.points[kept].astype(np.float64)
        if chunk.chunk_id in bends:
            frames, of_point = np.unique(samples.frame[kept], return_inverse=True)
            x = bends[chunk.chunk_id].at(frames)
            for k in range(len(frames)):
                mine = of_point == k
                points[mine] = Sim3(x.scale[k], x.rotation[k], x.translation[k]).apply(points[mine])
        parts.append(chunk.S_world_chunk.apply(points))
    return np.concatenate(parts)


def _true_cloud(video: Any) -> Array:
    """Every tenth frame's surface, movers left out, thinned to a grid of 2 cm."""
    seen = np.arange(0, len(video.depth), 10)
    keep = (video.depth[seen] > 0) & ~np.isin(video.ids[seen], [m.id for m in video.movers])
    k, row, column = np.nonzero(keep)
    cloud = video.points(seen[k], row, column)
    _, first = np.unique(np.floor(cloud / 0.02).astype(np.int64), axis=0, return_index=True)
    return cloud[np.sort(first)]


def summarise(rows: Sequence[dict[str, Any]], presets: Sequence[str], variants: Sequence[str]) -> dict[str, Any]:
    """Mean and standard deviation over the seeds of every figure, by preset and variant, and the ratio of the ATE."""
    out: dict[str, Any] = {}
    for preset in presets:
        for variant in variants:
            chosen = [r for r in rows if (r["preset"], r["variant"]) == (preset, variant)]
            figures = {key: [r[key] for r in chosen] for key in SHOWN}
            out.setdefault(preset, {})[variant] = {
                key: {"mean": round(float(np.mean(v)), 4), "std": round(float(np.std(v)), 4)}
                for key, v in figures.items()
            }
        first = out[preset][variants[0]]["ate_sim3_m"]["mean"]
        for variant in variants:
            out[preset][variant]["ate_ratio"] = round(out[preset][variant]["ate_sim3_m"]["mean"] / first, 4)
    return out


def print_tables(summary: dict[str, Any], presets: Sequence[str], variants: Sequence[str]) -> None:
    """The ablation table of each preset."""
    for preset in presets:
        print(f"\n{preset}: mean (standard deviation) over the seeds")
        print(f"{'':32}" + "".join(f"{key:>20}" for key in SHOWN) + f"{'ATE ratio':>12}")
        for variant in variants:
            entry = summary[preset][variant]
            cells = "".join(f"{entry[k]['mean']:12.3f} ({entry[k]['std']:.3f})" for k in SHOWN)
            print(f"{TITLES[variant]:32}{cells}{entry['ate_ratio']:12.3f}")


def revisit_table(
    judgements: Sequence[tuple[str, str, Any]], presets: Sequence[str], variant: str
) -> dict[str, dict[str, Any]]:
    """Recognised pairs of chunks: those accepted by one variant, and by frame similarity alone at its best threshold of
    precision 0.99, with the same descriptors; pooled over the seeds and over all presets."""
    from list3r.evaluation.revisits import score

    print(f"\nrevisits (pairs of chunks) of {TITLES[variant]}, and of frame similarity alone at precision 0.99")
    table = {}
    for name in [*presets, "all"]:
        chosen = [j for preset, v, j in judgements if v == variant and name in (preset, "all")]
        found = score(chosen)
        alone = found.rankings["s_det"].chunk_recall if "s_det" in found.rankings else None
        table[name] = {
            "revisits": found.chunks.true,
            "precision": found.chunks.precision,
            "recall": found.chunks.recall,
            "false": len(found.wrong),
            "frame_similarity_recall": alone,
        }
        print(
            f"{name:10}"
            + "  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in table[name].items())
        )
    return table


def plot(path: Path, rows: Sequence[dict[str, Any]], presets: Sequence[str], variants: Sequence[str]) -> None:
    """ATE of every seed (dots) and their median (lines), one panel a preset, logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    size = (1.7 * len(presets) + 2.4, 0.26 * len(variants) + 0.9)
    figure, axes = pyplot.subplots(1, len(presets), figsize=size, squeeze=False, sharex=True, sharey=True)
    for axis, preset in zip(axes[0], presets, strict=True):
        for k, variant in enumerate(variants):
            ates = [r["ate_sim3_m"] for r in rows if (r["preset"], r["variant"]) == (preset, variant)]
            color = "#2a6fb0" if variant.startswith("full") else "#777777"
            axis.plot([np.median(ates)] * 2, [k - 0.35, k + 0.35], color=color, linewidth=2)
            axis.scatter(ates, np.full(len(ates), k), s=12, color=color, alpha=0.55, linewidths=0)
        axis.set_title(preset, fontsize=10)
        axis.grid(axis="x", color="#dddddd", linewidth=0.6)
        axis.tick_params(labelsize=8, length=0)
    axes[0][0].set_xscale("log")
    axes[0][0].set_xticks([0.03, 0.1, 0.3, 1, 3], ["0.03", "0.1", "0.3", "1", "3"])
    axes[0][0].set_xticks([], minor=True)
    axes[0][0].set_yticks(range(len(variants)), [TITLES[v] for v in variants])
    axes[0][0].invert_yaxis()
    figure.supxlabel("ATE after Sim(3) alignment, m", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()

"""Tables of camera paths and of how chunks are joined."""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Sequence
from typing import Any

from tables.results import read, table


def kitchen() -> str:
    """Return the table of the red kitchen: colour with depth, and colour alone in four forms."""
    depth, colour = read("redkitchen"), [read(f"sfm{kind}") for kind in ("", "-free-focal", "-mp4", "-phone")]
    runs = [r["list3r"] for r in colour]
    plain = [r.get("pycolmap") for r in colour]
    ways = ("colour, known focal length", "colour, unknown focal length", "colour, mp4", "colour, phone clip")
    return table(
        ["7-Scenes red kitchen, 1,000 frames", "colour and depth", *ways],
        [
            ["frames with a pose", f"{depth['posed']:,}", *(f"{r['posed']:,}" for r in runs)],
            ["ATE RMSE after Sim(3), m", f"{depth['ate_sim3_m']:.3f}", *(f"{r['ate_sim3_m']:.3f}" for r in runs)],
            ["ATE RMSE after SE(3), m", f"{depth['ate_se3_m']:.3f}", *("" for _ in runs)],
            ["plain pycolmap, every 8th frame, same run", ""]
            + ["" if p is None else f"{p['ate_sim3_m']:.3f}" for p in plain],
            ["end to end, frames/s", f"{depth['frames_per_second']:.1f}"] + [f"{r['frames_per_s']:.1f}" for r in runs],
            ["peak memory, GB", f"{depth['peak_mb'] / 1000:.1f}", *(f"{r['peak_mb'] / 1000:.1f}" for r in runs)],
            ["instances listed", str(depth["instances"]), *(str(r["instances"]) for r in runs)],
        ],
    )


FALSE_M = 0.5
FALSE_HEAD = "videos with an accepted loop off by more than 0.5 m"
VARIANTS = {
    "vggt-long": "VGGT-Long and Pi-Long as published, no cut detection",
    "vggt-long-cuts": "the same, cuts given (as in the rows below)",
    "ilrd-paper": "loops by `s_loop` >= 0.7 alone, a threshold far too low for the paper's rule",
    "verified": "loops by frame similarity, verified by geometry, no instances",
    "ilrd": "+ instances rank, veto and register (ILRD)",
    "iasm-paper": "+ instance-aware support as in the paper",
    "iasm": "+ instance-aware support as in builds (IASM)",
    "cwgo-paper": "the row above with the paper's edge weights",
    "graph": "IASM + covariances and switchable loops (CWGO)",
    "full": "+ nodes within chunks (full)",
    "full-no-instances": "full, no instance evidence, and VGGT-Long's alignment",
}
METHODS = {
    "vggt-long": "VGGT-Long as published, no cut detection",
    "vggt-long-cuts": "the same, cuts given (as in the rows below)",
    "paper": "the paper as written, `--association paper`",
    "frames": "frames alone, `--association frames`",
    "full": "ours",
    "full-no-instances": "ours, labels of instances erased",
}


def _errors(runs: Sequence[Any], preset: str, variant: str) -> list[float]:
    return [r["ate_sim3_m"] for r in runs if (r["preset"], r["variant"]) == (preset, variant)]


def _ate_table(runs: Sequence[Any], names: dict[str, str], reference: str) -> str:
    """Return ATE by variant and preset, with the ratio of medians to a reference, by preset and over all presets."""
    presets = list(dict.fromkeys(r["preset"] for r in runs))
    variants = [v for v in names if any(r["variant"] == v for r in runs)]
    rows, counts = [], {p: len(_errors(runs, p, variants[0])) for p in presets}
    medians = {(p, v): statistics.median(_errors(runs, p, v)) for p in presets for v in variants}
    for variant in variants:
        cells = []
        for preset in presets:
            e = _errors(runs, preset, variant)
            spread = (
                f"{statistics.mean(e):.3f} ({statistics.median(e):.3f}, {max(e):.3f})" if len(e) > 1 else f"{e[0]:.3f}"
            )
            ratio = medians[preset, variant] / medians[preset, reference]
            cells.append(spread if variant == reference else f"{spread}, x {ratio:.2f}")
        false = [r["worst_loop_m"] > FALSE_M for r in runs if r["variant"] == variant]
        over_all = [statistics.median([e for p in presets for e in _errors(runs, p, v)]) for v in (variant, reference)]
        last = [f"{over_all[0]:.3f}, x {over_all[0] / over_all[1]:.2f}", f"{sum(false)} of {len(false)}"]
        rows.append([names[variant], *cells, *last])
    heads = [f"{p} ({n})" for p, n in counts.items()]
    return table(["ATE, m: mean (median, worst), ratio of medians", *heads, "median of all", FALSE_HEAD], rows)


def fair() -> str:
    """Return the table of the variants of association against VGGT-Long as published."""
    return _ate_table(read("association-fair")["runs"], VARIANTS, "vggt-long")


def methods() -> str:
    """Return the table of whole methods on one set of videos."""
    return _ate_table(read("association-methods")["runs"], METHODS, "vggt-long")


def _bootstrap(values: Sequence[float], rounds: int = 4000) -> tuple[float, float]:
    """Return the 95 % interval of a mean, by drawing videos again."""
    draw = random.Random(0)
    means = sorted(statistics.mean(draw.choices(values, k=len(values))) for _ in range(rounds))
    return means[int(0.025 * rounds)], means[int(0.975 * rounds)]


def worth() -> str:
    """Return what instances bring: all kinds, each kind, and places that look different."""
    fair = read("association-fair")["runs"]
    kinds = {"the seven kinds above, our alignment taken away too": fair}
    kinds |= {f"- `{p}`": [r for r in fair if r["preset"] == p] for p in dict.fromkeys(r["preset"] for r in fair)}
    kinds["videos like them, only the labels erased"] = read("association-methods")["runs"]
    kinds["places that look different"] = read("association-returns")["runs"]
    rows = []
    for what, chosen in kinds.items():
        runs = {(r["preset"], r["seed"], r["variant"]): r for r in chosen}
        videos = sorted({key[:2] for key in runs})
        on, off = ([runs[*v, variant] for v in videos] for variant in ("full", "full-no-instances"))
        logs = [math.log(a["ate_sim3_m"] / b["ate_sim3_m"]) for a, b in zip(on, off, strict=True)]
        low, high = _bootstrap(logs)
        ratio = f"{math.exp(statistics.mean(logs)):.2f} ({math.exp(low):.2f} to {math.exp(high):.2f})"
        found = [sum(r["true_loops"] for r in rs) / sum(r["revisits"] for r in rs) for rs in (on, off)]
        false = [sum(r["false_loops"] for r in rs) for rs in (on, off)]
        better = f"{sum(x < 0 for x in logs)} of {len(videos)}"
        rows.append([what, ratio, better, *(f"{a:.2f}, {b}" for a, b in zip(found, false, strict=True))])
    heads = ["ATE with instances / ATE without (95 %, bootstrap over videos)", "better with instances"]
    more = ["with instances: revisits found, relations off by more than 0.5 m", "without"]
    return table(["geometric mean over videos", *heads, *more], rows)


def returns() -> str:
    """Return the table of videos in which a place looks otherwise: all instance evidence on and off."""
    return _ate_table(read("association-returns")["runs"], VARIANTS, "full-no-instances")


def registration() -> str:
    """Return the table of registration by instances alone."""
    names = {
        "opposite": "from the opposite end of the room",
        "opposite-sensor": "the same, depth sensor",
        "moved": "half of the objects moved, different light",
        "alike": "one of three rooms that look alike",
    }
    rows = []
    for preset, name in names.items():
        t = read(f"registration-{preset}")["total"]
        wrong = t["believed"] - round(t["precision"] * t["believed"])
        cells = [f"{t['joined']} of {t['homes']}", str(t["joined_wrongly"]), f"{t['believed']}, {wrong}"]
        off = f"{t['median_m']:.2f}, {t['median_deg']:.1f}"
        rows.append([name, *cells, off, f"{t['within_0.1_m_and_3_deg']} of {t['joined']}"])
    heads = ["homes joined", "with a wrong relation", "accepted relations, wrong ones", "median error (m, degrees)"]
    return table(["registration by instances alone, held-out homes", *heads, "within 0.1 m and 3 degrees"], rows)


def changed() -> str:
    """Return the table of second sessions after heavy change."""
    whole, alone = read("changed-homes")["total"], read("changed-keyframes")["total"]
    other_homes = read("changed-strangers")
    rows = []
    for name, t, placed, wrong, others in (
        (
            "build and update",
            whole,
            whole["placed"],
            whole["wrong"],
            f"{other_homes['placed']} of {other_homes['sessions']}",
        ),
        (
            "keyframes only, true poses",
            alone,
            alone["placed_right"],
            alone["placed_wrong"],
            f"{alone['strangers_placed']} of {alone['strangers']}",
        ),
    ):
        off = f"{1000 * t['median_off_m']:.1f} and {1000 * t['worst_off_m']:.1f} mm"
        rows.append([name, f"{placed} of {t['homes']}", str(wrong), str(t["homes"] - placed - wrong), off, others])
    heads = ["placed within 0.1 m and 3 degrees", "placed wrongly", "left apart", "error, median and worst"]
    return table(["held-out homes", *heads, "placed in another home"], rows)


def alignment() -> str:
    """Return the table of the alignment of whole point maps."""
    single, double, builds = read("alignment"), read("alignment-double"), read("alignment-builds")
    ways = [
        ("ours as in builds, seeds 1 to 8", builds, "builds"),
        ("ours on whole point maps (not in builds), seeds 1 to 8", single, "ours"),
        ("VGGT-Long's, seeds 1 to 8", single, "vggt_long"),
        ("ours on whole point maps, seeds 1 and 2", double, "ours"),
        ("VGGT-Long's in double precision, seeds 1 and 2", double, "vggt_long_double"),
    ]
    rows = []
    for name, held, way in ways:
        cells = []
        for case in ("outliers_on_both_sides", "outliers_on_one_side"):
            m = {key: figure["mean"] for key, figure in held[case][way].items()}
            position = f"{1000 * m['position_error_m']:.2f} mm"
            cells.append(f"{position}, {m['rotation_error_deg']:.4f}, {m['scale_error_percent']:.4f} %")
        rows.append([name, *cells, f"{held['outliers_on_both_sides'][way]['seconds']['mean']:.2f} s"])
    heads = ["outliers on both sides", "on one side", "processor time"]
    return table(["mean error: position, rotation (degrees), scale", *heads], rows)

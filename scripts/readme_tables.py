"""Print the tables of README.md and docs from the committed results, or check that they show them.

    python scripts/readme_tables.py            # write the tables between their marks
    python scripts/readme_tables.py --check    # exit status 1 where a page differs

Each table is read from JSON files under benchmarks/results, which the command named beside the table wrote.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def _read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def summary() -> str:
    """Return the rows of README.md: what was measured, the measure, the result, a reference, and the commit."""
    depth, colour, scale = _read("redkitchen"), _read("sfm"), _read("scale")["sizes"][-1]
    worlds, house, own = (_read(n)["mean"] for n in ("discovery", "discovery-house", "simulated"))
    masked = _read("relations")["pooled"]
    fair, returns_ = _read("association-fair")["runs"], _read("association-returns")["runs"]
    kills = _read("safety")["asked"]["kills"]

    def ate(runs: Sequence[Any], variant: str) -> str:
        e = [100 * r["ate_sim3_m"] for r in runs if r["variant"] == variant]
        return f"{statistics.median(e):.1f} cm (mean {statistics.mean(e):.1f}, worst {max(e):.0f})"

    def things(mean: Any) -> str:
        return f"{mean['recall_0.25']:.2f} recall, {mean['precision_0.25']:.2f} precision"

    boxes = "boxes at IoU 0.25"
    return _table(
        ["", "measure", "result", "reference", "commit"],
        [
            [
                "camera path, real kitchen, 1,000 frames with depth",
                "ATE RMSE after SE(3)",
                f"{100 * depth['ate_se3_m']:.1f} cm, {depth['frames_per_second']:.0f} frames/s",
                "ground truth accurate to a few cm",
                _commit("redkitchen"),
            ],
            [
                "camera path, same kitchen, colour only",
                "ATE RMSE after Sim(3)",
                f"{100 * colour['list3r']['ate_sim3_m']:.1f} cm, {colour['list3r']['frames_per_s']:.0f} frames/s",
                f"plain pycolmap {100 * colour['pycolmap']['ate_sim3_m']:.1f} cm",
                _commit("sfm"),
            ],
            [
                "camera path, long simulated videos with revisits, simulated network",
                "ATE RMSE after Sim(3), median",
                ate(fair, "full"),
                f"VGGT-Long's association {ate(fair, 'vggt-long')}",
                _commit("association-fair"),
            ],
            [
                "the same, but places look different when revisited",
                "ATE RMSE after Sim(3), median",
                ate(returns_, "full"),
                f"without instances {ate(returns_, 'full-no-instances')}",
                _commit("association-returns"),
            ],
            ["instances, simulated homes (whole walks)", boxes, things(own), "", _commit("simulated")],
            [
                "instances, ten held-out simulated worlds (one chunk)",
                boxes,
                things(worlds["learned"]),
                f"with true masks {things(worlds['true'])}",
                _commit("discovery"),
            ],
            [
                "instances, renderings of a house modelled by others (one chunk)",
                boxes,
                things(house["learned"]),
                f"with true masks {things(house['true'])}",
                _commit("discovery-house"),
            ],
            [
                "`on` relations, simulated homes",
                "pairs",
                f"{own['on_recall']:.2f} recall, {own['on_precision']:.2f} precision",
                f"with true masks {masked['on']['recall']:.2f}, {masked['on']['precision']:.2f}",
                _commit("simulated"),
            ],
            *(
                [f"changes between two sessions, {name}", "F1 of records", f"{t['all']['f1']:.2f}", "", _commit(file)]
                for name, t, file in [(*_sessions()[0], "sessions"), *_elsewhere()]
            ),
            [
                "`nearest` among a million instances",
                "processor time, median",
                f"{scale['nearest_cpu_p50_ms']:.1f} ms",
                "",
                _commit("scale"),
            ],
            ["killed at random moments", "data lost", f"none in {kills} runs", "", _commit("safety")],
        ],
    )


def _commit(name: str) -> str:
    """Return the commit at which a result was measured; older results name only the one that brought their file."""
    result = _read(name)
    measured = result.get("commit")
    return str(measured).rstrip("+")[:7] if measured else f"{result['commit_of_file']}, file"


def kitchen() -> str:
    """Return the table of the red kitchen: colour with depth, and colour alone in four forms."""
    depth, colour = _read("redkitchen"), [_read(f"sfm{kind}") for kind in ("", "-free-focal", "-mp4", "-phone")]
    runs = [r["list3r"] for r in colour]
    plain = [r.get("pycolmap") for r in colour]
    ways = ("colour, known focal length", "colour, unknown focal length", "colour, mp4", "colour, phone clip")
    return _table(
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


def walks() -> str:
    """Return the table of simulated walks, with a sensor's depth and by colour alone."""
    depth, rules, colour = (_read(name)["mean"] for name in ("simulated", "simulated-rules", "colour"))

    def both(name: str, key: str) -> list[str]:
        return [name, *(f"{m[f'{key}_recall']:.2f}, {m[f'{key}_precision']:.2f}" for m in (depth, rules, colour))]

    def boxes(m: dict[str, float], iou: str, kind: str = "") -> str:
        return f"{m[f'{kind}recall_{iou}']:.2f}, {m[f'{kind}precision_{iou}']:.2f}"

    def counts(m: dict[str, float]) -> str:
        return f"{m['duplicates']:.1f}, {m['merged_pairs']:.1f}"

    return _table(
        [
            "recall, precision; means over walks",
            "colour and depth, 6 walks",
            "the same, former discovery by rules",
            "colour only, 3 walks",
        ],
        [
            ["instances at box IoU 0.25", boxes(depth, "0.25"), boxes(rules, "0.25"), boxes(colour, "0.25", "box_")],
            ["instances at box IoU 0.50", boxes(depth, "0.50"), boxes(rules, "0.50"), boxes(colour, "0.50", "box_")],
            ["instances at mask IoU 0.25", "", "", boxes(colour, "0.25", "mask_")],
            ["duplicates, merged pairs per walk", counts(depth), counts(rules), ""],
            both("`on`", "on"),
            both("`next_to`", "next_to"),
            both("`in`", "in"),
            ["camera ATE RMSE, m", *(f"{m['ate_se3_m']:.3f}" for m in (depth, rules)), f"{colour['ate_sim3_m']:.3f}"],
        ],
    )


def discovery() -> str:
    """Return the table of discovery on held-out worlds and a house by rules, by networks and by true masks, and the
    ablation of the networks' inputs.
    """
    methods = {"geometric": "rules (removed since)", "learned": "learned (default)", "true": "true masks"}
    methods["before"] = "learned, with the weights before decision 0179"
    methods["before 0199"] = "learned, depth by matches alone, before decision 0199"
    places = {
        "discovery": "10 held-out worlds",
        "discovery-fitted": "6 held-out rooms with built-in furniture",
        "discovery-house": "house modelled by others",
        "discovery-grey": "10 held-out worlds, grey pictures",
        "discovery-no-colour": "10 held-out worlds, pictures of one shade",
        "discovery-house-grey": "the house, grey pictures",
        "discovery-swept": "10 held-out worlds, depth by plane sweep",
        "discovery-swept-house": "the house, depth by plane sweep",
        "discovery-ablation": "the 10 worlds, trained on only 40 rooms",
    }
    keys = {"boxes at IoU 0.25": ("", "0.25"), "at 0.5": ("", "0.5"), "masks at 0.25": ("mask_", "0.25")}
    keys["masks at 0.5"] = ("mask_", "0.5")
    rows = []
    for name, place in places.items():
        for method, entry in _read(name)["mean"].items():
            cells = [
                f"{entry[f'{kind}recall_{iou}']:.2f}, {entry[f'{kind}precision_{iou}']:.2f}"
                for kind, iou in keys.values()
            ]
            rows.append([f"{place}: {methods.get(method, method)}", *cells])
    return _table(["recall, precision of one chunk", *keys], rows)


VARIANTS = {
    "vggt-long": "VGGT-Long and Pi-Long, their own loop selection, alignment and optimiser; no cut detection",
    "vggt-long-cuts": "the same, cuts given (as in all rows below)",
    "ilrd-paper": "loops by `s_loop` alone, as in the paper",
    "verified": "loops by frame similarity, verified by geometry, no instances",
    "ilrd": "+ instances rank, veto and register (ILRD)",
    "iasm-paper": "+ instance-aware support as in the paper",
    "iasm": "+ instance-aware support as in builds (IASM)",
    "cwgo-paper": "the row above with the paper's edge weights",
    "graph": "IASM + covariances and switchable loops (CWGO)",
    "full": "+ nodes within chunks (full)",
    "full-no-instances": "full, without any instance evidence",
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
        over_all = [statistics.median([e for p in presets for e in _errors(runs, p, v)]) for v in (variant, reference)]
        rows.append([names[variant], *cells, f"{over_all[0]:.3f}, x {over_all[0] / over_all[1]:.2f}"])
    heads = [f"{p} ({n})" for p, n in counts.items()]
    return _table(["ATE, m: mean (median, worst), ratio of medians", *heads, "median of all"], rows)


def fair() -> str:
    """Return the table of the variants of association against VGGT-Long as published."""
    return _ate_table(_read("association-fair")["runs"], VARIANTS, "vggt-long")


def worth() -> str:
    """Return what instances bring in the older kinds of video and in those in which a place looks otherwise."""
    rows = []
    kinds = {"association-fair": "the seven kinds above", "association-returns": "places that look different"}
    for name, what in kinds.items():
        runs = {(r["preset"], r["seed"], r["variant"]): r for r in _read(name)["runs"]}
        videos = sorted({key[:2] for key in runs})
        on, off = ([runs[*v, variant] for v in videos] for variant in ("full", "full-no-instances"))
        logs = [math.log(a["ate_sim3_m"] / b["ate_sim3_m"]) for a, b in zip(on, off, strict=True)]
        middle, error = statistics.mean(logs), statistics.stdev(logs) / len(logs) ** 0.5
        ratio = f"{math.exp(middle):.2f} ({math.exp(middle - error):.2f} to {math.exp(middle + error):.2f})"
        found = [sum(r["true_loops"] for r in rs) / sum(r["revisits"] for r in rs) for rs in (on, off)]
        false = [sum(r["false_loops"] for r in rs) for rs in (on, off)]
        better = f"{sum(x < 0 for x in logs)} of {len(videos)}"
        rows.append([what, ratio, better, *(f"{a:.2f}, {b}" for a, b in zip(found, false, strict=True))])
    heads = ["ATE with instances / ATE without (one standard error)", "better with instances"]
    more = ["with instances: revisits found, relations off by more than 0.5 m", "without"]
    return _table(["geometric mean over videos", *heads, *more], rows)


def returns() -> str:
    """Return the table of videos in which a place looks otherwise: all instance evidence on and off."""
    return _ate_table(_read("association-returns")["runs"], VARIANTS, "full-no-instances")


def registration() -> str:
    """Return the table of registration by things alone."""
    names = {
        "opposite": "from the opposite end of the room",
        "opposite-sensor": "the same, depth sensor",
        "moved": "half of the things moved, different light",
        "alike": "one of three rooms that look alike",
    }
    rows = []
    for preset, name in names.items():
        t = _read(f"registration-{preset}")["total"]
        wrong = t["believed"] - round(t["precision"] * t["believed"])
        cells = [f"{t['joined']} of {t['homes']}", str(t["joined_wrongly"]), f"{t['believed']}, {wrong}"]
        off = f"{t['median_m']:.2f}, {t['median_deg']:.1f}"
        rows.append([name, *cells, off, f"{t['within_0.1_m_and_3_deg']} of {t['joined']}"])
    heads = ["homes joined", "with a wrong relation", "accepted relations, wrong ones", "median error (m, degrees)"]
    return _table(["registration by things alone, held-out homes", *heads, "within 0.1 m and 3 degrees"], rows)


def changed() -> str:
    """Return the table of second sessions after heavy change."""
    whole, alone = _read("changed-homes")["total"], _read("changed-keyframes")["total"]
    other_homes = _read("changed-strangers")
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
    return _table(["held-out homes", *heads, "placed in another home"], rows)


def alignment() -> str:
    """Return the table of the alignment of whole point maps."""
    single, double, builds = _read("alignment"), _read("alignment-double"), _read("alignment-builds")
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
    return _table(["mean error: position, rotation (degrees), scale", *heads], rows)


def _elsewhere() -> list[tuple[str, dict[str, Any], str]]:
    """Names, figures and files of second sessions in homes that our simulator did not make."""
    files = {
        "six held-out simulated worlds": "changes-elsewhere",
        "six walks in a house modelled by others": "changes-elsewhere-house",
    }
    return [(name, _read(file)["total"]["learned"], file) for name, file in files.items()]


def changes() -> str:
    """Return the table of second sessions."""
    kinds = ("moved", "removed", "added", "all")
    runs = dict(_sessions()) | {name: total for name, total, _ in _elsewhere()}
    rows = [[name, *(f"{total[k]['f1']:.2f}" for k in kinds)] for name, total in runs.items()]
    return _table(["F1 of change records", *kinds], rows)


def _sessions() -> list[tuple[str, Any]]:
    """Return the totals of second sessions in simulated homes, by place."""
    before = _read("sessions-rules")["total seeds 311 to 320"]
    out = [("simulated homes 311 to 320, former discovery by rules", before)]
    if (RESULTS / "sessions.json").exists():
        result = _read("sessions")
        seeds = [row["seed"] for row in result["seeds"]]
        out.insert(0, (f"simulated homes {min(seeds)} to {max(seeds)}", result["total"]))
    return out


def relations() -> str:
    """Return the table of relations with true masks."""
    pooled = _read("relations")["pooled"]
    names = {
        "on": "`on`",
        "in": "`in`",
        "next_to": "`next_to`",
        "attached_to": "`attached_to`",
        "viewpoint": "left, right, front, behind",
        "between": "`between`",
    }
    cells = [f"{pooled[key]['precision']:.2f}, {pooled[key]['recall']:.2f}" for key in names]
    return _table(["relations with true masks", *names.values()], [["precision, recall", *cells]])


def pack() -> str:
    """Return the share of questions that the text for a language model answers, by memory and budget."""
    rows = _read("prompt_pack")["rows"]
    budgets = sorted({r["budget"] for r in rows})
    found = {(r["memory"], r["instances"]): {} for r in rows}
    for r in rows:
        found[r["memory"], r["instances"]][r["budget"]] = f"{100 * r['general']:.0f} / {100 * r['asked']:.0f} %"
    head = ["memory", "instances", *(f"{b:,} tokens" for b in budgets)]
    return _table(
        head, [[m.split("-")[0], f"{n:,}", *(row.get(b, "") for b in budgets)] for (m, n), row in found.items()]
    )


def exports() -> str:
    """Return what every export takes, by format and number of instances."""
    rows = _read("exporters")["rows"]
    counts = sorted({r["instances"] for r in rows})
    formats = dict.fromkeys(r["format"] for r in rows)
    found = {(r["format"], r["instances"]): r for r in rows}

    def cell(name: str, count: int) -> str:
        r = found.get((name, count))
        if r is None:
            return "not measured"
        if not r["done"]:
            return "refused" if "refused" in r else "not done"
        return f"{r['cpu_s']:.1f} s, {r['peak_mb']} MB, {r['mb']:.1f} MB"

    return _table(["format", *(f"{n:,}" for n in counts)], [[n, *(cell(n, c) for c in counts)] for n in formats])


def receivers() -> str:
    """Return what other programs read in the exports of whole memories."""
    names = {"redkitchen": "redkitchen, 1,000 frames", "home-1": "the demo", "home-7": "`demo --seed 7`"}
    rows = []
    for r in _read("receivers")["rows"]:
        agree = f"{sum(r['agree'].values())} of {len(r['agree'])}"
        said = f"{r['usd_core_errors']}, {'none' if r['nvidia_sound'] else 'some'}"
        counts = [f"{r['instances']}, {r['relations']}", agree, f"{r['box_mm']:.3f} mm"]
        rows.append([names[r["memory"]], *counts, said, f"{r['props_passed']} of {r['props']}"])
    heads = ["instances, relations", "formats that agree", "box error", "errors: usd-core, NVIDIA", "props that pass"]
    return _table(["memory", *heads], rows)


def catalogue() -> str:
    """Return what questions to a catalogue in PostgreSQL cost as it grows."""
    stages = _read("catalog")["stages"]
    rows = [
        ["add a memory of 1,000", "put of 1000"],
        *([n, n] for n in stages[0] if "," in n and "recall" not in n),
    ]
    lines = []
    for title, name in rows:
        cells = [s[name] for s in stages]
        cost = [f"{c['client_cpu_ms'] + c['server_cpu_ms']:.3g}" for c in cells]
        lines.append(
            [title, *(f"{cpu} ({c['p10_ms']:.3g}, {c['p50_ms']:.3g})" for cpu, c in zip(cost, cells, strict=True))]
        )
    for name in ("similar, all", "similar, all, even", "similar, all, lone"):
        lines.append([f"recall@10 of {name}", *(f"{s[f'recall@10, {name}']:.3f}" for s in stages)])
    lines.append(["GB on disk", *(f"{s['bytes']['all'] / 1e9:.2f}" for s in stages)])
    load = [s["loaded"] for s in stages]
    spent = [1e3 * (x["client_cpu_s"] + x["server_cpu_s"]) / x["memories"] for x in load]
    lines.append(["bulk load, ms per memory", *(f"{x:.0f}" for x in spent)])
    heads = [f"{s['memories']} memories, {s['instances']:,} instances" for s in stages]
    return _table(["ms of processor time, client + server (wall p10, p50)", *heads], lines)


def batches() -> str:
    """Return the runs of the benchmark of batches."""
    rows = []
    for name, r in _read("batch")["runs"].items():
        equal = "reference" if name == "one-process" else "equal" if r["equal"] else "differ"
        ended, lost = f"{r['worker_kills']}, {r['driver_kills']}", r["attempts"].get("lost", 0)
        twice = f"{len(r['built_twice'])}, {len(r['rewritten'])}"
        done = f"{r['attempts']['done']}, {lost}, {r['attempts'].get('failed', 0)}"
        rows.append([name, str(r["files"]), equal, ended, done, twice, f"{r['cpu_s']:.0f}", f"{r['seconds']:.0f}"])
    heads = ["files", "bytes", "killed workers, drivers", "attempts done, lost, failed", "built twice, written twice"]
    return _table(["run", *heads, "processor s", "wall s"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "summary": summary,
    "kitchen": kitchen,
    "walks": walks,
    "discovery": discovery,
    "fair": fair,
    "worth": worth,
    "returns": returns,
    "registration": registration,
    "changed": changed,
    "alignment": alignment,
    "changes": changes,
    "relations": relations,
    "pack": pack,
    "exports": exports,
    "receivers": receivers,
    "catalogue": catalogue,
    "batches": batches,
}
PAGES = (
    *("README.md", "docs/measured.md", "docs/prompt.md", "docs/commands.md", "docs/usd.md"),
    *("docs/batch.md", "docs/catalog.md"),
)
"""The pages with tables."""


def filled(text: str) -> str:
    """Return a page with every marked table written again. Raises `SystemExit` for a mark without a table."""

    def fill(mark: re.Match[str]) -> str:
        name = mark.group(1)
        if name not in TABLES:
            raise SystemExit(f"a page asks for the table {name}; there are {', '.join(TABLES)}")
        return f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end of table -->"

    return re.sub(r"<!-- table (\w+) -->\n.*?<!-- end of table -->", fill, text, flags=re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 where a page differs")
    check = parser.parse_args().check
    for page in PAGES:
        before = (ROOT / page).read_text(encoding="utf-8")
        after = filled(before)
        if check and before != after:
            print(f"{page} shows other figures than benchmarks/results: run scripts/readme_tables.py", file=sys.stderr)
            raise SystemExit(1)
        if not check:
            (ROOT / page).write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()

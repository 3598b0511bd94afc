"""Tables of what leaves a memory, and of many memories."""

from __future__ import annotations

from tables.results import read, table


def pack() -> str:
    """Return the share of questions that the text for a language model answers, by memory and budget."""
    rows = read("prompt_pack")["rows"]
    budgets = sorted({r["budget"] for r in rows})
    found = {(r["memory"], r["instances"]): {} for r in rows}
    for r in rows:
        found[r["memory"], r["instances"]][r["budget"]] = f"{100 * r['general']:.0f} / {100 * r['asked']:.0f} %"
    head = ["memory", "instances", *(f"{b:,} tokens" for b in budgets)]
    return table(
        head, [[m.split("-")[0], f"{n:,}", *(row.get(b, "") for b in budgets)] for (m, n), row in found.items()]
    )


def exports() -> str:
    """Return what every export takes, by format and number of instances."""
    rows = read("exporters")["rows"]
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

    return table(["format", *(f"{n:,}" for n in counts)], [[n, *(cell(n, c) for c in counts)] for n in formats])


def receivers() -> str:
    """Return what other programs read in the exports of whole memories."""
    names = {"redkitchen": "redkitchen, 1,000 frames", "home-1": "the demo", "home-7": "`demo --seed 7`"}
    rows = []
    for r in read("receivers")["rows"]:
        agree = f"{sum(r['agree'].values())} of {len(r['agree'])}"
        said = f"{r['usd_core_errors']}, {'none' if r['nvidia_sound'] else 'some'}"
        counts = [f"{r['instances']}, {r['relations']}", agree, f"{r['box_mm']:.3f} mm"]
        rows.append([names[r["memory"]], *counts, said, f"{r['props_passed']} of {r['props']}"])
    heads = ["instances, relations", "formats that agree", "box error", "errors: usd-core, NVIDIA", "props that pass"]
    return table(["memory", *heads], rows)


def physics() -> str:
    """Return what balls do at things, and scenes at rest, in a physics engine."""
    total = read("physics")["total"]
    names = {"in": "dropped into containers, stays", "under": "rolled under tables, comes out", "on": "put on, stays"}
    rows = [
        [
            name,
            str(r["tried"]),
            str(r["found"]),
            f"{r['true']} of {r['tried']}",
            *(f"{r[k]} of {r['found']}" for k in ("hull", "ours")),
        ]
        for key, name in names.items()
        for r in (total[key],)
    ]
    for key, name in (
        ("exploded", "10 s at rest: bodies that explode"),
        ("stayed", "bodies within 5 cm of where they were"),
    ):
        some = [total[f"rest {k}"] for k in ("true", "hull", "ours")]
        rows.append([name, "", "", *(f"{r[key]} of {r['bodies']}" for r in some)])
    return table(["ball of 5 cm", "things", "found", "true shapes", "hulls", "solids"], rows)


def catalogue() -> str:
    """Return what questions to a catalogue in PostgreSQL cost as it grows."""
    stages = read("catalog")["stages"]
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
    return table(["ms of processor time, client + server (wall p10, p50)", *heads], lines)


def batches() -> str:
    """Return the runs of the benchmark of batches."""
    rows = []
    for name, r in read("batch")["runs"].items():
        equal = "reference" if name == "one-process" else "equal" if r["equal"] else "differ"
        ended, lost = f"{r['worker_kills']}, {r['driver_kills']}", r["attempts"].get("lost", 0)
        twice = f"{len(r['built_twice'])}, {len(r['rewritten'])}"
        done = f"{r['attempts']['done']}, {lost}, {r['attempts'].get('failed', 0)}"
        rows.append([name, str(r["files"]), equal, ended, done, twice, f"{r['cpu_s']:.0f}", f"{r['seconds']:.0f}"])
    heads = ["files", "bytes", "killed workers, drivers", "attempts done, lost, failed", "built twice, written twice"]
    return table(["run", *heads, "processor s", "wall s"], rows)

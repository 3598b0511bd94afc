"""Tables of instances, of relations and of changes."""

from __future__ import annotations

from tables.results import elsewhere, read, sessions, table


def walks() -> str:
    """Return the table of simulated walks, with a sensor's depth and by colour alone."""
    depth, rules, colour = (read(name)["mean"] for name in ("simulated", "simulated-rules", "colour"))

    def both(name: str, key: str) -> list[str]:
        return [name, *(f"{m[f'{key}_recall']:.2f}, {m[f'{key}_precision']:.2f}" for m in (depth, rules, colour))]

    def boxes(m: dict[str, float], iou: str, kind: str = "") -> str:
        return f"{m[f'{kind}recall_{iou}']:.2f}, {m[f'{kind}precision_{iou}']:.2f}"

    def counts(m: dict[str, float]) -> str:
        return f"{m['duplicates']:.1f}, {m['merged_pairs']:.1f}"

    return table(
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
    methods["before"] = "learned, former weights (before 0179)"
    methods["before 0199"] = "learned, depth by matches alone (before 0199)"
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
        for method, entry in read(name)["mean"].items():
            cells = [
                f"{entry[f'{kind}recall_{iou}']:.2f}, {entry[f'{kind}precision_{iou}']:.2f}"
                for kind, iou in keys.values()
            ]
            rows.append([f"{place}: {methods.get(method, method)}", *cells])
    return table(["recall, precision of one chunk", *keys], rows)


def memories() -> str:
    """Return the table of whole memories of long walks."""
    places = {
        "discovery-memory-long": "10 held-out worlds",
        "discovery-memory-long-fitted": "4 held-out rooms with built-in furniture",
        "discovery-memory-long-house": "house modelled by others, 6 walks",
    }
    names = {"learned": "now", "before 0205": "before 0205, from the same chunks"}
    rows = []
    for file, place in places.items():
        for method, entry in read(file)["mean"].items():
            cells = [
                f"{entry[f'{kind}recall_{iou}']:.2f}, {entry[f'{kind}precision_{iou}']:.2f}"
                for kind in ("", "mask_")
                for iou in ("0.25", "0.5")
            ]
            rows.append([f"{place}, {entry['things']} objects: {names[method]}", *cells])
    head = ["boxes at IoU 0.25", "at 0.5", "masks at 0.25", "masks at 0.5"]
    return table(["recall, precision of memories of six chunks", *head], rows)


def changes() -> str:
    """Return the table of second sessions."""
    kinds = ("moved", "removed", "added", "all")
    runs = dict(sessions()) | {name: total for name, total, _ in elsewhere()}
    rows = [[name, *(f"{total[k]['f1']:.2f}" for k in kinds)] for name, total in runs.items()]
    return table(["F1 of change records", *kinds], rows)


def relations() -> str:
    """Return the table of relations with true masks."""
    pooled = read("relations")["pooled"]
    names = {
        "on": "`on`",
        "in": "`in`",
        "next_to": "`next_to`",
        "attached_to": "`attached_to`",
        "viewpoint": "left, right, front, behind",
        "between": "`between`",
    }
    cells = [f"{pooled[key]['precision']:.2f}, {pooled[key]['recall']:.2f}" for key in names]
    return table(["relations with true masks", *names.values()], [["precision, recall", *cells]])

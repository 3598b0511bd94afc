"""The table of README.md: what was measured, the measure, the result, a reference, and the commit."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from tables.results import commit, elsewhere, read, sessions, table

_BOXES = "boxes at IoU 0.25"


def summary() -> str:
    """Return the rows of README.md."""
    return table(
        ["", "measure", "result", "reference", "commit"],
        [*_camera_paths(), *_instances(), *_relations_and_changes(), *_memory()],
    )


def _camera_paths() -> list[list[str]]:
    depth, colour, fair = read("redkitchen"), read("sfm"), read("association-fair")["runs"]
    ours = colour["list3r"]
    return [
        [
            "camera path, real kitchen, 1,000 frames with depth",
            "ATE RMSE after SE(3)",
            f"{100 * depth['ate_se3_m']:.1f} cm, {depth['frames_per_second']:.0f} frames/s",
            "ground truth accurate to a few cm",
            commit("redkitchen"),
        ],
        [
            "camera path, same kitchen, colour only",
            "ATE RMSE after Sim(3)",
            f"{100 * ours['ate_sim3_m']:.1f} cm, {ours['frames_per_s']:.0f} frames/s",
            f"plain pycolmap {100 * colour['pycolmap']['ate_sim3_m']:.1f} cm",
            commit("sfm"),
        ],
        [
            "camera path, long simulated videos with revisits, simulated network",
            "ATE RMSE after Sim(3), median",
            _ate(fair, "full"),
            f"VGGT-Long's association {_ate(fair, 'vggt-long')}",
            commit("association-fair"),
        ],
    ]


def _ate(runs: Sequence[Any], variant: str) -> str:
    e = [100 * r["ate_sim3_m"] for r in runs if r["variant"] == variant]
    return f"{statistics.median(e):.1f} cm (mean {statistics.mean(e):.1f}, worst {max(e):.0f})"


def _instances() -> list[list[str]]:
    long, house = read("discovery-memory-long")["mean"]["learned"], read("discovery-house")["mean"]
    return [
        [
            "instances, ten held-out simulated worlds (memories of 450 frames)",
            _BOXES,
            _found(long),
            "",
            commit("discovery-memory-long"),
        ],
        [
            "instances, renderings of a house modelled by others (one chunk)",
            _BOXES,
            _found(house["learned"]),
            f"with true masks {_found(house['true'])}",
            commit("discovery-house"),
        ],
    ]


def _found(mean: Any) -> str:
    return f"{mean['recall_0.25']:.2f} recall, {mean['precision_0.25']:.2f} precision"


def _relations_and_changes() -> list[list[str]]:
    own, masked = read("simulated")["mean"], read("relations")["pooled"]
    (homes, here), *_ = sessions()
    return [
        [
            "`on` relations, simulated homes",
            "pairs",
            f"{own['on_recall']:.2f} recall, {own['on_precision']:.2f} precision",
            f"with true masks {masked['on']['recall']:.2f}, {masked['on']['precision']:.2f}",
            commit("simulated"),
        ],
        [
            f"changes between two sessions, {homes}",
            "F1 of records",
            f"{here['all']['f1']:.2f}",
            "; ".join(f"{name} {total['all']['f1']:.2f}" for name, total, _ in elsewhere()),
            ", ".join(dict.fromkeys(commit(file) for file in ("sessions", *(file for *_, file in elsewhere())))),
        ],
    ]


def _memory() -> list[list[str]]:
    scale = read("scale")["sizes"][-1]
    return [
        [
            "`nearest` among a million instances",
            "processor time, median",
            f"{scale['nearest_cpu_p50_ms']:.1f} ms",
            "",
            commit("scale"),
        ]
    ]

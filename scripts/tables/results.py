"""Results as the benchmarks wrote them, and tables of Markdown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"


def read(name: str) -> Any:
    """Return what a benchmark wrote, by the name of its file."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def commit(name: str) -> str:
    """Return the commit at which a result was measured, with + where files were changed; older results name only the
    one that brought their file."""
    result = read(name)
    measured = str(result.get("commit", ""))
    return measured[:7] + "+" * measured.endswith("+") if measured else f"{result['commit_of_file']}, file"


def elsewhere() -> list[tuple[str, dict[str, Any], str]]:
    """Return names, figures and files of second sessions in homes that our simulator did not make."""
    files = {
        "six held-out simulated worlds": "changes-elsewhere",
        "six walks in a house modelled by others": "changes-elsewhere-house",
    }
    return [(name, read(file)["total"]["learned"], file) for name, file in files.items()]


def sessions() -> list[tuple[str, Any]]:
    """Return the totals of second sessions in simulated homes, by place."""
    now, before = read("sessions"), read("sessions-rules")["total seeds 311 to 320"]
    seeds = [row["seed"] for row in now["seeds"]]
    return [
        (f"simulated homes {min(seeds)} to {max(seeds)}", now["total"]),
        ("simulated homes 311 to 320, former discovery by rules", before),
    ]

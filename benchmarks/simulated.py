"""Simulated walks with known truth: trajectory, instances and relations over seeds.

python benchmarks/simulated.py --seeds 1,2,3 --json benchmarks/results/simulated.json
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Any

from machine import machine, run_list3r, write_json


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="11,12,13,14")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        root = args.keep or Path(scratch)
        for seed in (int(word) for word in args.seeds.split(",")):
            answer, usage = run_list3r("demo", "--out", str(root / f"seed-{seed}"), "--seed", str(seed))
            rows.append({"seed": seed, **usage, **flat(answer["scores"])})
            print("  ".join(f"{k} {v}" for k, v in rows[-1].items()))
    keys = [k for k in rows[0] if k != "seed"]
    known = {k: [r[k] for r in rows if r[k] is not None] for k in keys}
    mean = {k: round(statistics.fmean(values), 4) if values else None for k, values in known.items()}
    print(machine())
    for key, value in mean.items():
        print(f"{key:28} {value}")
    write_json(args.json, {"mean": mean, "seeds": rows})


def flat(scores: dict[str, Any]) -> dict[str, Any]:
    """The figures of one walk."""
    row = {"ate_se3_m": scores["trajectory"]["ate_se3_m"]["rmse"]}
    for threshold in ("0.25", "0.50"):
        entry = scores["scene"][f"instances_{threshold}"]
        row[f"recall_{threshold}"], row[f"precision_{threshold}"] = entry["recall"], entry["precision"]
    row["duplicates"] = scores["scene"]["instances_0.25"]["duplicates"]
    row["merged_pairs"] = scores["scene"]["instances_0.25"]["merged_pairs"]
    for name, entry in scores["scene"]["relations"]["by_predicate"].items():
        row[f"{name}_recall"], row[f"{name}_precision"] = entry["recall"], entry["precision"]
    return row


if __name__ == "__main__":
    main()

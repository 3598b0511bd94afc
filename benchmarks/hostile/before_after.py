"""Findings of the attack on version 0.1, before the repair and now: by a script in both checkouts."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from machine import STARTED_AT, machine, write_json

HERE = Path(__file__).resolve().parents[2]
BEFORE = "2aa1804fb2"
"""The commit before the first that mended any of it."""


NOT_SHOWN = {
    "2 update of a memory with a damaged reason of a merge": "an update of so small a walk merges only the "
    "damaged one; the same signing is shown by `label`",
    "9 depth of 0.2 mm": "`inspect` of the earlier version has this note in the layouts of TUM and 7-Scenes",
    "9 depth of 5 mm, in 1/5000 m": "as for 0.2 mm",
    "11 in USD, HTML, GraphML, JSON and SQL": "of these the earlier version had USD and JSON alone, which escaped",
    "14 standard error is closed; label": "the earlier version failed where standard output was closed or full, and in "
    "`build`; it is listed with them",
    "14 a lie with valid checksums: text where an id stands": "the earlier version refused it, or did not read it, "
    "in the commands that are tried",
    "14 a lie with valid checksums: text where a component stands": "as for an id, five exports included",
    "15 build in 600 MiB of address space": "whether a build hangs depends on where memory ends; this one does not",
}
"""Why some findings do not show in the earlier version by their script."""


def run_list(path: Path | None) -> dict[str, Any]:
    """Return every finding with its results before and now; resumes from the file."""
    held = json.loads(path.read_text(encoding="utf-8")) if path is not None and path.exists() else {}
    if held and held["machine"] != machine():
        raise SystemExit(f"{path} was measured on another machine; name another file")
    rows: dict[str, dict[str, str]] = held.get("findings", {})
    message: dict[str, Any] = {}
    with _worktree(BEFORE) as before:
        for when, checkout, commit in (("before", before, BEFORE), ("after", HERE, STARTED_AT)):
            fresh = held.get(when) == commit
            left = [k for k in keys() if not fresh or when not in rows.get(k, {})]
            for key, found in _looked_for(checkout, left):
                rows.setdefault(key, {})[when] = found
                if key in NOT_SHOWN and not rows[key].get("before", "not looked for"):
                    rows[key]["why"] = NOT_SHOWN[key]
                message = {"before": BEFORE, "after": STARTED_AT, "findings": {k: rows[k] for k in keys() if k in rows}}
                write_json(path, message)
                print(f"{when:<7}{key:<60}{found or 'holds'}", flush=True)
            held[when] = commit
    return message or held


def keys() -> list[str]:
    """Return the names of all findings, in the order of the list."""
    from hostile.findings.row import ROWS

    return sorted(ROWS, key=lambda key: int(key.split()[0]))


def table(message: dict[str, Any]) -> str:
    """Return the list as a table in Markdown."""
    lines = [f"| finding | before, {message['before']} | after, {message['after']} |", "|---|---|---|"]
    for key, found in message["findings"].items():
        before = found.get("before") or f"holds{': ' + found['why'] if 'why' in found else ''}"
        lines.append(f"| {key} | {before} | {found.get('after') or 'holds'} |")
    return "\n".join(lines)


def open_rows(message: dict[str, Any]) -> list[str]:
    """Return the findings that are not mended."""
    return [key for key, found in message["findings"].items() if found.get("after", "not looked for")]


@contextlib.contextmanager
def _worktree(commit: str) -> Iterator[Path]:
    """A temporary checkout of another commit."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "before"
        git = ["git", "-C", str(HERE), "worktree"]
        subprocess.run([*git, "add", "--detach", str(place), commit], check=True, capture_output=True)
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=False, capture_output=True)


def _looked_for(checkout: Path, names: list[str]) -> Iterator[tuple[str, str]]:
    """Test findings in one process, started in the checkout so that its `list3r` is imported."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(checkout), str(HERE / "benchmarks")))}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "hostile.findings.row", folder, *names],
            cwd=checkout,
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        for line in process.stdout:
            key, found = json.loads(line)
            yield key, found
        process.wait()

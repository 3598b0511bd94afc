"""What `list3r doctor` looks at."""

from __future__ import annotations

import ctypes.util
import os
import platform
import shutil
import sqlite3
import tempfile
from importlib import metadata

_PACKAGES = (
    ("numpy", "everything"),
    ("scipy", "everything"),
    ("opencv-python-headless", "reading frames, features"),
    ("av", "video files"),
    ("pillow", "the plan picture"),
    ("networkx", "graphs in Python"),
    ("faiss-cpu", "similar"),
    ("usd-core", "export --to usd"),
    ("trimesh", "export --to glb"),
    ("typer", "the command line"),
    ("torch", "neural models (later versions)"),
    ("open3d-cpu|open3d", "comparisons in benchmarks"),
)
_OPTIONAL = {"torch", "open3d-cpu|open3d"}


def findings() -> list[tuple[str, str, str]]:
    """(part, state, what it is needed for); a state that begins with MISSING needs mending."""
    rows = [
        ("system", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}", "everything"),
        ("cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()), "speed"),
        ("memory", _memory(), "0.5 GB for each worker and 0.5 GB more"),
        ("scratch space", f"{shutil.disk_usage(tempfile.gettempdir()).free / 1e9:.0f} GB free", "nothing large"),
    ]
    rows += [_package(name, use) for name, use in _PACKAGES]
    rows.append(_sqlite())
    library = ctypes.util.find_library("GL")
    rows.append(("libGL", "found" if library else "absent", "Open3D only (apt-get install libgl1 libegl1 libgomp1)"))
    return rows


def _memory() -> str:
    try:
        pages, size = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return "unknown"
    return f"{pages * size / 1e9:.1f} GB"


def _package(name: str, use: str) -> tuple[str, str, str]:
    for candidate in name.split("|"):
        try:
            return candidate, metadata.version(candidate), use
        except metadata.PackageNotFoundError:
            continue
    first = name.split("|")[0]
    return first, "absent" if name in _OPTIONAL else f"MISSING: pip install {first}", use


def _sqlite() -> tuple[str, str, str]:
    database = sqlite3.connect(":memory:")
    options = {row[0] for row in database.execute("PRAGMA compile_options")}
    database.close()
    state = (
        sqlite3.sqlite_version if "ENABLE_RTREE" in options else f"MISSING: R*Tree in SQLite {sqlite3.sqlite_version}"
    )
    return "sqlite", state, "the memory file"

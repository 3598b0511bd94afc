"""Checks of `list3r doctor`."""

from __future__ import annotations

import ctypes.util
import os
import platform
import shutil
import tempfile
from importlib import metadata

import apsw

from list3r.memory.core.errors import first_line
from list3r.models.cache import cache_folder, find_cached
from list3r.models.cards import CARDS, ModelCard
from list3r.models.device import find_gpu
from list3r.models.presets import missing_package

_PACKAGES = (
    ("apsw", "everything"),
    ("numpy", "everything"),
    ("scipy", "everything"),
    ("opencv-python-headless", "reading frames, features"),
    ("numba", "building memories"),
    ("av", "video files"),
    ("pillow", "the plan picture"),
    ("networkx", "graphs in Python"),
    ("faiss-cpu", "similar"),
    ("usd-core", "export --to usd"),
    ("trimesh", "export --to glb"),
    ("typer", "the command line"),
    ("rich", "tables and progress on a terminal"),
    ("torch", "dense depth of RGB video, networks"),
    ("pycolmap", "RGB video without networks (sfm)"),
    ("transformers", "discovery, tracking, features and free words by networks"),
    ("huggingface_hub", "fetching weights"),
    ("safetensors", "reading weights"),
    ("ncnn", "labels by a box detector"),
    ("viser", "the viewer (view)"),
    ("mcp", "agents (mcp)"),
    ("pyarrow", "export --to parquet"),
    ("rerun-sdk", "export --to rerun"),
    ("open3d-cpu|open3d", "comparisons in benchmarks"),
)
_NEEDED = {"apsw", "numpy", "scipy", "networkx", "faiss-cpu", "typer", "rich"}
"""What asking a memory takes; the others come with extras, which a command that lacks one names."""
_LIBRARIES = (
    ("GL", "Open3D only (apt-get install libgl1 libegl1)"),
    ("gomp", "threads of torch and faiss, where their packages bring none (apt-get install libgomp1)"),
)


def findings() -> list[tuple[str, str, str]]:
    """(part, state, purpose); a state that begins with MISSING is an error."""
    rows = [
        ("system", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}", "everything"),
        ("cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()), "speed"),
        ("memory", _memory(), "0.5 GB for each worker and 0.5 GB more"),
        ("scratch space", f"{shutil.disk_usage(tempfile.gettempdir()).free / 1e9:.0f} GB free", "nothing large"),
    ]
    rows += [_package(name, use) for name, use in _PACKAGES]
    rows.append(_sqlite())
    rows += [(f"lib{name}", "found" if ctypes.util.find_library(name) else "absent", use) for name, use in _LIBRARIES]
    rows += [_gpu(), _weights_cache()]
    return rows + [_model(card) for card in CARDS]


def _gpu() -> tuple[str, str, str]:
    use = "networks at the speed of video"
    try:
        gpu = find_gpu()
    except ImportError:
        return "GPU", "unknown, torch is absent", use
    except RuntimeError as error:
        return "GPU", f"cannot be used: {first_line(error)}", use
    if gpu is None:
        return "GPU", "none", use
    return "GPU", f"{gpu.name}, {gpu.free_mb / 1024:.1f} of {gpu.total_mb / 1024:.1f} GB free", use


def _weights_cache() -> tuple[str, str, str]:
    folder = cache_folder()
    if not folder.is_dir():
        return "weights", f"none; {folder} is not there", "networks"
    size = sum(p.stat().st_size for p in folder.glob("models--*/blobs/*"))
    return "weights", f"{size / 1e9:.2f} GB in {folder}", "networks"


def _model(card: ModelCard) -> tuple[str, str, str]:
    """A model: whether its package and which of its weights are here, and its licences."""
    missing = missing_package(card)
    held = [c for w in card.weights if (c := find_cached(w.repository, w.revision)) is not None]
    state = [f"no package {missing}" if missing else "installed"]
    if held:
        state.append(", ".join(f"{c.repository}@{c.commit[:8]} {c.size_bytes / 1e6:.0f} MB" for c in held))
    elif card.weights:
        state.append("weights not fetched")
    first = card.weights[0] if card.weights else None
    licences = f"code {card.code.name}" + (f", weights {first.licence.name}" if first else "")
    marks = ("" if card.commercial else "; restricted") + ("; gated" if first is not None and first.gated else "")
    return f"{card.part}: {card.name}", "; ".join(state), licences + marks


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
    return first, f"MISSING: pip install {first}" if name in _NEEDED else "absent", use


def _sqlite() -> tuple[str, str, str]:
    missing = {"ENABLE_RTREE", "ENABLE_FTS5"} - set(apsw.compile_options)
    state = f"MISSING: {', '.join(sorted(missing))}" if missing else apsw.sqlite_lib_version()
    return "sqlite", state, "the memory file"

"""What a data set of LeRobot (version 3) says of its features and episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.files import MAX_TEXT_BYTES, check_ordinary
from list3r.frames.layout import inside, read_json
from list3r.memory.core.errors import OptionError, SourceError, first_line, install_hint

INFO = "meta/info.json"
_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_MOST_EPISODES = 2**21


@dataclass(frozen=True)
class Episode:
    """An episode, and where it lies in the video of each camera."""

    number: int
    length: int
    """Frames."""
    videos: Mapping[str, tuple[Path, float]]
    """File and the second in it at which the episode begins, of each key."""


def read_features(path: Path) -> tuple[dict[str, dict[str, Any]], float]:
    """Return the features and the frames per second. Raises `SourceError`, also for a data set of another version."""
    info = read_json(path)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(info, dict) or not isinstance(version, str):
        raise SourceError(f"{path} states no codebase_version; is it of LeRobot?")
    if not version.startswith("v3."):
        raise SourceError(
            f"{path} is of LeRobot {version}, which keeps a video for each episode; give that video, or convert the "
            "data set to v3.0 by lerobot's own script"
        )
    fps, features, video_path = info.get("fps"), info.get("features"), info.get("video_path", _VIDEO_PATH)
    if not isinstance(fps, int | float) or not 0 < fps < 10_000 or not isinstance(features, dict):
        raise SourceError(f"{path} states no fps or no features; is the copy complete?")
    if video_path != _VIDEO_PATH:
        raise SourceError(f"{path} has its videos at {video_path!r}, not at {_VIDEO_PATH}; convert it to LeRobot v3.0")
    found = {str(k): f for k, f in features.items() if isinstance(f, dict)}
    if not any(f.get("dtype") == "video" for f in found.values()):
        kept = " (its pictures lie in the tables: convert them to video by lerobot)" if "image" in str(found) else ""
        raise SourceError(f"{path}: no feature is a video{kept}; a memory needs pictures")
    return found, float(fps)


def read_episode(root: Path, keys: list[str], number: int | None) -> Episode:
    """The episode that was asked for, or the only one. Raises `SourceError` and `OptionError`."""
    columns = ["episode_index", "length"]
    for key in keys:
        columns += [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    rows = _rows(root, columns)
    if number is None and len(rows) > 1:
        raise OptionError(
            f"{root} has {len(rows)} episodes; choose one by --episode (0 to {max(rows)}), and add further ones "
            "with `list3r update`"
        )
    chosen = next(iter(rows)) if number is None else number
    if chosen not in rows:
        raise OptionError(f"--episode {chosen}: {root} has the episodes {min(rows)} to {max(rows)}")
    row = rows[chosen]
    videos = {}
    for key in keys:
        chunk, file, begins_s = (row[f"videos/{key}/{n}"] for n in ("chunk_index", "file_index", "from_timestamp"))
        name = f"videos/{key}/chunk-{int(chunk):03d}/file-{int(file):03d}.mp4"
        videos[key] = (inside(root, name, root / INFO), float(begins_s))
        if not videos[key][0].is_file():
            raise SourceError(f"{root / name}, which holds episode {chosen}, is missing; is the copy complete?")
    return Episode(chosen, int(row["length"]), videos)


def _rows(root: Path, columns: list[str]) -> dict[int, dict[str, float]]:
    """The episodes by number, with their `columns`. Raises `SourceError`; `OptionError` without the extra."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise OptionError(f"{root} is a LeRobot data set, which needs a package: {install_hint('parquet')}") from None
    found: dict[int, dict[str, float]] = {}
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        try:
            check_ordinary(path.stat(), path, MAX_TEXT_BYTES)
            with pq.ParquetFile(path) as file:
                _check_count(path, file.metadata.num_rows + len(found))
                rows = file.read(columns=columns, use_threads=False).to_pylist()
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise SourceError(f"{path} is not a table that can be read ({first_line(error)}); copy it again") from None
        found |= {int(row["episode_index"]): row for row in (_sound(path, row, columns) for row in rows)}
    if not found:
        raise SourceError(f"{root} has no episodes in meta/episodes; is the copy complete?")
    return found


def _check_count(path: Path, count: int) -> None:
    if count > _MOST_EPISODES:
        raise SourceError(f"{path} has over {_MOST_EPISODES:,} episodes; is it damaged?")


def _sound(path: Path, row: dict[str, float], columns: list[str]) -> dict[str, float]:
    """Return the row of an episode. Raises `SourceError` for one that lacks a number."""
    values = [row.get(name) for name in columns]
    if not all(isinstance(v, int | float) and np.isfinite(v) and v >= 0 for v in values):
        raise SourceError(f"{path}: an episode lacks its number, length or place in a video; copy it again")
    return row

"""The tasks of a batch: one for each video, read from a manifest or found in a folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from list3r.batch.storage import checked_name, children, is_remote, joined, listing, read_text
from list3r.frames.options import SourceOptions
from list3r.memory.core.errors import List3rError, OptionError
from list3r.memory.core.unpacking import parse_json
from list3r.pipeline.request import BuildRequest, RunOptions

_VIDEOS = frozenset((".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".bag", ".mcap", ".r3d"))
"""Endings of files that a folder of videos is searched for."""


@dataclass(frozen=True)
class BatchTask:
    """One video, and the memory that it goes to."""

    memory: str
    """Name of the memory, without its ending."""
    source: str
    """Path or URL of the video."""
    options: SourceOptions
    request: BuildRequest
    run: RunOptions
    source_hash: str
    """Of the names and sizes of its files; empty where they cannot be listed."""
    settings_hash: str
    """Of everything asked for."""

    @property
    def key(self) -> str:
        """Return the key of this task: 32 hexadecimal digits."""
        return _hashed([self.memory, self.source_hash or self.source, self.settings_hash])


@dataclass(frozen=True)
class Asked:
    """Options for every video of a batch."""

    options_of: Callable[[Mapping[str, Any]], SourceOptions]
    """Options of a source, from the fields of its line in the manifest; raises `TypeError` for one unknown."""
    request: BuildRequest = field(default_factory=BuildRequest)
    run: RunOptions = field(default_factory=RunOptions)


def read_tasks(where: str, asked: Asked) -> list[list[BatchTask]]:
    """Return the tasks of a manifest or a folder, those of one memory together and in their order.

    A manifest has a line for each video: its path or URL, or a JSON object with `source`, perhaps `memory`, and options
    of the source by name. Lines that name the same memory are its sessions. Raises `OptionError` naming the line.
    """
    lines = list(_lines(where))
    if not lines:
        raise OptionError(f"{where} names no video; give a manifest with one video per line, or a folder of videos")
    groups: dict[str, list[BatchTask]] = {}
    names_memory: dict[str, bool] = {}
    for at, fields in lines:
        named = "memory" in fields
        task = _task(at, dict(fields), asked)
        if task.memory in groups and not (named and names_memory[task.memory]):
            raise OptionError(
                f"{at}: a second video would go to {task.memory}.l3r; name its memory in the manifest, as in "
                f'{{"source": "{task.source}", "memory": "{task.memory}-2"}}'
            )
        if any(other.source == task.source for other in groups.get(task.memory, [])):
            raise OptionError(f"{at}: {task.source} is named a second time; remove the line")
        groups.setdefault(task.memory, []).append(task)
        names_memory[task.memory] = named
    return list(groups.values())


def _lines(where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the videos with their paths, as fields."""
    if (is_remote(where) and not PurePosixPath(where).suffix) or (not is_remote(where) and Path(where).is_dir()):
        for name, is_folder in children(where):
            if not name.startswith(".") and (is_folder or PurePosixPath(name).suffix.lower() in _VIDEOS):
                yield name, {"source": joined(where if is_remote(where) else str(Path(where).resolve()), name)}
        return
    base = where.rpartition("/")[0] if is_remote(where) else str(Path(where).resolve().parent)
    for number, line in enumerate(read_text(where).splitlines(), 1):
        text, at = line.strip(), f"{where}, line {number}"
        if not text or text.startswith("#"):
            continue
        fields = _object(text, at) if text.startswith("{") else {"source": text}
        source = fields.get("source")
        if not isinstance(source, str) or not source:
            raise OptionError(f'{at}: no source; write its path, or {{"source": "walk.mp4"}}')
        if not is_remote(source) and not Path(source).is_absolute():
            fields["source"] = joined(base, source)
        yield at, fields


def _object(text: str, at: str) -> dict[str, Any]:
    try:
        found = parse_json(text)
    except ValueError as error:
        raise OptionError(f"{at}: {error}; write a path or a JSON object") from error
    if not isinstance(found, dict):
        raise OptionError(f"{at}: write a path or a JSON object")
    return found


def _task(at: str, fields: dict[str, Any], asked: Asked) -> BatchTask:
    source = str(fields.pop("source"))
    memory = str(fields.pop("memory", None) or PurePosixPath(source).stem)
    try:
        checked_name(memory)
        options = asked.options_of(fields)
    except TypeError as error:
        unknown = next((name for name in fields if repr(name) in str(error)), ", ".join(fields))
        raise OptionError(f"{at}: {unknown} is not an option of a source; see `list3r build -h`") from None
    except List3rError as error:
        raise OptionError(f"{at}: {error}") from error
    settings = [asdict(options), asdict(asked.request), _shaping(asked.run)]
    return BatchTask(memory, source, options, asked.request, asked.run, _source_hash(source), _hashed(settings))


def _shaping(run: RunOptions) -> list[str]:
    """Return the options of a run that affect the memory."""
    return [run.licence, str(run.scale_anchor), str(run.detector), str(run.detector_classes)]


def _source_hash(source: str) -> str:
    """Return a hash of the names and sizes of the files of a source; empty where they cannot be listed."""
    try:
        return _hashed(listing(source))
    except (OSError, List3rError):
        return ""


def _hashed(value: Iterable[object]) -> str:
    return hashlib.sha256(json.dumps(list(value), default=_plain).encode()).hexdigest()[:32]


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)

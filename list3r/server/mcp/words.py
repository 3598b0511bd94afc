"""What an agent is told, in the words of the tools that it has: no command, no option, no folder of this machine."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

_INSTEAD = (
    (re.compile(r"`list3r (?:catalog )?list\b[^`]*` shows (the ids|them)"), r"the tools that list things show \1"),
    (re.compile(r"\(--from ID, "), "(an id, "),
    (re.compile(r" \(--object A --and B\)"), ": ask the tool `between` with a and b"),
    (re.compile(r"; --from names another"), ""),
)
_CLAUSE = re.compile(r"[;,.] (?:(?![;,] )[^`])*(?:`list3r [^`]*`|(?<!\S)--[a-z]).*$")
"""The last clause of a message, where it names a command or an option."""
_FOLDERS = re.compile(r"(?<![\w:/])/(?:[^/\s'\"`:;,]+/)+(?=[^/\s'\"`:;,])")


def of_tools(text: str, path: str = "") -> str:
    """Return a message of ours without what only a command line knows; `path` is the file that is served."""
    text = text.replace(path, PurePath(path).name) if path else text
    for pattern, instead in _INSTEAD:
        text = pattern.sub(instead, text)
    return _CLAUSE.sub("", _FOLDERS.sub("", text))


def answer_of_tools(answer: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return an answer with notes in such words, and files by their names alone."""
    out = dict(answer)
    if "notes" in out:
        out["notes"] = [of_tools(note, path) for note in out["notes"]]
    if "matches" in out:
        for match in (matches := [dict(m) for m in out["matches"]]):
            match |= {k: PurePath(match[k]).name for k in ("file", "path") if isinstance(match.get(k), str)}
        out["matches"] = matches
    return out

"""What the values of a row may be: type, range and shape of every column, checked once where a table is first read.

A checksum says that a row is as it was written; a stranger may have written anything. What is checked here is what the
rest of the program then takes for granted. The conditions run inside SQLite, one pass over a table.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from list3r.memory.store.checksums import BadRow, summed_tables
from list3r.memory.unpacking import parse_json

_MOST_TEXT = 4000
"""Characters of a label, description or reason."""
_MOST_JSON = 64 * 2**20
_MOST_CELL = 16 * 2**20
"""Bytes of a value that is looked into as a whole."""
_NUMBER = np.dtype("<f4")
"""Of vectors."""
_MOST_LENGTH = 1e7
"""World units that anything may be away or long."""
_MOST_LOG_SCALE = 20.0
_ID = 2**31 - 1
"""What ids and counts may be: receivers such as USD hold them in 32 bits."""
_TIME_S = 1e12


@dataclass(frozen=True)
class Rule:
    """What the values of one column may be."""

    condition: str
    """SQL over `{}`, the column."""
    words: str
    """What is wanted."""


def _number(low: float, high: float, words: str = "") -> Rule:
    kind = "typeof({}) IN ('integer', 'real')"
    return Rule(f"{kind} AND {{}} BETWEEN {low!r} AND {high!r}", words or f"a number from {low:g} to {high:g}")


def _integer(low: int, high: int = _ID) -> Rule:
    return Rule(f"typeof({{}}) = 'integer' AND {{}} BETWEEN {low} AND {high}", f"a whole number from {low} to {high}")


def _text(most: int = _MOST_TEXT) -> Rule:
    """Return the rule of a text; what SQLite calls its length ends at the first NUL, so its bytes are counted too."""
    bytes_most = f"length(CAST({{}} AS BLOB)) <= {4 * most}"
    return Rule(
        f"typeof({{}}) = 'text' AND length({{}}) <= {most} AND {bytes_most} AND list3r_text(CAST({{}} AS BLOB))",
        f"a text of at most {most} characters",
    )


def _one_of(*words: str) -> Rule:
    quoted = ", ".join(f"'{word}'" for word in words)
    return Rule(f"typeof({{}}) = 'text' AND {{}} IN ({quoted})", " or ".join(words))


def _checked(function: str, words: str, kind: str = "blob") -> Rule:
    return Rule(f"typeof({{}}) = '{kind}' AND length(CAST({{}} AS BLOB)) <= {_MOST_CELL} AND {function}({{}})", words)


def _maybe(rule: Rule) -> Rule:
    return Rule(f"({{}} IS NULL OR ({rule.condition}))", f"{rule.words}, or nothing")


def _bytes(each: int, words: str) -> Rule:
    return Rule(f"typeof({{}}) = 'blob' AND length({{}}) % {each} = 0", words)


_FLAG, _SHARE = _integer(0, 1), _number(0.0, 1.0)
_ANY = Rule("typeof({}) IN ('integer', 'real')", "a number")
"""It may be infinite, where nothing is known."""
_LENGTH = _number(0.0, 1e12)
_CHUNK, _LOCAL, _FRAME = _integer(0), _integer(-1), _integer(0)
_SIM3 = _checked("list3r_sim3", "a similarity")
_ARCHIVE = Rule("typeof({}) = 'blob'", "arrays")
_FIRST_FEATURE = (
    "SELECT length(o.feature) / 4 * 4 FROM local_instances o WHERE o.chunk_id = local_instances.chunk_id"
    " ORDER BY o.local_id LIMIT 1"
)

RULES: Mapping[str, Mapping[str, Rule]] = {
    "memory": {
        "key": _text(),
        "value": Rule(f"length({{}}) <= {_MOST_JSON} AND list3r_value(key, {{}})", "a value of that kind"),
    },
    "sessions": {
        "session_id": _integer(1),
        "source": _text(),
        "fingerprint": _text(),
        "settings": _checked("list3r_object", "an object of JSON", "text"),
        "frame_count": _integer(0),
        "state": _one_of("building", "complete"),
        "camera": _maybe(_checked("list3r_object", "an object of JSON", "text")),
        "cuts": _maybe(_checked("list3r_wholes", "a list of whole numbers", "text")),
        "depth_step": _maybe(_integer(1)),
        "lost_reasons": _checked("list3r_texts", "a list of texts", "text"),
    },
    "chunks": {
        "chunk_id": _CHUNK,
        "session_id": _integer(1),
        "chunk_index": _integer(0),
        "first_frame": _FRAME,
        "last_frame": Rule("typeof({}) = 'integer' AND {} >= first_frame", "a frame not before the first"),
        **{name: _number(1e-3, 1e7) for name in ("fx", "fy")},
        **{name: _number(-1e7, 1e7) for name in ("cx", "cy")},
        **{name: _integer(1, 2**17) for name in ("height", "width")},
        "scale_kind": _text(60),
        "feature_space": _text(),
        "cannot_link": _bytes(8, "pairs of whole numbers"),
        "overlap": _ARCHIVE,
        "seconds": _checked("list3r_numbers", "an object of numbers", "text"),
    },
    "edges": {
        **{name: _CHUNK for name in ("u", "v")},
        "kind": _text(60),
        **{name: _integer(-1) for name in ("frame_u", "frame_v")},
        "S_v_u": _SIM3,
        "confidence": _SHARE,
        "weight": _LENGTH,
        "inliers": _integer(0),
        "residual_m": _LENGTH,
        "accepted": _FLAG,
        "reason": _text(),
        "scores": _checked("list3r_numbers", "an object of numbers", "text"),
        "covariance": _maybe(_checked("list3r_covariance", "7x7 finite numbers")),
    },
    "frames": {
        "session_id": _integer(1),
        "frame_index": _FRAME,
        "time_s": _number(-_TIME_S, _TIME_S),
        "chunk_id": _CHUNK,
        "state": _one_of("posed", "lost", "bad"),
        "T_chunk_cam": Rule(
            "typeof({}) = 'blob' AND length({}) = 128 AND (state != 'posed' OR list3r_pose({}))", "a rigid pose"
        ),
        "note": _text(),
    },
    "keyframes": {
        "chunk_id": _CHUNK,
        "frame_index": _FRAME,
        "descriptor": _bytes(4, "numbers"),
        "features": _ARCHIVE,
        "jpeg": Rule("typeof({}) = 'blob'", "a picture"),
    },
    "local_instances": {
        "chunk_id": _CHUNK,
        "local_id": _LOCAL,
        "stability": _ANY,
        "structure": _FLAG,
        "plane": _maybe(_checked("list3r_plane", "four finite numbers")),
        "feature": Rule(f"typeof({{}}) = 'blob' AND length({{}}) = ({_FIRST_FEATURE})", "as long as the chunk's first"),
        "track": _ARCHIVE,
        "dynamic": _FLAG,
        "motion": _maybe(_ARCHIVE),
        "scrap": _FLAG,
    },
    "supports": {
        "chunk_id": _CHUNK,
        "local_id": _LOCAL,
        "count": _integer(0, 2**31),
        "grid": _checked("list3r_plane", "an origin and a step"),
        "points": Rule("typeof({}) = 'blob' AND length({}) = 6 * count", "three numbers a point"),
        "confidence": Rule("typeof({}) = 'blob' AND length({}) = count", "one number a point"),
        "rgb": Rule("typeof({}) = 'blob' AND length({}) = 3 * count", "three numbers a point"),
    },
    "instances": {
        "id": _integer(1),
        "label": _maybe(_text()),
        "description": _text(),
        "geometry": _checked("list3r_geometry", "a finite box"),
        "confidence": _SHARE,
        "observations": _integer(0),
        "first_seen_s": _ANY,
        "last_seen_s": _ANY,
        "state": _text(60),
        "structure": _maybe(_text(60)),
        "color_rgb": _integer(0, 2**24 - 1),
        "color_name": _text(60),
        "component": _integer(0),
        "view_session": _maybe(_integer(1)),
        "view_frame": Rule("view_session IS NULL OR (typeof({}) = 'integer' AND {} >= 0)", "a frame"),
        "view_box": Rule("view_session IS NULL OR (typeof({}) = 'blob' AND list3r_box({}))", "a box in a picture"),
        "dynamic": _FLAG,
        "position_sigma_m": _maybe(_LENGTH),
    },
    "observations": {"chunk_id": _CHUNK, "local_id": _LOCAL, "instance": _integer(1)},
    "embeddings": {
        "instance": _integer(1),
        "space": _text(),
        "vector": Rule("typeof({}) = 'blob' AND length({}) % 4 = 0 AND list3r_vector({})", "finite numbers"),
    },
    "relations": {
        "subject": _integer(1),
        "predicate": _text(60),
        "object": _integer(1),
        "confidence": _SHARE,
        "margin": _ANY,
    },
    "merges": {
        "entry": _integer(1),
        "chunk_id": _integer(0),
        **{name: _text() for name in ("kind", "a", "b", "reason")},
        "scores": _checked("list3r_object", "an object of JSON", "text"),
    },
    "votes": {
        "chunk_id": _CHUNK,
        "local_id": _LOCAL,
        "source": _text(),
        "missed": _number(-1e9, 1e9),
        "classes": _checked("list3r_votes", "pairs of numbers by class", "text"),
        "looks": _number(0.0, 1e9),
    },
    "detected_labels": {
        "instance": _integer(1),
        **{name: _text() for name in ("label", "detector")},
        "confidence": _SHARE,
        "found": _number(0.0, 1e9),
    },
    "aliases": {"id": _integer(1), "instance": _integer(1)},
    "placements": {
        "chunk_id": _CHUNK,
        "component": _integer(0),
        "S_world_chunk": _SIM3,
        "covariance": _maybe(_checked("list3r_covariance", "7x7 finite numbers")),
    },
    "settled": {
        "chunk_id": _CHUNK,
        "component": _integer(0),
        "S_graph_chunk": _SIM3,
        "extent": Rule("typeof({}) = 'blob' AND length({}) = 48", "a box"),
        "dropped": Rule("typeof({}) = 'blob'", "bits"),
        "carried": Rule("typeof({}) = 'blob' AND length({}) = 32", "four numbers"),
    },
    "overlaps": {"scores": _bytes(36, "six numbers a pair")},
    "members": {"first_chunk": _CHUNK, "first_local": _LOCAL, "shown": _FLAG},
    "anchors": {"instance": _integer(1), "chunk_id": _CHUNK, "S_exact_settled": _SIM3},
    "redundant": {
        "chunk_id": _CHUNK,
        "local_id": _LOCAL,
        "like_chunk": _CHUNK,
        "like_local": _LOCAL,
        "frames": _bytes(4, "numbers"),
    },
    "looks": {
        "instance": _integer(1),
        "shape": _text(60),
        "resting": _FLAG,
        "swatches": Rule(
            f"typeof({{}}) = 'blob' AND length({{}}) BETWEEN 56 AND {_MOST_CELL} AND length({{}}) % 56 = 0"
            " AND list3r_colors({})",
            "seven finite numbers a colour",
        ),
    },
    "bends": {
        "chunk_id": _CHUNK,
        "frames": _checked("list3r_places", "finite numbers"),
        "twists": Rule(
            "typeof({}) = 'blob' AND length({}) = 7 * length(frames) AND list3r_twists({})",
            "seven finite numbers a frame",
        ),
    },
    "edits": {
        "entry": _integer(1),
        "created_at": _text(),
        "author": _text(),
        "kind": _text(60),
        "arguments": _checked("list3r_object", "an object of JSON", "text"),
    },
    "events": {
        "session_id": _integer(1),
        "instance": _integer(1),
        "kind": _text(60),
        **{name: _maybe(_checked("list3r_place", "a finite box")) for name in ("from_box", "to_box")},
        "frames": _checked("list3r_pairs", "pairs of whole numbers", "text"),
        "confidence": _SHARE,
        "reason": _text(),
    },
}

REFERENCES = (
    ("observations", "instance", "instances", "id"),
    ("observations", "chunk_id", "chunks", "chunk_id"),
    ("relations", "subject", "instances", "id"),
    ("relations", "object", "instances", "id"),
    ("embeddings", "instance", "instances", "id"),
    ("frames", "chunk_id", "chunks", "chunk_id"),
    ("frames", "session_id", "sessions", "session_id"),
    ("chunks", "session_id", "sessions", "session_id"),
    ("placements", "chunk_id", "chunks", "chunk_id"),
    ("chunks", "chunk_id", "placements", "chunk_id"),
    ("edges", "u", "chunks", "chunk_id"),
    ("edges", "v", "chunks", "chunk_id"),
    ("keyframes", "chunk_id", "chunks", "chunk_id"),
    ("local_instances", "chunk_id", "chunks", "chunk_id"),
    ("supports", "chunk_id", "chunks", "chunk_id"),
    ("observations", "chunk_id, local_id", "local_instances", "chunk_id, local_id"),
    ("supports", "chunk_id, local_id", "local_instances", "chunk_id, local_id"),
    ("anchors", "instance", "instances", "id"),
    ("looks", "instance", "instances", "id"),
    ("redundant", "chunk_id", "chunks", "chunk_id"),
    ("votes", "chunk_id", "chunks", "chunk_id"),
    ("detected_labels", "instance", "instances", "id"),
    ("events", "instance", "instances", "id"),
    ("events", "session_id", "sessions", "session_id"),
)
"""Table, columns, and where their values must be found."""


def bad_values(database: sqlite3.Connection, name: str, where: str = "1", arguments: Any = ()) -> Iterator[BadRow]:
    """Rows of a table that no program of ours writes, whatever their checksums say."""
    rules = RULES.get(name, {})
    if not rules:
        return
    keys = summed_tables()[name].key
    conditions = {column: f"coalesce({rule.condition.replace('{}', column)}, 0)" for column, rule in rules.items()}
    bad = " AND ".join(conditions.values())
    for function, check in ((f, c) for f, c in _FUNCTIONS.items() if f in bad):
        database.create_function(function, check.__code__.co_argcount, _never_raising(check), deterministic=True)
    query = f"SELECT {', '.join(keys)} FROM {name} WHERE {where} AND NOT ({bad})"
    for key in database.execute(query, arguments).fetchall():
        here = " AND ".join(f"{k} IS ?" for k in keys)
        verdict = database.execute(f"SELECT {', '.join(conditions.values())} FROM {name} WHERE {here}", key).fetchone()
        wrong = [column for column, good in zip(conditions, verdict or (), strict=False) if not good]
        yield BadRow(name, key, f"{wrong[0]} is not {rules[wrong[0]].words}" if wrong else "its key is of another type")


def bad_references(database: sqlite3.Connection, name: str) -> Iterator[str]:
    """Values of a table that point nowhere, and ids that stand for one another in a circle."""
    for source, column, other, target in REFERENCES:
        if source == name:
            query = f"SELECT DISTINCT {column} FROM {source} WHERE ({column}) NOT IN (SELECT {target} FROM {other})"
            found = database.execute(query)
            yield from (f"{source}: {column} {', '.join(map(str, row))} is not in {other}" for row in found)
    if name == "keyframes":
        inside = "SELECT 1 FROM chunks c WHERE c.chunk_id = k.chunk_id AND k.frame_index >= c.first_frame"
        query = (
            f"SELECT chunk_id, frame_index FROM keyframes k WHERE NOT EXISTS ({inside} AND frame_index <= last_frame)"
        )
        yield from (f"keyframes {u}:{n}: it is not a frame of its chunk" for u, n in database.execute(query))
    if name == "overlaps":
        chunks = "SELECT u AS chunk_id FROM overlaps UNION SELECT v FROM overlaps"
        alone = "SELECT chunk_id FROM redundant EXCEPT SELECT chunk_id FROM members"
        for (chunk_id,) in database.execute(f"{chunks} INTERSECT SELECT * FROM ({alone})"):
            yield f"overlaps: chunk {chunk_id} is redundant and has none"
    if name == "aliases":
        yield from _circles(dict(database.execute("SELECT id, instance FROM aliases").fetchall()))


def _circles(aliases: Mapping[int, int]) -> Iterator[str]:
    done: set[int] = set()
    for start in aliases:
        way: dict[int, None] = {}
        at = start
        while at in aliases and at not in done:
            if at in way:
                yield f"aliases {at}: it stands for itself"
                break
            way[at] = None
            at = aliases[at]
        done.update(way)


def _never_raising(check: Callable[..., bool]) -> Callable[..., int]:
    def checked(*values: Any) -> int:
        try:
            return int(bool(check(*values)))
        except (ValueError, TypeError, KeyError, IndexError, RecursionError, OverflowError, AttributeError):
            return 0

    return checked


# --------------------------------------------------------------------------------------------- checks of one value


def _is_text(data: bytes) -> bool:
    data.decode("utf-8")
    return True


def _is_object(text: str) -> bool:
    return isinstance(parse_json(text), dict)


def _are_numbers(text: str) -> bool:
    held = parse_json(text)
    return isinstance(held, dict) and all(v is None or _finite(v) for v in held.values())


def _are_pairs(text: str) -> bool:
    held = parse_json(text)
    return isinstance(held, list) and all(len(p) == 2 and all(type(n) is int and 0 <= n < _ID for n in p) for p in held)


def _are_wholes(text: str) -> bool:
    held = parse_json(text)
    return isinstance(held, list) and all(type(n) is int and 0 <= n < _ID for n in held)


def _are_texts(text: str) -> bool:
    held = parse_json(text)
    return isinstance(held, list) and all(isinstance(t, str) and len(t) <= _MOST_TEXT for t in held)


def _are_votes(text: str) -> bool:
    held = parse_json(text)
    return isinstance(held, dict) and all(len(pair) == 2 and all(map(_finite, pair)) for pair in held.values())


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _floats(blob: bytes, count: int, most: float) -> Any:
    """Doubles, none of which is larger. Raises `ValueError`."""
    values = np.frombuffer(blob, "<f8")
    if len(values) != count or not (np.abs(values) <= most).all():
        raise ValueError
    return values


def _is_rotation(matrix: Any) -> bool:
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3 and np.linalg.det(matrix) > 0)


def _are_colors(blob: bytes) -> bool:
    return len(_floats(blob, len(blob) // 8, 256.0)) > 0


def _is_sim3(blob: bytes) -> bool:
    values = _floats(blob, 13, _MOST_LENGTH)
    return 1e-9 < values[0] < 1e9 and _is_rotation(values[1:10].reshape(3, 3))


def _is_pose(blob: bytes) -> bool:
    matrix = _floats(blob, 16, _MOST_LENGTH).reshape(4, 4)
    return _is_rotation(matrix[:3, :3]) and bool(np.abs(matrix[3] - [0, 0, 0, 1]).max() < 1e-6)


def _is_covariance(blob: bytes) -> bool:
    _floats(blob, 49, 1e300)
    return True


def _is_plane(blob: bytes) -> bool:
    _floats(blob, 4, _MOST_LENGTH)
    return True


def _is_geometry(blob: bytes) -> bool:
    values = _floats(blob, 24, _MOST_LENGTH)
    return bool((values[3:6] <= values[6:9]).all() and (values[12:15] >= 0).all()) and _is_rotation(
        values[15:24].reshape(3, 3)
    )


def _are_places(blob: bytes) -> bool:
    _floats(blob, len(blob) // 8, float(_ID))
    return len(blob) % 8 == 0


def _are_twists(blob: bytes) -> bool:
    twists = _floats(blob, len(blob) // 56 * 7, _MOST_LENGTH).reshape(-1, 7)
    return bool((np.abs(twists[:, 6]) < _MOST_LOG_SCALE).all())


def _is_place(blob: bytes) -> bool:
    values = _floats(blob, 15, _MOST_LENGTH)
    return bool((values[3:6] >= 0).all()) and _is_rotation(values[6:15].reshape(3, 3))


def _is_box(blob: bytes) -> bool:
    x0, y0, x1, y1 = _floats(blob, 4, 1e6)
    return bool(x0 <= x1 and y0 <= y1)


def _is_vector(blob: bytes) -> bool:
    return len(blob) > 0 and b"\0" not in np.isfinite(np.frombuffer(blob, _NUMBER)).tobytes()


def _is_value(key: str, text: str) -> bool:
    value = parse_json(text)
    check = _VALUES.get(key)
    return check is None or value is None or bool(check(value))


def _is_similarity(value: Any) -> bool:
    matrix = np.array(value, dtype=np.float64)
    linear = matrix[:3, :3]
    scale = np.cbrt(abs(np.linalg.det(linear)))
    small = bool(np.isfinite(matrix).all() and np.abs(matrix).max() <= _MOST_LENGTH)
    return matrix.shape == (4, 4) and small and 1e-9 < scale < 1e9 and _is_rotation(linear / scale)


_VALUES: Mapping[str, Callable[[Any], object]] = {
    "gravity": lambda v: v in ("known", "estimated", "assumed", "unknown"),
    "gravity_deviation_deg": lambda v: _finite(v) and 0 <= v <= 180,
    "T_world_graph": _is_similarity,
    "gravity_estimate": lambda v: len(v["up"]) == 3 and all(map(_finite, [*v["up"], v["floor_height"] or 0.0])),
    "last_id": lambda v: type(v) is int and 0 <= v < _ID,
    "metres_per_graph_unit": lambda v: _finite(v) and 0 < v < 1e12,
    **{
        name: lambda v: isinstance(v, str) and len(v) <= _MOST_TEXT
        for name in ("scale_kind", "scale_source", "created_by", "poses")
    },
    **{name: lambda v: isinstance(v, dict) for name in ("library", "change_ledger", "text_models", "label classes")},
}

_FUNCTIONS: Mapping[str, Callable[..., bool]] = {
    "list3r_text": _is_text,
    "list3r_object": _is_object,
    "list3r_numbers": _are_numbers,
    "list3r_pairs": _are_pairs,
    "list3r_wholes": _are_wholes,
    "list3r_texts": _are_texts,
    "list3r_votes": _are_votes,
    "list3r_sim3": _is_sim3,
    "list3r_pose": _is_pose,
    "list3r_covariance": _is_covariance,
    "list3r_plane": _is_plane,
    "list3r_geometry": _is_geometry,
    "list3r_place": _is_place,
    "list3r_places": _are_places,
    "list3r_twists": _are_twists,
    "list3r_box": _is_box,
    "list3r_vector": _is_vector,
    "list3r_value": _is_value,
    "list3r_colors": _are_colors,
}

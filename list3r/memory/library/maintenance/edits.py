"""What an operator does to the library: merge, split, label, delete, scale, undo.

Each is one transaction and one log entry.

An edit is written down in terms of local instances (chunk:local), which never change; then the library is derived again
under all edits that stand (`memory.core.constraints`), and so it is whenever a chunk arrives later.
"""

from __future__ import annotations

import getpass
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from list3r.memory.core.constraints import Edit, Key, key_name, standing
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import JsonFields, MergeDecision, Observation
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels
from list3r.memory.library.maintenance.split_proposal import propose_split
from list3r.memory.library.rooms.naming import keyframes_in
from list3r.memory.library.world.scale import measure, parse_anchor, rescale
from list3r.memory.store.store import Store
from list3r.memory.store.tables.edits import LogEntry

Before = tuple[tuple[int, str | None, tuple[Key, ...]], ...]
_LONGEST = 200


@dataclass(frozen=True)
class EditReport(JsonFields):
    """What an edit did."""

    entry: int
    """Its number in the merge log, for `undo`."""
    kind: str
    """merge, split, label, delete, scale, room, undo."""
    ids: tuple[int, ...]
    """The instances that are there now of what it touched, the one that was spoken of first."""
    new: tuple[int, ...]
    """Ids given for the first time."""
    aliases: tuple[tuple[int, int], ...]
    """(id that retired, id that stands for it now)."""
    restored: tuple[int, ...]
    """Ids that had retired and name an instance again."""
    text: str
    """One sentence."""


def merge(store: Store, a: int, b: int, author: str | None = None) -> EditReport:
    """Say that two instances are one, whatever their overlap says; the older id stays, the other becomes its alias.

    Raises `UnknownIdError`, and `OptionError` for two that are one already or lie in parts that were never joined.
    """
    with store.transaction():
        first, second = sorted((store.ids.resolve(a), store.ids.resolve(b)))
        if first == second:
            raise OptionError(f"{a} and {b} are already one instance, #{first}")
        if store.instances.get(first).component != store.instances.get(second).component:
            raise OptionError(
                f"#{first} and #{second} lie in parts of the memory that were never joined, each with its own frame of "
                "reference; add a session that connects them first"
            )
        before = _as_they_are(store, [first, second])
        edit = _edit("merge", (before[0][2], before[1][2]), before, author)
        return _carry_out(store, edit, (f"#{first}", f"#{second}"), f"{edit.author} merged #{second} into #{first}")


def split(store: Store, instance_id: int, out: Sequence[Key] | None = None, author: str | None = None) -> EditReport:
    """Split an instance into two: `out`, local instances (chunk id, local id) of it, and the rest.

    Without `out` it is split where the evidence is strongest. The larger part keeps the id, the other gets a new one.
    Raises `UnknownIdError`, and `OptionError` when there is nothing to split or `out` is not a part of it.
    """
    with store.transaction():
        known = store.ids.resolve(instance_id)
        before = _as_they_are(store, [known])
        keys = before[0][2]
        if len(keys) < 2:
            raise OptionError(f"#{known} was seen as one piece in one chunk only; there is nothing to split")
        leaving = _checked_part(known, keys, out) if out is not None else propose_split(store, keys)
        staying = tuple(k for k in keys if k not in set(leaving))
        edit = _edit("split", (staying, tuple(sorted(leaving))), before, author)
        names = ", ".join(map(key_name, edit.parts[1]))
        return _carry_out(store, edit, (f"#{known}", names), f"{edit.author} split #{known}: {names} left it")


def label(store: Store, instance_id: int, text: str | None, author: str | None = None) -> EditReport:
    """Give an instance a name; nothing, or an empty text, takes it away. Raises `UnknownIdError` and `OptionError`."""
    cleaned = _line(text or "", "label") or None
    with store.transaction():
        known = store.ids.resolve(instance_id)
        before = _as_they_are(store, [known])
        edit = replace(_edit("label", (before[0][2],), before, author), text=cleaned)
        reason = f"{edit.author} named #{known} {cleaned!r}" if cleaned else f"{edit.author} unlabelled #{known}"
        edit = _write_down(store, edit, (f"#{known}", cleaned or ""), reason)
        store.instances.set_labels({known: cleaned})
        return EditReport(edit.entry, "label", (known,), (), (), (), reason)


def name_room(store: Store, room: int, text: str | None, author: str | None = None) -> EditReport:
    """Give a room a name; nothing, or an empty text, takes the name of a person away.

    Raises `OptionError` for a room that there is not, or in which no keyframe was taken.
    """
    cleaned = _line(text or "", "name") or None
    with store.transaction():
        found = next((r for r in store.rooms.all() if r.id == room), None)
        if found is None:
            raise OptionError(f"{store.path} has no room {room}; `list3r rooms {store.path}` lists the rooms")
        keys = keyframes_in(store, found)
        if not keys:
            raise OptionError(f"room {room} was only seen from other rooms; film it from inside to name it")
        edit = replace(_edit("room", (keys,), (), author), text=cleaned)
        reason = f"{edit.author} named room {room} {cleaned!r}" if cleaned else f"{edit.author} unnamed room {room}"
        edit = _write_down(store, edit, (f"room {room}", cleaned or ""), reason)
        return EditReport(edit.entry, "room", (), (), (), (), reason)


def delete(store: Store, instance_id: int, author: str | None = None) -> EditReport:
    """Take an instance out of the library, with all that is seen of it later. Raises `UnknownIdError`."""
    with store.transaction():
        known = store.ids.resolve(instance_id)
        before = _as_they_are(store, [known])
        edit = _edit("delete", (before[0][2],), before, author)
        return _carry_out(store, edit, (f"#{known}", ""), f"{edit.author} deleted #{known}")


def scale(store: Store, anchor: str, author: str | None = None) -> EditReport:
    """Say how long something is, so that lengths are metres from now on; see `memory.scale` for what can be said.

    The last anchor that stands counts. Raises `OptionError` where it cannot be measured or the memory is metric.
    """
    parsed = parse_anchor(_line(anchor, "anchor"))
    with store.transaction():
        found = measure(store, parsed)
        what = f"#{store.ids.resolve(parsed.instance_id)}" if parsed.kind in ("size", "height") else parsed.kind
        edit = _edit("scale", (found.keys,) if found.keys else (), (), author)
        edit = replace(edit, text=parsed.text, scale=(found.chunk_id, found.metres_per_unit))
        reason = f"{edit.author} anchored the scale: {parsed.text} where it was {found.length:.4g} units"
        return _carry_out(store, edit, (what, parsed.text), reason)


def undo(store: Store, entry: int | None = None, author: str | None = None) -> EditReport:
    """Take back an edit, or a decision of the merge log, by its entry; the last edit that stands without one.

    Undoing an undo brings the edit back. Ids that had retired come back. Raises `OptionError` for an entry that there
    is not, that is already undone, or that decided nothing.
    """
    with store.transaction():
        edits = store.edits.all()
        in_force = standing(edits)
        if entry is None:
            last = [e.entry for e in in_force if e.kind != "undo"]
            if not last:
                raise OptionError(f"{store.path} has no edit to undo; for a decision of the merge log, give its ENTRY")
            entry = last[-1]
        chosen = next((e for e in edits if e.entry == entry), None)
        if chosen is None:
            return _undo_decision(store, entry, author)
        if chosen not in in_force:
            raise OptionError(f"entry {entry} is already undone; undo the undo to bring it back")
        touched = sorted({k for _, _, keys in chosen.before for k in keys})
        edit = replace(_edit("undo", (), _owners(store, touched), author), target=entry)
        what = f"the undo of entry {chosen.target}" if chosen.kind == "undo" else f"the {chosen.kind}"
        reason = f"{edit.author} undid {what} of entry {entry}"
        if chosen.kind == "undo":
            reason = f"{edit.author} undid the undo of entry {chosen.target}"
        return _carry_out(store, edit, (f"entry {entry}", ""), reason, bring_back=chosen.before)


# ---------------------------------------------------------------------------------------------- one decision


def _undo_decision(store: Store, entry: int, author: str | None) -> EditReport:
    """Decide otherwise what merging decided, by an edit of the two local instances that it spoke of."""
    found = next((e for e in store.merges.all() if e.entry == entry), None)
    if found is None:
        raise OptionError(f"the log has no entry {entry}; `list3r edit log {store.path}` shows all")
    d = found.decision
    if d.kind not in ("merge", "refuse"):
        raise OptionError(f"entry {entry} ({d.kind}) only records what became of ids; undo the merge that led to it")
    a, b = _key(d.a, found), _key(d.b, found)
    before = _owners(store, [a, b])
    one = len(before) == 1 and len(before[0][2]) > 0 and {a, b} <= set(before[0][2])
    if one != (d.kind == "merge"):
        raise OptionError(f"entry {entry} no longer applies: {d.a} and {d.b} are {'one' if one else 'two'} now")
    edit = replace(_edit("split" if one else "merge", ((a,), (b,)), before, author), target=entry)
    reason = f"{edit.author} undid the {d.kind} of entry {entry}"
    return _carry_out(store, edit, (d.a, d.b), reason)


def _key(name: str, entry: LogEntry) -> Key:
    try:
        chunk, local = name.split(":")
        return int(chunk), int(local)
    except ValueError:
        raise OptionError(f"entry {entry.entry} names no local instances, so it cannot be undone") from None


# ---------------------------------------------------------------------------------------------- carrying out


def _edit(kind: str, parts: tuple[tuple[Key, ...], ...], before: Before, author: str | None) -> Edit:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return Edit(0, now, _line(author or "", "author") or _user(), kind, parts, 0, before)


def _line(text: str, what: str) -> str:
    """Return the text on one line. Raises `OptionError` when it is none that people can read."""
    line = " ".join(text.split())
    if len(line) > _LONGEST or not line.isprintable():
        raise OptionError(f"the {what} is one line of at most {_LONGEST} printable characters")
    return line


def _user() -> str:
    try:
        return _line(getpass.getuser(), "user")
    except (OSError, KeyError, ImportError, OptionError):
        return "somebody"


def _as_they_are(store: Store, ids: Sequence[int]) -> Before:
    """Return what an undo brings back: ids, labels and local instances of instances."""
    return tuple(
        (n, store.instances.get(n).label, tuple((o.chunk_id, o.local_id) for o in store.observations.of(n)))
        for n in ids
    )


def _owners(store: Store, keys: Sequence[Key]) -> Before:
    """Return the same of all instances that any of these local instances belong to."""
    home = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    return _as_they_are(store, sorted({home[k] for k in keys if k in home}))


def _write_down(store: Store, edit: Edit, names: tuple[str, str], reason: str) -> Edit:
    """Append the edit to the log and to the edits; the edit with its number."""
    through = max((c.chunk_id for c in store.chunks.all()), default=0)
    entry = store.merges.add(through, MergeDecision(f"edit {edit.kind}", *names, {}, reason))
    edit = replace(edit, entry=entry, through=through)
    store.edits.add(edit)
    return edit


def _carry_out(store: Store, edit: Edit, names: tuple[str, str], reason: str, bring_back: Before = ()) -> EditReport:
    """Write the edit down, derive the library again, and see to it that every id still resolves."""
    if any(not keys for _, _, keys in edit.before):
        raise OptionError(
            f"{store.path} does not hold the local instances of {names[0]}; only its label can be changed"
        )
    edit = _write_down(store, edit, names, reason)
    there = {i.id for i in store.instances.all()}
    aliases = store.ids.aliases()
    _give_back(store, bring_back, there, aliases)
    if _of_scale(store, edit):
        rescale(store)
    report = consolidate(store)
    home = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    _check_effect(edit, home)
    now = {i.id: i.label for i in store.instances.all()}
    named = {n for keys, _ in store.edits.constraints().labels for n in {home.get(k) for k in keys}}
    store.instances.set_labels({n: text for n, text, _ in bring_back if n in now and n not in named})
    retired = _retired(store, edit.before + bring_back, home, now, dict(report.merged))
    store.ids.add_aliases(retired)
    store.ids.drop_revived_aliases()
    touched = sorted({home[k] for _, _, keys in edit.before + bring_back for k in keys if k in home})
    apply_labels(store, written=None if report.written is None else report.written | {*touched})
    first = [n for n, _, _ in bring_back + edit.before if n in touched]
    return EditReport(
        entry=edit.entry,
        kind=edit.kind,
        ids=tuple(dict.fromkeys([*first, *touched])),
        new=tuple(n for n in report.new if n in touched),
        aliases=tuple((old, new) for old, new in sorted(store.ids.aliases().items()) if aliases.get(old) != new),
        restored=tuple(n for n in touched if n not in there and n not in report.new),
        text=reason,
    )


def _of_scale(store: Store, edit: Edit) -> bool:
    """Return whether it anchors the scale, or takes an anchor back, or brings one back."""
    edits = {e.entry: e for e in store.edits.all()}
    while edit.kind == "undo" and edit.target in edits:
        edit = edits[edit.target]
    return edit.kind == "scale"


def _give_back(store: Store, before: Before, there: Collection[int], aliases: Mapping[int, int]) -> None:
    """Ids that retired own again what they owned and what has not gone to a third one since."""
    home = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    for instance_id, _, keys in before:
        if instance_id not in there:
            heir = aliases.get(instance_id)
            while heir is not None and heir not in there and heir in aliases:
                heir = aliases[heir]
            own = [k for k in keys if home.get(k) in (None, heir)]
            store.observations.set(Observation(instance_id, *key) for key in own)


def _check_effect(edit: Edit, home: Mapping[Key, int]) -> None:
    """Raise an error, so that nothing is written, where other evidence was stronger than the operator's word."""
    if edit.kind in ("merge", "split"):
        left, right = ({home[k] for k in part if k in home} for part in edit.parts)
        if left and right and (left == right) != (edit.kind == "merge"):
            raise OptionError(f"the {edit.kind} has no effect: what was seen moving contradicts it")


def _retired(
    store: Store, before: Before, home: Mapping[Key, int], now: Mapping[int, str | None], merged: Mapping[int, int]
) -> dict[int, int]:
    """Return ids that were touched, name no instance now and have no alias yet: what most of them has become."""
    out = {}
    known = store.ids.aliases()
    for instance_id, _, keys in before:
        heirs = [home[k] for k in keys if k in home]
        if instance_id in now or not heirs or known.get(instance_id) in now:
            continue
        out[instance_id] = merged.get(instance_id, max(sorted(set(heirs)), key=heirs.count))
    return out


def _checked_part(instance_id: int, keys: Sequence[Key], out: Sequence[Key]) -> tuple[Key, ...]:
    wrong = [k for k in out if k not in keys]
    if wrong:
        known = f"`list3r show MEMORY {instance_id} --json` lists them"
        raise OptionError(f"{key_name(wrong[0])} is not a part of #{instance_id}; {known}")
    if not out or set(out) == set(keys):
        raise OptionError(f"a part of #{instance_id} must leave and a part must stay; it has {len(keys)} parts")
    return tuple(sorted(set(out)))

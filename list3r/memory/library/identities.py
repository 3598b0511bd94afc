"""Ids that last: which group of local instances goes on under which id."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from list3r.memory.library.overlap.pair_scores import Key


@dataclass(frozen=True)
class Identities:
    """Who is who now."""

    of_group: tuple[int | None, ...]
    """Id of each group, None for one that is not shown."""
    new: tuple[int, ...]
    """Ids given for the first time."""
    aliases: tuple[tuple[int, int], ...]
    """(id that retires, id that it resolves to now)."""
    splits: tuple[tuple[int, int], ...]
    """(id that was split, id of a part that left it)."""
    last_id: int
    """The largest id ever given."""


def assign_ids(
    groups: Sequence[Sequence[Key]],
    before: Mapping[Key, int],
    weights: Mapping[Key, int],
    shown: Sequence[bool],
    within: Sequence[int | None],
    next_id: int,
) -> Identities:
    """Give every shown group an id.

    An id goes on with the group that holds most (by `weights`) of what it named before; where several ids come to one
    group the oldest stays and the others become aliases. Parts that left an id, and groups never seen, get new ids in
    the order of the groups; ids are never used again. A group that is not `shown` has no id; one that it had becomes an
    alias of the group that it is `within`, and it stays shown where there is none.
    """
    visible = [s or w is None for s, w in zip(shown, within, strict=True)]
    share: dict[int, dict[int, int]] = {}
    for n, group in enumerate(groups):
        for key in group:
            if key in before:
                part = share.setdefault(before[key], {})
                part[n] = part.get(n, 0) + weights[key]
    heirs = {old: min(parts, key=lambda n: (-parts[n], n)) for old, parts in share.items()}
    owner: dict[int, int] = {}
    aliases: list[tuple[int, int]] = []
    retired: list[tuple[int, int]] = []
    for old in sorted(heirs):
        n = heirs[old]
        other = within[n]
        if not visible[n] and other is not None:
            retired.append((old, other))
        elif n in owner:
            aliases.append((old, owner[n]))
        else:
            owner[n] = old
    splits: list[tuple[int, int]] = []
    new: list[int] = []
    for n, group in enumerate(groups):
        if n in owner or not shown[n]:
            continue
        owner[n] = next_id
        new.append(next_id)
        splits += [(old, next_id) for old in sorted({before[key] for key in group if key in before})]
        next_id += 1
    aliases += [(old, owner[n]) for old, n in retired]
    ids = tuple(owner.get(n) for n in range(len(groups)))
    return Identities(ids, tuple(new), tuple(aliases), tuple(splits), next_id - 1)

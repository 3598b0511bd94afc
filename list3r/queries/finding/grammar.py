"""The grammar of `find`: [attributes] noun [relation [attributes] noun [relation ...]].

    white mug on table          chair next to 12          the biggest red thing near the door
    small box in the cabinet    mugs left of the laptop   lamp between 4 and the sofa

A phrase is what stands before, between and after relations: words that a thing must bear, words of size, and the
number of an instance instead of all that. Relations bind to the right: in "mug on the table near the door" the table
is the one near the door; "and" binds what follows to the first thing again: "mug on the table and next to 12".
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from list3r.memory.description.words import split_words
from list3r.memory.errors import OptionError

RELATIONS: dict[str, tuple[str, ...]] = {
    "on top of": ("on",),
    "hanging on": ("attached_to",),
    "mounted on": ("attached_to",),
    "attached to": ("attached_to",),
    "fixed to": ("attached_to",),
    "sitting on": ("on",),
    "standing on": ("on",),
    "lying on": ("on",),
    "on": ("on", "attached_to"),
    "upon": ("on",),
    "at": ("on", "attached_to", "next_to", "near"),
    "inside of": ("in",),
    "inside": ("in",),
    "into": ("in",),
    "in": ("in",),
    "under": ("under", "below"),
    "underneath": ("under", "below"),
    "beneath": ("under", "below"),
    "below": ("under", "below"),
    "above": ("above",),
    "over": ("above",),
    "next to": ("next_to",),
    "adjacent to": ("next_to",),
    "beside": ("next_to",),
    "alongside": ("next_to",),
    "close to": ("next_to", "near"),
    "near to": ("next_to", "near"),
    "near": ("next_to", "near"),
    "nearby": ("next_to", "near"),
    "by": ("next_to", "near"),
    "supporting": ("supports",),
    "supports": ("supports",),
    "contains": ("contains",),
    "carrying": ("supports",),
    "containing": ("contains",),
    "with": ("supports", "contains"),
    "to the left of": ("left_of",),
    "left of": ("left_of",),
    "to the right of": ("right_of",),
    "right of": ("right_of",),
    "in front of": ("in_front_of",),
    "behind": ("behind",),
    "between": ("between",),
}
"""What people say, and the predicates that it may mean."""
_PHRASES: dict[tuple[str, ...], tuple[str, ...]] = {tuple(text.split()): meant for text, meant in RELATIONS.items()}
_LONGEST = max(len(p) for p in _PHRASES)

GENERIC = frozenset("thing object item something anything everything stuff one what which".split())
"""Words that name nothing in particular."""
_FILLERS = frozenset(
    "a an the my your our this that these those some any all is are of find show me please there".split()
)
_VERBS = frozenset("standing sitting lying placed located stands sits lies".split())

SIZES = {"tiny": (0.0, 0.25), "small": (0.0, 0.5), "medium": (0.2, 0.8), "large": (0.5, 1.0), "huge": (0.75, 1.0)}
"""Words of size, and which part they are of what there is, ordered by size."""
SUPERLATIVES = {"biggest": 1, "largest": 1, "longest": 1, "smallest": -1, "tiniest": -1, "tallest": 2, "shortest": -2}
"""1 and -1 by the longest edge, 2 and -2 by height."""
_MOST_WORDS = 64


@dataclass(frozen=True)
class Phrase:
    """A thing that is spoken of."""

    text: str
    words: tuple[str, ...] = ()
    """What it must bear, singular and in the words of `words`."""
    size: str | None = None
    superlative: str | None = None
    instance_id: int | None = None
    where: tuple[Clause, ...] = ()
    """How it stands to others; all must hold."""


@dataclass(frozen=True)
class Clause:
    """A relation to something."""

    wording: str
    predicates: tuple[str, ...]
    object: Phrase
    other: Phrase | None = None
    """The second of two, for between."""


def parse(text: str) -> Phrase:
    """Parse a question. Raises `OptionError` for one that is empty, too long, or ends in a relation."""
    tokens = re.findall(r"#?[0-9]+(?![^\W_])|[^\W_]+", text.lower())  # names of predicates (next_to) come apart
    if not tokens:
        raise OptionError(f"{text!r} has no word to search for; ask for something such as: white mug on table")
    if len(tokens) > _MOST_WORDS:
        raise OptionError(f"a question of {len(tokens)} words is too long; {_MOST_WORDS} are the most")
    return _sentence(tokens, text)


def _sentence(tokens: list[str], text: str) -> Phrase:
    """Return the first phrase with its clauses; "and" before a relation comes back to it."""
    start = next((n for n in range(len(tokens)) if _relation_at(tokens, n)[0]), None)
    head = _phrase(tokens[: start if start is not None else len(tokens)])
    clauses: list[Clause] = []
    while start is not None:
        end = _next_and(tokens, start)
        clauses.append(_clause(tokens[start:end], text))
        start = None if end >= len(tokens) else end + 1
    return Phrase(head.text, head.words, head.size, head.superlative, head.instance_id, tuple(clauses))


def _clause(tokens: list[str], text: str) -> Clause:
    length, predicates = _relation_at(tokens, 0)
    words, rest = " ".join(tokens[:length]), tokens[length:]
    if predicates == ("between",):
        if "and" not in rest:
            raise OptionError(f"{text!r}: between needs two things, such as: between 4 and the sofa")
        middle = rest.index("and")
        one, two = rest[:middle], rest[middle + 1 :]
    else:
        one, two = rest, []
    for part in (one, *([two] if predicates == ("between",) else [])):
        if not [t for t in part if t not in _FILLERS]:
            raise OptionError(f"{text!r}: say what it should be {words}, such as: mug {words} table")
    other = _sentence(two, text) if two else None
    return Clause(words, predicates, _sentence(one, text), other)


def _phrase(tokens: list[str]) -> Phrase:
    words: list[str] = []
    size = superlative = number = None
    for token in tokens:
        if re.fullmatch(r"#?[0-9]+", token):
            number = int(token.removeprefix("#")[:30])
        elif token in SUPERLATIVES:
            superlative = token
        elif token not in _FILLERS and token not in _VERBS and token != "and":
            word = split_words(token)[0]
            if word in SIZES:
                size = word
            elif word not in GENERIC:
                words.append(word)
    rest = " ".join(t for t in tokens if t not in _FILLERS)
    return Phrase(rest or "anything", tuple(dict.fromkeys(words)), size, superlative, number)


def _relation_at(tokens: list[str], k: int) -> tuple[int, tuple[str, ...]]:
    """Return (how many words, predicates) of the longest relation that begins at a word; 0 words for none."""
    for length in range(min(_LONGEST, len(tokens) - k), 0, -1):
        words = tuple(tokens[k : k + length])
        if words in _PHRASES:
            return length, _PHRASES[words]
        without = tuple(t for t in words if t != "the")
        if length > 1 and without != words and without in _PHRASES and words[0] != "the" and words[-1] != "the":
            return length, _PHRASES[without]
    return 0, ()


def _next_and(tokens: list[str], start: int) -> int:
    """Return where the clause that begins at `start` ends: at an "and" that a relation follows, or at the end."""
    length, predicates = _relation_at(tokens, start)
    spared = predicates == ("between",)
    for n in range(start + length, len(tokens)):
        if tokens[n] == "and" and spared:
            spared = False
        elif tokens[n] == "and" and n + 1 < len(tokens) and _relation_at(tokens, n + 1)[0]:
            return n
    return len(tokens)

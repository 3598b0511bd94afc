"""The grammar of `find`: a question as people ask it, read into a frozen `Question`.

    white mug on table              where did I leave the remote control?     something to sit on
    how many chairs are there?      is there a lamp on the desk?              chair closest to the door
    second chair from the left      the chair that is not brown               plates and forks on the table
    lamp between 4 and the sofa     what is left of the sofa seen from the door?

First words become tokens, see `tokens`. Then `_Reader` reads: a question is phrases joined by "and" or "or", then
clauses; a phrase is attributes, a noun, an order ("largest", "second from the left"), a use, or the number of an
instance. Clauses bind to the right: in "mug on the table near the door" the table is near the door; after "and" they
bind to the first again.
"""

from __future__ import annotations

import string
from dataclasses import dataclass, replace

from list3r.memory.core.description.nouns import is_a
from list3r.memory.core.description.spelling import adjectives, split_words
from list3r.memory.core.errors import OptionError
from list3r.queries.finding.tokens import (
    ENDS,
    LONGEST,
    Token,
    opening,
    openings,
    table,
    text_words,
    tokens_of,
    use_at,
)

_BOUNDS = {"floor", "wall", "ceiling"}
"""What bounds a room: what is said after one is seldom said of it."""
_INVERSE = {
    "on": ("supports",),
    "in": ("contains",),
    "under": ("above",),
    "above": ("under", "below"),
    "next to": ("next_to", "near"),
}
"""What a thing is to which another stands so: of "what is the cat lying on?"."""
_SEVERAL = ("with", "supporting", "containing", "next to", "near")
"""Relations to all of several: "the desk with the laptop and the monitor"."""
IN_ROOM = "in room"
"""The predicate of a clause that names a room."""
_ROOMS_AFTER = ("in", "at")
_ANYWHERE = frozenset(
    "room house apartment flat scene home world memory building view picture image video area zimmer haus wohnung "
    "salle maison casa stanza habitación".split()
)
"""Places that are no room of their own."""
_MOST_WORDS = 64
_WHERE = ("where", "wo", "où", "dónde", "donde", "dove")


@dataclass(frozen=True)
class Order:
    """Which of several: "largest", "second from the left", "closest to the door"."""

    by: str
    """A key of `orders` in phrases.json."""
    rank: int = 1
    """Counted from 1; -1 for the last."""
    to: Phrase | None = None
    """What `nearest` and `farthest` are measured from."""


@dataclass(frozen=True)
class Phrase:
    """A thing that is spoken of."""

    text: str
    words: tuple[str, ...] = ()
    """What it must bear beside its name, as `split_words` has them."""
    noun: tuple[str, ...] = ()
    """The words that name it, as `split_words` has them."""
    meant: tuple[str, ...] = ()
    """The nouns of the table that those words mean; empty for a name that is not in it."""
    use: str | None = None
    """What one does with it."""
    size: str | None = None
    order: Order | None = None
    instance_id: int | None = None
    where: tuple[Clause, ...] = ()
    """How it stands to others; all must hold."""
    change: str | None = None
    """moved, removed, added or changed."""

    @property
    def all_words(self) -> tuple[str, ...]:
        """Attributes and name."""
        return tuple(dict.fromkeys((*self.words, *self.noun)))

    @property
    def ellipsis(self) -> bool:
        """Whether its noun is left out: "the red one"."""
        return not self.noun and self.text.split()[-1:] in (["one"], ["ones"])

    @property
    def generic(self) -> bool:
        """Whether it names nothing in particular."""
        return not (self.words or self.noun or self.use or self.instance_id is not None)


@dataclass(frozen=True)
class Clause:
    """A relation to something, or what something is not: then there are no predicates."""

    wording: str
    predicates: tuple[str, ...]
    object: Phrase
    other: Phrase | None = None
    """The second of two, for between."""
    negated: bool = False
    either: bool = False
    """Whether it holds or the one before it."""


@dataclass(frozen=True)
class Question:
    """What is asked."""

    text: str
    kind: str
    """which, where, count, exists, or room: in which room."""
    phrases: tuple[Phrase, ...]
    """What is asked for: what any of them means answers."""
    every: bool = False
    """Whether all of the phrases must be there for a yes."""
    all_of: bool = False
    """Whether a yes needs all that have the name: "are all chairs brown?"."""
    at_least: int = 1
    """How many must be there for a yes,"""
    at_most: int | None = None
    """and how many may be; None for any number."""
    seen_from: Phrase | None = None
    notes: tuple[str, ...] = ()


def parse(text: str) -> Question:
    """Read a question. Raises `OptionError` for a text of spaces and punctuation; anything else is a question."""
    words = text_words(text)
    if not text.strip(string.punctuation + string.whitespace):
        raise OptionError(f"{text!r} has no word to search for; ask for something such as: white mug on table")
    notes = []
    if len(words) > _MOST_WORDS:
        notes.append(f"the question has {len(words)} words; the first {_MOST_WORDS} were read")
        words = words[:_MOST_WORDS]
    words, place = _split_off(words, openings("seen_from"))
    words, of_room = _without_which_room(words)
    kind, words = _kind(_adjectives_first(_with_its_end(words)))
    kind = "room" if of_room else kind
    bounds, words = _bounds_of(words) if kind == "exists" else ((1, None), words)
    tokens = tokens_of(words) or ([Token("word", text, text)] if not text_words(text) else [])
    if kind == "exists" and len(tokens) > 1 and tokens[-1].kind == "relation":
        tokens[-1] = Token("word", tokens[-1].text, tokens[-1].text)  # is the lamp on
    reader = _Reader(tokens)
    phrases, every = reader.question()
    seen_from = _Reader(tokens_of(place)).question()[0][0] if place else None
    if reader.places:
        notes.append(f"{reader.places[0]!r} is no room of its own and was left out")
    all_of = kind == "exists" and bool({"all", "every", "each", "both"} & set(words))
    return Question(text, kind, phrases, every, all_of, *bounds, seen_from, tuple(notes))


def _without_which_room(words: list[str]) -> tuple[list[str], bool]:
    """Return what is left of "which room is the lamp in?", and whether a question asks so."""
    rest = words[1:] if words[:1] == ["in"] else words
    if rest[:1] not in (["which"], ["what"]) or rest[1:2] not in (["room"], ["rooms"]) or len(rest) < 3:
        return words, False
    return rest[2:-1] if rest[-1] == "in" else rest[2:], True


def _bounds_of(words: list[str]) -> tuple[tuple[int, int | None], list[str]]:
    """Return how many there must and may be for a yes, and the words after that: "more than two plants"."""
    said = [w for w in words[:4] if w not in ("than", "at", "exactly", "only", "just", "the")]
    compared = said[0] if said and said[0] in ("more", "fewer", "less", "least", "most") else ""
    number = table()["numbers"].get(said[bool(compared)], said[bool(compared)]) if len(said) > bool(compared) else ""
    if not str(number).isdigit() or len(words) < 2:
        return (1, None), words
    count, exact = int(number), "exactly" in words[:2]
    rest = words[words.index(said[bool(compared)]) + 1 :]
    if compared in ("fewer", "less", "most"):
        return (0, count - (compared != "most")), rest
    return (count + (compared == "more"), count if exact else None), rest


def _adjectives_first(words: list[str]) -> list[str]:
    """Return words with what is said of the first thing at the end before it: "things on the desk that are white"."""
    for k in range(len(words) - 2, 0, -1):
        if words[k - 1] in ("that", "which") and words[k] in ("is", "are"):
            last = tokens_of(words[k + 1 :])
            return [*words[k + 1 :], *words[: k - 1]] if last and all(t.kind == "word" for t in last) else words
    return words


def _with_its_end(words: list[str]) -> list[str]:
    """Return words in which "closest" and "farthest" stand before what they are measured from: "seat closest to"."""
    for k, word in enumerate(words):
        joined = {"nearest": "to", "closest": "to", "farthest": "from", "furthest": "from"}.get(word)
        following = words[k + 1 : k + 2]
        if joined is None or not following or following[0] in ("to", "from", "away"):
            continue
        if following[0] in table()["articles"].split():
            return [*words[: k + 1], joined, *words[k + 1 :]]
        end = next((n for n in range(k + 2, len(words)) if words[n] in ("to", "from")), None)
        if end is not None:
            return [*words[:k], *words[k + 1 : end], word, joined, *words[end + 1 :]]
    return words


def _split_off(words: list[str], marks: frozenset[tuple[str, ...]]) -> tuple[list[str], list[str]]:
    """Return the words before and after the first of some marks."""
    for k in range(len(words)):
        for length in range(LONGEST, 0, -1):
            if tuple(words[k : k + length]) in marks:
                return words[:k], words[k + length :]
    return words, []


def _kind(words: list[str]) -> tuple[str, list[str]]:
    """Return what kind of question begins so, and the words after its opening."""
    kind, asked, asks = "which", False, {"counts": "count", "yes_no": "exists", "openers": ""}
    while words:
        length, name = max((opening(words, openings(n)), n) for n in asks)
        if not length or (asks[name] and asked):
            break
        if asks[name]:
            return asks[name], words[length:]
        asked = asked or words[0] in (*_WHERE, "what", "which")
        kind = "where" if words[0] in _WHERE else kind
        if asked and use_at(words, length)[0]:
            return "which", words[length:]
        words = words[length:]
        words = words[1:] if words and words[0] in ("me", "the", "is", "are") and len(words) > 1 else words
    return kind, words


class _Reader:
    """Reads tokens into phrases and clauses, left to right."""

    def __init__(self, tokens: list[Token]) -> None:
        self._tokens = tokens
        self._at = 0
        self.places: list[str] = []
        """Rooms that were named."""

    def question(self) -> tuple[tuple[Phrase, ...], bool]:
        """Return the phrases that answer, and whether all of them are asked for."""
        if len(self._tokens) > 1 and self._tokens[-1].kind == "relation":
            others = [t.kind for t in self._tokens[:-1]]
            if "noun" in others and "relation" not in others and self._tokens[-1].value in _INVERSE:
                return (self._inverted(),), False
            self._tokens.pop()
        heads, every = [self._phrase()], True
        while self._next() in ("and", "or") and self._next(1) not in ("relation", "not", ""):
            every &= self._take().kind == "and"
            heads.append(self._phrase())
        heads = _completed(heads, every=every)
        clauses = self._clauses(heads[0])
        if heads[0].text == "anything" and len(clauses) == 1 and not clauses[0].predicates and clauses[0].object.noun:
            unlike = clauses[0].object  # non-red cushion
            heads = [replace(unlike, words=())]
            clauses = (replace(clauses[0], object=Phrase(" ".join(unlike.words), unlike.words)),)
        while self._next() in ("and", "or") and self._next(1) not in ("relation", "not", ""):
            self._take()  # mug on the table or bowl on the desk
            heads[-1] = replace(heads[-1], where=(*heads[-1].where, *clauses))
            heads.append(self._phrase())
            clauses = self._clauses(heads[-1])
            heads[-1], clauses = replace(heads[-1], where=clauses), ()
        if clauses:
            heads = [replace(h, where=(*h.where, *clauses)) for h in heads]
        return tuple(p for h in heads for p in _alternatives(h)), every and len(heads) > 1

    def _inverted(self) -> Phrase:
        """Return what something else stands to as is said last: "what is the cat lying on"."""
        relation = self._tokens.pop()
        things = [t for t in self._tokens if t.kind != "thing"]
        subject = _Reader(things or self._tokens).question()[0][0]
        predicates = _INVERSE[relation.value]
        return Phrase("anything", where=(Clause(f"with something {relation.text}", predicates, subject),))

    def _next(self, ahead: int = 0) -> str:
        at = self._at + ahead
        return self._tokens[at].kind if at < len(self._tokens) else ""

    def _take(self) -> Token:
        self._at += 1
        return self._tokens[self._at - 1]

    def _clauses(self, head: Phrase) -> tuple[Clause, ...]:
        """Return clauses as long as there are any; "and" and "or" before a relation come back to the first phrase."""
        out: list[Clause] = []
        while self._next() and not (self._next() in ("and", "or") and self._next(1) not in ("relation", "not", "")):
            token = self._take()
            if token.kind in ("and", "or"):
                continue
            if token.kind == "not":
                out += self._negation(head)
            elif token.kind == "relation":
                either = self._at > 1 and self._tokens[self._at - 2].kind == "or" and bool(out)
                out += [replace(c, either=either) for c in self._relation(token, head)]
                out += self._more_of(token, head)
            else:
                self._at -= 1
                more = self._phrase()  # a word that stands after a clause: the lamp on the desk there
                self._at += self._at < len(self._tokens) and more.generic and more.order is None
        return tuple(out)

    def _more_of(self, token: Token, head: Phrase) -> list[Clause]:
        """Return clauses of further things that "and" gives to the same relation."""
        out: list[Clause] = []
        while token.value in _SEVERAL and self._next() == "and" and not self._joins():
            self._take()
            out += self._relation(token, head)
        return out

    def _joins(self) -> bool:
        """Whether what follows an "and" stands for itself: it has a relation of its own."""
        following = (t.kind for t in self._tokens[self._at + 1 :])
        return next((k == "relation" for k in following if k in ENDS), False)

    def _relation(self, token: Token, head: Phrase, *, negated: bool = False) -> list[Clause]:
        predicates = tuple(table()["predicates"][token.value])
        first = self._phrase()
        other = None
        if token.value == "between":
            if self._next() == "and":
                self._take()
                other = self._phrase()
            elif first.generic:
                return []
        room = _room_name(first) if token.value in _ROOMS_AFTER else None
        if room is not None:
            return [Clause(token.text, (IN_ROOM,), Phrase(room), negated=negated)]
        if first.generic and first.order is None and first.text in (*table()["places"].split(), "anything"):
            if first.text != "anything":
                self.places.append(first.text)
            return []
        if first.ellipsis:
            first = replace(first, noun=head.noun, meant=head.meant)
        if not negated and self._next() == "relation" and not set(first.meant) & _BOUNDS:
            first = replace(first, where=self._clauses(first))
        for said, kind, further in (("on", "shelf", "in"), ("in", "container", "on")):
            if token.value == said and any(is_a(m, kind) for m in first.meant):
                predicates = (*predicates, further)  # what stands on a board of a shelf is in it
        return [Clause(token.text, predicates, first, other, negated)]

    def _negation(self, head: Phrase) -> list[Clause]:
        """Return what must not hold: a relation, or to be what a phrase says, whose noun may be left out."""
        out: list[Clause] = []
        if self._next() == "relation":
            token = self._take()
            out = self._relation(token, head, negated=True)
            while self._next() in ("and", "or") and not self._joins():
                self._take()  # not on the desk or the table
                out += self._relation(token, head, negated=True)
            return out
        while True:
            phrase = self._phrase()
            if self._next() == "relation":
                phrase = replace(phrase, where=tuple(self._relation(self._take(), phrase)))
            if not phrase.generic or phrase.where or phrase.order:
                out.append(Clause("not", (), phrase, negated=True))
            if self._next() not in ("and", "or", "not"):
                return out
            self._take()

    def _phrase(self) -> Phrase:
        """Return what stands up to a clause or a join."""
        tokens: list[Token] = []
        while self._next() not in ("", "and", "or", "not", "relation"):
            token = self._take()
            if token.value in ("nearest", "farthest"):
                to = self._measured_from() if token.text.endswith((" to", " from")) else None
                token = Token("order", token.text, Order(token.value, to=to))
            elif token.kind == "order":
                token = Token("order", token.text, Order(token.value))
            tokens.append(token)
        return _phrase_of(tokens)

    def _measured_from(self) -> Phrase | None:
        """Return what "closest to" or "farthest from" is measured from; None where that is not said."""
        return self._phrase() if self._next() in ("noun", "word", "number", "size", "order", "rank") else None


def _alternatives(phrase: Phrase) -> list[Phrase]:
    """Return a phrase for each of the clauses that "or" joins: "on the desk or on the table"."""
    groups: list[list[Clause]] = [[]]
    for clause in phrase.where:
        groups = [*groups, [*groups[-1][:-1], clause]] if clause.either else [*groups[:-1], [*groups[-1], clause]]
    return [replace(phrase, where=tuple(g)) for g in groups]


def _completed(heads: list[Phrase], *, every: bool) -> list[Phrase]:
    """Return phrases with the noun that the last has: "blue or red cushions" are two, "a red and white cup" is one."""
    last = heads[-1]
    bare = [h for h in heads[:-1] if h.words and not (h.noun or h.use or h.order)]
    if not bare or len(bare) < len(heads) - 1 or not last.noun:
        return heads
    if every:
        return [replace(last, words=(*(w for h in bare for w in h.words), *last.words))]
    return [*(replace(last, text=f"{h.text} {' '.join(last.noun)}", words=h.words) for h in bare), last]


def _phrase_of(tokens: list[Token]) -> Phrase:
    """Return the phrase of attributes, nouns of which the last names it, and what else was said of it."""
    last = {t.kind: t for t in tokens}
    noun = None if "use" in last else last.get("noun")
    if noun is not None and "thing" in last and noun.text in adjectives():
        noun = None  # the orange one
    words = [
        w
        for t in tokens
        if t is not noun
        for w in (_name(t) if t.kind == "noun" else [t.value])
        if t.kind in ("noun", "word")
    ]
    order = last["order"].value if "order" in last else None
    if order is not None and "rank" in last:
        order = replace(order, rank=last["rank"].value)
    named = last.get("use", noun)
    text = " ".join(t.text for t in tokens)
    places = table()["places"].split()
    if words and set(words) <= set(places) and {t.kind for t in tokens} == {"word"}:
        return Phrase(" ".join(words))
    return Phrase(
        text or "anything",
        tuple(w for w in dict.fromkeys(words) if w not in places),
        () if noun is None else _name(noun),
        () if named is None else named.value,
        last["use"].text if "use" in last else None,
        last["size"].value if "size" in last else None,
        order,
        last["number"].value if "number" in last else None,
        (),
        last["change"].value if "change" in last else None,
    )


def _room_name(phrase: Phrase) -> str | None:
    """Return the name or the number of a room that a phrase means: "living room", "room 3"; None for anything else."""
    words = phrase.text.split()
    if words[0] == "room" and phrase.instance_id is not None:
        return str(phrase.instance_id)
    named = words[-1] in table()["places"].split() and not (phrase.noun or phrase.use or phrase.order)
    return phrase.text if named and not set(words) <= _ANYWHERE else None


def _name(token: Token) -> tuple[str, ...]:
    return tuple(split_words(token.text))

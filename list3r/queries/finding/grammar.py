"""The grammar of `find`: a question as people ask it, read into a frozen `Question`.

    white mug on table              where did I leave the remote control?     something to sit on
    how many chairs are there?      is there a lamp on the desk?              chair closest to the door
    second chair from the left      the chair that is not brown               plates and forks on the table
    lamp between 4 and the sofa     what is left of the sofa seen from the door?

First words become tokens: fillers go, and the longest phrase of the table `phrases.json`, or of the names of nouns in
any language, is one token. Then `_Reader` reads: a question is phrases joined by "and" or "or", then clauses; a phrase
is attributes, a noun, an order ("largest", "second from the left"), a use, or the number of an instance. Clauses bind
to the right: in "mug on the table near the door" the table is near the door; after "and" they bind to the first again.
"""

from __future__ import annotations

import json
import re
import string
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from list3r.memory.description.nouns import all_nouns, is_a, names, unaccented
from list3r.memory.description.words import split_words
from list3r.memory.errors import OptionError

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
_MOST_WORDS = 64
_LONGEST = 7
"""Words of the longest phrase."""
SIZES = {"tiny": (0.0, 0.25), "small": (0.0, 0.5), "medium": (0.2, 0.8), "large": (0.5, 1.0), "huge": (0.75, 1.0)}
"""Words of size, and which part they are of what there is, ordered by size."""
_WHERE = ("where", "wo", "où", "dónde", "donde", "dove")
_ASIAN = r"\u3040-\u30ff\u3400-\u9fff"


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
    """which, where, count or exists."""
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


@dataclass(frozen=True)
class _Token:
    kind: str
    """word, noun, thing, relation, order, rank, size, number, use, change, and, or, not."""
    text: str
    value: Any = None


@cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = json.loads(Path(__file__).with_name("phrases.json").read_text(encoding="utf-8"))
    return table


@cache
def _phrases() -> dict[tuple[str, ...], _Token]:
    """Return the tokens of all words and phrases of the table that are more than names."""
    table = _table()
    out: dict[tuple[str, ...], _Token] = {}
    out |= {tuple(_words(p)): _Token("filler", p) for p in (*table["fillers"].split(), *table["phrases"].split("|"))}
    out |= {(w,): _Token("thing", w) for w in table["generic"].split()}
    for kind in ("and", "or", "not"):
        out |= {(w,): _Token(kind, w) for w in table[kind].split()}
    for kind, group in (("order", "orders"), ("relation", "relations"), ("change", "changes")):
        out |= {tuple(_words(p)): _Token(kind, p, key) for key, many in table[group].items() for p in many.split("|")}
    out |= {(w,): _Token("rank", w, n) for w, n in table["ranks"].items()}
    return out


@cache
def relation_words() -> dict[str, tuple[str, ...]]:
    """Return what people say of how things stand to each other, and the predicates that it may mean."""
    said = _table()["relations"].items()
    return {phrase: tuple(_table()["predicates"][key]) for key, many in said for phrase in many.split("|")}


@cache
def _openings(name: str) -> frozenset[tuple[str, ...]]:
    said: Iterable[str] = _table()[name].split("|") if isinstance(_table()[name], str) else _table()[name]
    return frozenset(tuple(_words(p)) for p in said)


def _words(text: str) -> list[str]:
    """Return words as they stand, short forms in full; what is written without spaces comes apart at known nouns."""
    text = re.sub(r"[’`]", "'", text.lower())
    text = re.sub(r"n't\b", " not", text.replace("can't", "can not").replace("cannot", "can not"))
    text = re.sub(r"\b(what|where|who|which|that|there|it|how|here)'s\b", r"\1 is", text).replace("i'm ", "i am ")
    text = re.sub(r"'s\b", "", text)
    text = re.sub(f"[{_ASIAN}]+", lambda found: f" {' '.join(_apart(found[0]))} ", text)
    return re.findall(r"#?[0-9]+(?![^\W_])|[^\W_]+", text)


def _apart(run: str) -> list[str]:
    """Return the words of Japanese or Chinese that the tables know, the one spoken of before what it is next to."""
    for particle, relation in _table()["asian"].items():
        before, found, after = run.partition(particle)
        if found and before and after:
            return [*_apart(after), *relation.split(), *_apart(before)]
    out, k = [], 0
    while k < len(run):
        known = (run[k:end] for end in range(len(run), k, -1))
        word = next((w for w in known if (w,) in names() or split_words(w) != [w]), None)
        out += [] if word is None else [word]
        k += 1 if word is None else len(word)
    return out


def parse(text: str) -> Question:
    """Read a question. Raises `OptionError` for a text of spaces and punctuation; anything else is a question."""
    words = _words(text)
    if not text.strip(string.punctuation + string.whitespace):
        raise OptionError(f"{text!r} has no word to search for; ask for something such as: white mug on table")
    notes = []
    if len(words) > _MOST_WORDS:
        notes.append(f"the question has {len(words)} words; the first {_MOST_WORDS} were read")
        words = words[:_MOST_WORDS]
    words, place = _split_off(words, _openings("seen_from"))
    kind, words = _kind(_adjectives_first(_with_its_end(words)))
    bounds, words = _bounds_of(words) if kind == "exists" else ((1, None), words)
    tokens = _tokens(words) or ([_Token("word", text, text)] if not _words(text) else [])
    if kind == "exists" and len(tokens) > 1 and tokens[-1].kind == "relation":
        tokens[-1] = _Token("word", tokens[-1].text, tokens[-1].text)  # is the lamp on
    reader = _Reader(tokens)
    phrases, every = reader.question()
    seen_from = _Reader(_tokens(place)).question()[0][0] if place else None
    if reader.places:
        notes.append(f"rooms are not told apart: {reader.places[0]!r} was left out")
    all_of = kind == "exists" and bool({"all", "every", "each", "both"} & set(words))
    return Question(text, kind, phrases, every, all_of, *bounds, seen_from, tuple(notes))


def _bounds_of(words: list[str]) -> tuple[tuple[int, int | None], list[str]]:
    """Return how many there must and may be for a yes, and the words after that: "more than two plants"."""
    said = [w for w in words[:4] if w not in ("than", "at", "exactly", "only", "just", "the")]
    compared = said[0] if said and said[0] in ("more", "fewer", "less", "least", "most") else ""
    number = _table()["numbers"].get(said[bool(compared)], said[bool(compared)]) if len(said) > bool(compared) else ""
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
            last = _tokens(words[k + 1 :])
            return [*words[k + 1 :], *words[: k - 1]] if last and all(t.kind == "word" for t in last) else words
    return words


def _with_its_end(words: list[str]) -> list[str]:
    """Return words in which "closest" and "farthest" stand before what they are measured from: "seat closest to"."""
    for k, word in enumerate(words):
        joined = {"nearest": "to", "closest": "to", "farthest": "from", "furthest": "from"}.get(word)
        following = words[k + 1 : k + 2]
        if joined is None or not following or following[0] in ("to", "from", "away"):
            continue
        if following[0] in _table()["articles"].split():
            return [*words[: k + 1], joined, *words[k + 1 :]]
        end = next((n for n in range(k + 2, len(words)) if words[n] in ("to", "from")), None)
        if end is not None:
            return [*words[:k], *words[k + 1 : end], word, joined, *words[end + 1 :]]
    return words


def _split_off(words: list[str], marks: frozenset[tuple[str, ...]]) -> tuple[list[str], list[str]]:
    """Return the words before and after the first of some marks."""
    for k in range(len(words)):
        for length in range(_LONGEST, 0, -1):
            if tuple(words[k : k + length]) in marks:
                return words[:k], words[k + length :]
    return words, []


def _kind(words: list[str]) -> tuple[str, list[str]]:
    """Return what kind of question begins so, and the words after its opening."""
    kind, asked, asks = "which", False, {"counts": "count", "yes_no": "exists", "openers": ""}
    while words:
        length, name = max((_opening(words, _openings(n)), n) for n in asks)
        if not length or (asks[name] and asked):
            break
        if asks[name]:
            return asks[name], words[length:]
        asked = asked or words[0] in (*_WHERE, "what", "which")
        kind = "where" if words[0] in _WHERE else kind
        if asked and _use_at(words, length)[0]:
            return "which", words[length:]
        words = words[length:]
        words = words[1:] if words and words[0] in ("me", "the", "is", "are") and len(words) > 1 else words
    return kind, words


def _opening(words: list[str], openings: frozenset[tuple[str, ...]]) -> int:
    return next((n for n in range(min(_LONGEST, len(words)), 0, -1) if tuple(words[:n]) in openings), 0)


# ---------------------------------------------------------------------------------------------- tokens


def _tokens(words: list[str]) -> list[_Token]:
    out: list[_Token] = []
    articles = _table()["articles"].split()
    k = 0
    while k < len(words):
        length, token = _token_at(words, k)
        if token.kind != "filler":
            out.append(token)
        elif words[k] in ("have", "has") and k + 1 < len(words) and any(t.kind == "noun" for t in out):
            out.append(_Token("relation", words[k], "with"))
        elif words[k] in articles and out and out[-1].kind in ("noun", "word"):
            last_words = k + 1 < len(words) and _token_at(words, k + 1)[1].kind in ("order", "rank")
            since = 0 if last_words else next((n for n in range(len(out), 0, -1) if out[n - 1].kind == "noun"), 0)
            if since and all(t.kind == "word" for t in out[since:]):
                # Another thing begins, and how it stands to the first was not understood: the chair facing the desk.
                out[since:] = [_Token("relation", " ".join(t.text for t in out[since:]) or "near", "near")]
        k += length
    return out


def _token_at(words: list[str], k: int) -> tuple[int, _Token]:
    """Return the longest token that begins at a word: a use, a phrase of the table, a noun, or the word alone."""
    length, use = _use_at(words, k)
    if use:
        return length, _Token("use", " ".join(words[k : k + length]), use)
    if re.fullmatch(r"#?[0-9]+", words[k]):
        return 1, _Token("number", words[k], int(words[k].removeprefix("#")[:30]))
    phrases = _phrases()
    for n in range(min(_LONGEST, len(words) - k), 0, -1):
        part = tuple(words[k : k + n])
        without = tuple(w for w in part if w not in ("the", "a"))
        shaded = n == 1 and part[0] in ("light", "dark") and split_words(" ".join(words[k + 1 : k + 2]))
        if shaded and shaded[0] in ("blue", "red", "green", "grey", "brown", "yellow"):
            return 1, _Token("word", part[0], part[0])
        if part in phrases or (n > 2 and part[0] != "the" and part[-1] != "the" and without in phrases):
            return n, phrases.get(part) or phrases[without]
        meant = _meant(part)
        if meant:
            return n, _Token("noun", " ".join(part), meant)
    word = split_words(words[k])[0]
    if word in _table()["generic"].split():
        return 1, _Token("thing", word)
    return 1, _Token("size" if word in SIZES else "word", words[k], word)


def _meant(part: tuple[str, ...]) -> tuple[str, ...]:
    """Return the nouns that words mean: as they stand, singular, without accents, or without a German plural's end."""
    table = names()
    found = (*table.get(part, ()), *table.get(tuple(split_words(" ".join(part))), ()))
    if not found and len(part) == 1 and len(part[0]) > 4 and split_words(part[0]) == [part[0]]:
        plain = unaccented(part[0])
        ends = (plain, *(plain.removesuffix(e) for e in ("e", "er", "en", "n")), *(plain[:-1] + e for e in "aoe"))
        found = next((table[(w,)] for w in ends if (w,) in table), ())
    return tuple(dict.fromkeys(found))


@cache
def _uses() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Return the nouns by the words of a use."""
    out: dict[tuple[str, ...], list[str]] = {}
    for n in all_nouns().values():
        for use in n.uses:
            out.setdefault(_content(use.split()), []).append(n.name)
    return {words: tuple(found) for words, found in out.items()}


def _content(words: Iterable[str]) -> tuple[str, ...]:
    idle = ("the", "a", "an", "my", "one's", "some", "one", "s", "our", "your", "down", "up", "any", "oneself")
    return tuple(split_words(" ".join(w for w in words if w not in idle)))


def _use_at(words: list[str], k: int) -> tuple[int, tuple[str, ...]]:
    """Return (how many words, the nouns) of a use that begins at a word: "to sit on", "I can write at"."""
    start = _opening(words[k:], _openings("can"))
    rest = words[k + start :]
    if not start or not rest:
        return 0, ()
    uses = _uses()
    ends = [n for n in range(1, len(rest) + 1) if n == len(rest) or _kind_of(rest[n]) in _ENDS]
    for n in (n for n in reversed(ends) if n <= _LONGEST):
        if found := uses.get(_content(rest[:n])):
            return start + n, found
    end = ends[0]
    said = _content(rest[:end])
    verb = said[0] if said else ""
    if words[k] == "for":
        verb = verb.removesuffix("ing")
    alike = {use: len(set(said) & set(use)) for use in uses if use[0] == verb and verb not in ("have", "be")}
    most = max(alike.values(), default=0)
    best = [n for use, shared in alike.items() if shared == most for n in uses[use]]
    return (start + end, tuple(dict.fromkeys(best))) if best else (0, ())


def _kind_of(word: str) -> str:
    return _phrases()[(word,)].kind if (word,) in _phrases() else ""


_ENDS = ("relation", "and", "or", "not", "order")


# ---------------------------------------------------------------------------------------------- phrases


class _Reader:
    """Reads tokens into phrases and clauses, left to right."""

    def __init__(self, tokens: list[_Token]) -> None:
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

    def _take(self) -> _Token:
        self._at += 1
        return self._tokens[self._at - 1]

    def _clauses(self, head: Phrase) -> tuple[Clause, ...]:
        """Return clauses as long as there are any; "and" and "or" before a relation come back to the first phrase."""
        out: list[Clause] = []
        while self._next() and not (self._next() in ("and", "or") and self._next(1) not in ("relation", "not", "")):
            token = self._take()
            if token.kind == "not":
                out += self._negation(head)
            elif token.kind == "relation":
                either = self._at > 1 and self._tokens[self._at - 2].kind == "or" and bool(out)
                out += [replace(c, either=either) for c in self._relation(token, head)]
                while token.value in _SEVERAL and self._next() == "and" and not self._joins():
                    self._take()
                    out += self._relation(token, head)
            elif token.kind not in ("and", "or"):
                self._at -= 1
                more = self._phrase()  # a word that stands after a clause: the lamp on the desk there
                if self._at < len(self._tokens) and more.generic and more.order is None:
                    self._at += 1
        return tuple(out)

    def _joins(self) -> bool:
        """Whether what follows an "and" stands for itself: it has a relation of its own."""
        following = (t.kind for t in self._tokens[self._at + 1 :])
        return next((k == "relation" for k in following if k in _ENDS), False)

    def _relation(self, token: _Token, head: Phrase, *, negated: bool = False) -> list[Clause]:
        predicates = tuple(_table()["predicates"][token.value])
        first = self._phrase()
        other = None
        if token.value == "between":
            if self._next() == "and":
                self._take()
                other = self._phrase()
            elif first.generic:
                return []
        if first.generic and first.order is None and first.text in (*_table()["places"].split(), "anything"):
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
        if self._next() == "relation":
            return self._relation(self._take(), head, negated=True)
        out = []
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
        tokens: list[_Token] = []
        while self._next() not in ("", "and", "or", "not", "relation"):
            token = self._take()
            if token.value in ("nearest", "farthest"):
                to = self._measured_from() if token.text.endswith((" to", " from")) else None
                token = _Token("order", token.text, Order(token.value, to=to))
            elif token.kind == "order":
                token = _Token("order", token.text, Order(token.value))
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


def _phrase_of(tokens: list[_Token]) -> Phrase:
    """Return the phrase of attributes, nouns of which the last names it, and what else was said of it."""
    last = {t.kind: t for t in tokens}
    noun = None if "use" in last else last.get("noun")
    if noun is not None and "thing" in last and last["thing"].text in ("thing", "one", "object", "item"):
        noun = noun if "word" in last else None  # the orange one
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
    places = _table()["places"].split()
    if words and set(words) <= set(places) and {t.kind for t in tokens} == {"word"}:
        return Phrase(words[0])
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


def _name(token: _Token) -> tuple[str, ...]:
    return tuple(split_words(token.text))

"""The words of a question as tokens: the longest phrase of `phrases.json`, or name of a noun, is one; fillers go."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from list3r.memory.core.description.nouns import all_nouns, names, unaccented
from list3r.memory.core.description.spelling import split_words

LONGEST = 7
"""Words of the longest phrase."""
SIZES = {"tiny": (0.0, 0.25), "small": (0.0, 0.5), "medium": (0.2, 0.8), "large": (0.5, 1.0), "huge": (0.75, 1.0)}
"""Words of size, and which part they are of what there is, ordered by size."""
ENDS = ("relation", "and", "or", "not", "order")
"""Kinds of tokens at which a phrase ends."""
_ASIAN = r"\u3040-\u30ff\u3400-\u9fff"


@dataclass(frozen=True)
class Token:
    """A word or phrase that has one meaning."""

    kind: str
    """word, noun, thing, relation, order, rank, size, number, use, change, and, or, not."""
    text: str
    value: Any = None


@cache
def table() -> dict[str, Any]:
    """Return the words of questions by their part."""
    out: dict[str, Any] = json.loads(Path(__file__).with_name("phrases.json").read_text(encoding="utf-8"))
    return out


@cache
def phrases() -> dict[tuple[str, ...], Token]:
    """Return the tokens of all words and phrases of the table that are more than names."""
    said = table()
    out: dict[tuple[str, ...], Token] = {}
    out |= {tuple(text_words(p)): Token("filler", p) for p in (*said["fillers"].split(), *said["phrases"].split("|"))}
    out |= {(w,): Token("thing", w) for w in said["generic"].split()}
    for kind in ("and", "or", "not"):
        out |= {(w,): Token(kind, w) for w in said[kind].split()}
    for kind, group in (("order", "orders"), ("relation", "relations"), ("change", "changes")):
        out |= {tuple(text_words(p)): Token(kind, p, key) for key, many in said[group].items() for p in many.split("|")}
    out |= {(w,): Token("rank", w, n) for w, n in said["ranks"].items()}
    return out


@cache
def openings(name: str) -> frozenset[tuple[str, ...]]:
    """Return phrases of the table as words."""
    said: Iterable[str] = table()[name].split("|") if isinstance(table()[name], str) else table()[name]
    return frozenset(tuple(text_words(p)) for p in said)


def text_words(text: str) -> list[str]:
    """Return the words of a text, short forms in full; what is written without spaces comes apart at known nouns."""
    text = re.sub(r"[’`]", "'", text.lower())
    text = re.sub(r"n't\b", " not", text.replace("can't", "can not").replace("cannot", "can not"))
    text = re.sub(r"\b(what|where|who|which|that|there|it|how|here)'s\b", r"\1 is", text).replace("i'm ", "i am ")
    text = re.sub(r"'s\b", "", text)
    text = re.sub(f"[{_ASIAN}]+", lambda found: f" {' '.join(_apart(found[0]))} ", text)
    return re.findall(r"#?[0-9]+(?![^\W_])|[^\W_]+", text)


def _apart(run: str) -> list[str]:
    """Return the words of Japanese or Chinese that the tables know, the one spoken of before what it is next to."""
    for particle, relation in table()["asian"].items():
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


def opening(words: list[str], openings: frozenset[tuple[str, ...]]) -> int:
    """Return how many words the longest of some phrases has that the words begin with, 0 for none."""
    return next((n for n in range(min(LONGEST, len(words)), 0, -1) if tuple(words[:n]) in openings), 0)


def tokens_of(words: list[str]) -> list[Token]:
    """Return the tokens of words."""
    out: list[Token] = []
    articles = table()["articles"].split()
    k = 0
    while k < len(words):
        length, token = _token_at(words, k)
        has = words[k] in ("have", "has") and token.kind == "filler" and k + 1 < len(words)
        if has and any(t.kind == "noun" for t in out):
            token = Token("relation", words[k], "with")
        if token.kind != "filler":
            out.append(token)
        elif words[k] in articles and not (k + 1 < len(words) and _token_at(words, k + 1)[1].kind in ("order", "rank")):
            _begin_another(out)
        k += length
    return out


def _begin_another(out: list[Token]) -> None:
    """Words after a noun, before an article, are a relation that was not understood: the chair facing the desk."""
    since = next((n for n in range(len(out), 0, -1) if out[n - 1].kind == "noun"), 0)
    if since and all(t.kind == "word" for t in out[since:]):
        out[since:] = [Token("relation", " ".join(t.text for t in out[since:]) or "near", "near")]


def _token_at(words: list[str], k: int) -> tuple[int, Token]:
    """Return the longest token that begins at a word: a use, a phrase of the table, a noun, or the word alone."""
    length, use = use_at(words, k)
    if use:
        return length, Token("use", " ".join(words[k : k + length]), use)
    if re.fullmatch(r"#?[0-9]+", words[k]):
        return 1, Token("number", words[k], int(words[k].removeprefix("#")[:30]))
    said = phrases()
    for n in range(min(LONGEST, len(words) - k), 0, -1):
        part = tuple(words[k : k + n])
        without = tuple(w for w in part if w not in ("the", "a"))
        shaded = n == 1 and part[0] in ("light", "dark") and split_words(" ".join(words[k + 1 : k + 2]))
        if shaded and shaded[0] in ("blue", "red", "green", "grey", "brown", "yellow"):
            return 1, Token("word", part[0], part[0])
        if part in said or (n > 2 and part[0] != "the" and part[-1] != "the" and without in said):
            return n, said.get(part) or said[without]
        meant = _meant(part)
        if meant:
            return n, Token("noun", " ".join(part), meant)
    word = split_words(words[k])[0]
    if word in table()["generic"].split():
        return 1, Token("thing", word)
    return 1, Token("size" if word in SIZES else "word", words[k], word)


def _meant(part: tuple[str, ...]) -> tuple[str, ...]:
    """Return the nouns that words mean: unchanged, singular, without accents, or without a German plural's end."""
    known = names()
    found = (*known.get(part, ()), *known.get(tuple(split_words(" ".join(part))), ()))
    if not found and len(part) == 1 and len(part[0]) > 4 and split_words(part[0]) == [part[0]]:
        plain = unaccented(part[0])
        ends = (plain, *(plain.removesuffix(e) for e in ("e", "er", "en", "n")), *(plain[:-1] + e for e in "aoe"))
        found = next((known[(w,)] for w in ends if (w,) in known), ())
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


def use_at(words: list[str], k: int) -> tuple[int, tuple[str, ...]]:
    """Return (how many words, the nouns) of a use that begins at a word: "to sit on", "I can write at"."""
    start = opening(words[k:], openings("can"))
    rest = words[k + start :]
    if not start or not rest:
        return 0, ()
    uses = _uses()
    ends = [n for n in range(1, len(rest) + 1) if n == len(rest) or _kind_of(rest[n]) in ENDS]
    for n in (n for n in reversed(ends) if n <= LONGEST):
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
    return phrases()[(word,)].kind if (word,) in phrases() else ""

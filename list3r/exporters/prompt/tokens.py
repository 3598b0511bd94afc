"""How many tokens a text takes: a count that needs no tokenizer and leans to the high side."""

from __future__ import annotations

import re

_PIECE = re.compile(r" ?[A-Za-z]+| ?[0-9]+|\n+| ?[^\sA-Za-z0-9]|\s+")
_LETTERS = 5
"""Letters to a token of a word: byte pair encodings of 100,000 entries and more have most English words whole."""


def count_tokens(text: str) -> int:
    """Return a count of tokens that the byte pair encodings in use rarely exceed.

    A word is a token for each five letters begun, a number one for each digit and one for the space before it, any
    other sign one for each byte, a line break and a stretch of other white space one. `docs/prompt.md` has the counts
    of real tokenizers next to it.
    """
    return sum(_tokens_of(piece) for piece in _PIECE.findall(text))


def _tokens_of(piece: str) -> int:
    word = piece.strip()
    if not word:
        return 1
    if not word.isascii():
        return len(word.encode())
    if word[0].isdigit():
        return len(piece)
    return -(-len(word) // _LETTERS)

"""How many tokens a text takes: counted by tiktoken where that and its data are there, else estimated."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

ENCODING = "o200k_base"
_CACHED = "fb374d419588a4632f3f557e76b4b70aebbca790"
"""Name under which tiktoken keeps that encoding: it is never downloaded for a count."""
_PIECE = re.compile(r"[^\w\n]?[^\W\d_]+|\d{1,3}| ?[^\s\w]+\n*|\s*\n+|\s+(?!\S)|\s|_")
"""As the byte pair encodings in use cut a text before they join bytes."""
_LETTERS = 8
"""Letters to a token of an English word: most are whole."""


def count_tokens(text: str) -> int:
    """Return the tokens of a text in `ENCODING`, or `estimate_tokens` where tiktoken or its data is missing."""
    encode = _encoder()
    return estimate_tokens(text) if encode is None else len(encode(text))


def counted_by() -> str:
    """Return the encoding by which tokens are counted here, or `estimate`."""
    return "estimate" if _encoder() is None else ENCODING


def estimate_tokens(text: str) -> int:
    """Return about as many tokens as encodings of 100,000 entries and more take for a text of a pack.

    A word is a token for each eight letters begun, a number one for each three digits and one for the space before it,
    a run of other signs one for each two, other alphabets one for each two bytes. `docs/prompt.md` has real counts
    next to it.
    """
    return sum(_tokens_of(piece) for piece in _PIECE.findall(text))


def _tokens_of(piece: str) -> int:
    word = piece.strip()
    if not word:
        return 1
    if not word.isascii():
        return -(-len(word.encode()) // 2)
    return -(-len(word) // (_LETTERS if word[-1].isalpha() else 3 if word[0].isdigit() else 2))


@cache
def _encoder() -> Callable[[str], list[int]] | None:
    default = Path(tempfile.gettempdir()) / "data-gym-cache"
    folder = os.environ.get("TIKTOKEN_CACHE_DIR", os.environ.get("DATA_GYM_CACHE_DIR", str(default)))
    if not folder or not (Path(folder) / _CACHED).is_file():
        return None
    try:
        import tiktoken

        encode: Callable[[str], list[int]] = tiktoken.get_encoding(ENCODING).encode_ordinary
    except (ImportError, OSError, ValueError):
        return None
    return encode

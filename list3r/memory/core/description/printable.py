"""Text of unknown origin on one line that can be printed."""

from __future__ import annotations

import re


def shown(text: object) -> str:
    """Return a text as one line of printable characters; all others are escaped as in `\\x1b`.

    Control characters, line ends and marks that turn the direction of text forge rows, move cursors and hide words.
    """
    line = str(text)
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in line)


def shown_between(text: object, separators: str) -> str:
    """Return a text as `shown` does, with a backslash before every separator of the entries it stands between.

    What somebody named a thing then cannot begin an entry or a column. Backslashes of its own are doubled.
    """
    return shown(re.sub(f"([\\\\{re.escape(separators)}])", r"\\\1", str(text)))

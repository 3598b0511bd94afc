"""Text of unknown origin on one line that can be printed."""

from __future__ import annotations


def shown(text: object) -> str:
    """Return a text as one line of printable characters; all others are escaped as in `\\x1b`.

    Control characters, line ends and marks that turn the direction of text forge rows, move cursors and hide words.
    """
    line = str(text)
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in line)

"""A text of lines that never takes more tokens than it may."""

from __future__ import annotations

from collections.abc import Iterable

from list3r.exporters.prompt.tokens import count_tokens


class Budget:
    """Lines that are added as long as there is room."""

    def __init__(self, tokens: int) -> None:
        self.tokens = tokens
        self.used = 0
        self.lines: list[str] = []

    @property
    def left(self) -> int:
        """Tokens that are left."""
        return self.tokens - self.used

    def add(self, line: str, *, keep: int = 0) -> bool:
        """Add a line where that leaves `keep` tokens; whether it was added."""
        cost = count_tokens(line + "\n")
        if self.used + cost + keep > self.tokens:
            return False
        self.lines.append(line)
        self.used += cost
        return True

    def add_list(self, head: str, items: Iterable[str], *, share: float = 1.0) -> int:
        """Add a header line and as many items as fit into a share of the remaining tokens; returns their number."""
        separator, room = "; ", self.used + share * self.left
        items, kept, cost = list(items), 0, count_tokens(head + "\n")
        step = count_tokens(separator)
        for item in items:
            cost += count_tokens(" " + item) + step
            if self.used + cost > room:
                break
            kept += 1
        while kept and not self.add(head + " " + separator.join(items[:kept])):
            kept -= 1
        return kept

    def text(self) -> str:
        """Return the text."""
        return "".join(line + "\n" for line in self.lines)

"""Print the tables of README.md and docs from the committed results, or check that they show them.

    python scripts/readme_tables.py            # write the tables between their marks
    python scripts/readme_tables.py --check    # exit status 1 where a page differs

Each table is read from JSON files under benchmarks/results, which the command named beside the table wrote.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable

from tables.association import alignment, changed, fair, kitchen, methods, registration, returns, worth
from tables.exports import batches, catalogue, exports, pack, physics, receivers
from tables.lighter import derivation, questions, traces
from tables.results import ROOT
from tables.summary import summary
from tables.things import changes, discovery, memories, relations, walks

TABLES: dict[str, Callable[[], str]] = {
    "summary": summary,
    "kitchen": kitchen,
    "walks": walks,
    "discovery": discovery,
    "memories": memories,
    "fair": fair,
    "methods": methods,
    "worth": worth,
    "returns": returns,
    "registration": registration,
    "changed": changed,
    "alignment": alignment,
    "derivation": derivation,
    "questions": questions,
    "traces": traces,
    "changes": changes,
    "relations": relations,
    "pack": pack,
    "exports": exports,
    "receivers": receivers,
    "physics": physics,
    "catalogue": catalogue,
    "batches": batches,
}
PAGES = (
    *("README.md", "docs/measured.md", "docs/prompt.md", "docs/commands.md", "docs/usd.md"),
    *("docs/batch.md", "docs/catalog.md"),
)
"""The pages with tables."""


def filled(text: str) -> str:
    """Return a page with every marked table written again. Raises `SystemExit` for a mark without a table."""

    def fill(mark: re.Match[str]) -> str:
        name = mark.group(1)
        if name not in TABLES:
            raise SystemExit(f"a page asks for the table {name}; there are {', '.join(TABLES)}")
        return f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end of table -->"

    return re.sub(r"<!-- table (\w+) -->\n.*?<!-- end of table -->", fill, text, flags=re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 where a page differs")
    check = parser.parse_args().check
    for page in PAGES:
        before = (ROOT / page).read_text(encoding="utf-8")
        after = filled(before)
        if check and before != after:
            print(f"{page} shows other figures than benchmarks/results: run scripts/readme_tables.py", file=sys.stderr)
            raise SystemExit(1)
        if not check:
            (ROOT / page).write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()

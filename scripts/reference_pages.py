"""Write the pages of the site that are made from code: every command from typer, the tutorial from its notebook.

python scripts/reference_pages.py OUT_FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def command_pages() -> str:
    """Return the help of all commands as Markdown."""
    from list3r.cli.app import FIRST, REST, commands

    tree = commands()
    lines = [
        "# Every command",
        "",
        "Made from the program's own help; [commands and options](../commands.md) is a summary.",
    ]
    for title, names in (FIRST | REST).items():
        lines += ["", f"## {title}"]
        for name in names:
            command = tree.commands.get(name)
            for path, one in _leaves([name], command) if command is not None else ():
                context = one.make_context(" ".join(["list3r", *path]), [], resilient_parsing=True)
                text = one.get_help(context)
                lines += ["", f"### {' '.join(path)}", "", "```text", text, "```"]
    return "\n".join(lines) + "\n"


def _leaves(path: list[str], command: Any) -> list[tuple[list[str], Any]]:
    below = getattr(command, "commands", None)
    if not below:
        return [(path, command)]
    return [leaf for name, one in below.items() for leaf in _leaves([*path, name], one)]


def tutorial_page() -> str:
    """Return the notebook as Markdown; the file itself lies in `examples/`."""
    notebook = json.loads((ROOT / "examples/tutorial.ipynb").read_text(encoding="utf-8"))
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def main() -> None:
    out = Path(sys.argv[1])
    (out / "reference").mkdir(parents=True, exist_ok=True)
    (out / "reference/cli.md").write_text(command_pages(), encoding="utf-8")
    (out / "tutorial.md").write_text(tutorial_page(), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Test findings in one checkout, that of `list3r`: `python -m hostile.findings.row FOLDER [KEY ...]`.

Prints a line of JSON for each: its key and the result, empty where it holds.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import list3r
import list3r.cli.app  # once, for all that are forked from here
from hostile.findings import answers, files, handles, sources, terminal
from hostile.findings.place import Place

ROWS: dict[str, Callable[[Place], str]] = {
    key: look for module in (files, answers, sources, terminal, handles) for key, look in module.ROWS.items()
}


def main() -> None:
    folder = Path(sys.argv[1])
    for n, key in enumerate(sys.argv[2:] or ROWS):
        own = folder / str(n)
        own.mkdir()
        child = os.fork()
        if child == 0:
            print(json.dumps([key, _looked_for(key, own)]), flush=True)
            os._exit(0)
        os.waitpid(child, 0)


def _looked_for(key: str, folder: Path) -> str:
    try:
        return ROWS[key](Place(folder, Path(str(list3r.__file__)).parents[1]))[:200]
    except Exception as error:
        traceback.print_exc()
        return f"cannot be tested: {type(error).__name__}: {error}"


if __name__ == "__main__":
    main()

"""Export a memory: scene JSON, USD, plan picture, coloured points, trajectory.

python examples/04_export.py [MEMORY] [FOLDER]
"""

import sys
from pathlib import Path

import list3r


def main() -> None:
    source = sys.argv[1] if len(sys.argv) > 1 else "out/examples/rooms.l3r"
    folder = Path(sys.argv[2] if len(sys.argv) > 2 else "out/examples")
    folder.mkdir(parents=True, exist_ok=True)
    with list3r.open(source) as memory:
        for name, suffix in (("json", "json"), ("usd", "usdc"), ("plan", "png"), ("ply", "ply"), ("tum", "txt")):
            memory.export(name, folder / f"rooms.{suffix}")
            print(folder / f"rooms.{suffix}")


if __name__ == "__main__":
    main()

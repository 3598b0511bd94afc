"""Build a memory from a folder of RGB-D frames.

    python examples/01_build.py [FOLDER] [MEMORY]

Without FOLDER a short walk through a simulated room is rendered first.
"""

import sys
from pathlib import Path

import list3r
from list3r.simulation.dataset import WalkSettings, write_walk


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/walk")
    path = Path(sys.argv[2] if len(sys.argv) > 2 else "out/examples/rooms.l3r")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not folder.exists():
        write_walk(folder, WalkSettings(seed=1, frames=60, size=(240, 180)))
    with list3r.build(folder, path, force=path.exists()) as memory:
        print(f"{path}: lengths in {memory.units}, gravity {memory.gravity}")
        for thing in memory.instances():
            print(f"{thing.id:4}  {thing.description:40} at {thing.center.round(2)}")


if __name__ == "__main__":
    main()

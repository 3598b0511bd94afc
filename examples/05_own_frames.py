"""Bring frames of your own: write them in the TUM layout, and build.

    python examples/05_own_frames.py [FOLDER]

The four things that a builder needs are pictures, depth on the same pixels, times, and the camera. Here they come from
the simulation's renderer; put your sensor in its place.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import list3r
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/own")
    settings = WalkSettings(seed=2, frames=30, size=(240, 180))
    camera = settings.camera()
    renderer = Renderer(settings.world(), camera)
    times, poses = settings.poses()
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    names = {"rgb": [], "depth": []}
    for k, (time, T_world_cam) in enumerate(zip(times, poses, strict=True)):
        picture = renderer.render(T_world_cam)
        color = np.round(picture.color).astype(np.uint8)
        Image.fromarray(color).save(folder / f"rgb/{k:04d}.png")
        millimetres = np.round(picture.depth * 1000).astype(np.uint16)  # 0 where depth is unknown
        Image.fromarray(millimetres).save(folder / f"depth/{k:04d}.png")
        for kind, lines in names.items():
            lines.append(f"{time:.6f} {kind}/{k:04d}.png")
    for kind, lines in names.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    (folder / "calibration.txt").write_text(f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}\n")

    options = list3r.SourceOptions(depth_scale=1000)
    with list3r.build(folder, folder.with_suffix(".l3r"), options=options, force=True) as memory:
        print(f"{len(memory.instances())} things")


if __name__ == "__main__":
    main()

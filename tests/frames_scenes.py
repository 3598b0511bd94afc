"""Small painted scenes with known cameras, and the folders they are written to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera

SMALL = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


def cards(seed: int, count: int = 9) -> list[tuple[float, float, float, float, float, int]]:
    """Cards facing the camera, far ones first: z, x, y, half width, half height in metres, brightness."""
    rng = np.random.default_rng(seed)
    out = [(3.2, 0.0, 0.0, 9.0, 9.0, 120)]
    for z in np.sort(rng.uniform(0.7, 2.6, count))[::-1]:
        x, y = rng.uniform(-0.55, 0.55) * z, rng.uniform(-0.4, 0.4) * z
        bright = int(rng.choice([20, 50, 190, 240]))
        out.append((float(z), x, y, rng.uniform(0.06, 0.16) * z, rng.uniform(0.06, 0.16) * z, bright))
    return out


def paint(scene: list, camera: Camera, T_camera_scene: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Gray picture and depth in metres of cards seen by a pinhole camera that only moved. Shapes (H, W)."""
    gray = np.zeros((camera.height, camera.width), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.float32)
    shift = T_camera_scene[:3, 3]
    for z, x, y, half_x, half_y, bright in scene:
        zc = z + shift[2]
        corners = [(x + i * half_x, y + j * half_y) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        pixels = [
            ((a + shift[0]) / zc * camera.fx + camera.cx, (b + shift[1]) / zc * camera.fy + camera.cy)
            for a, b in corners
        ]
        fixed = np.clip(np.rint(np.array(pixels) * 16), -30000, 30000).astype(np.int32)
        cv2.fillPoly(gray, [fixed], bright, shift=4)
        cv2.fillPoly(depth, [fixed], float(zc), shift=4)
    return gray, depth


def moved(x: float, y: float, z: float = 0.0) -> NDArray[np.float64]:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def write_png(path: Path, image: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def color_image(seed: int, width: int = 80, height: int = 60) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def depth_image(metres: float, units: float, width: int = 80, height: int = 60) -> NDArray[np.uint16]:
    return np.full((height, width), round(metres * units), np.uint16)


def write_seven_scenes(root: Path, count: int = 4, nominal: float = 585.0) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write_png(root / f"frame-{k:06d}.color.png", color_image(k, 640, 480))
        write_png(root / f"frame-{k:06d}.depth.png", depth_image(1.5, 1000, 640, 480))
        np.savetxt(root / f"frame-{k:06d}.pose.txt", moved(0.1 * k, 0, 0))
    np.savetxt(root / "camera-intrinsics.txt", [[nominal, 0, 320], [0, nominal, 240], [0, 0, 1]])
    return root


def write_tum(root: Path, count: int = 5, units: float = 5000.0) -> Path:
    """Colour every 0.1 s from 10 s on, depth 4 ms later, poses every 0.02 s moving 1 m/s along x."""
    lines: dict[str, list[str]] = {"rgb": ["# colour"], "depth": ["# depth"], "groundtruth": ["# truth"]}
    for k in range(count):
        t = 10.0 + 0.1 * k
        write_png(root / f"rgb/{k}.png", color_image(k))
        write_png(root / f"depth/{k}.png", depth_image(1.0 + 0.1 * k, units))
        lines["rgb"].append(f"{t:.4f} rgb/{k}.png")
        lines["depth"].append(f"{t + 0.004:.4f} depth/{k}.png")
    for t in np.arange(9.99, 10.0 + 0.1 * count, 0.02):
        lines["groundtruth"].append(f"{t:.4f} {t - 10.0:.5f} 0 0 0 0 0 1")
    for name, rows in lines.items():
        (root / f"{name}.txt").write_text("\n".join(rows) + "\n")
    return root


def write_replica(root: Path, count: int = 3) -> Path:
    for k in range(count):
        write_png(root / f"results/frame{k:06d}.jpg", color_image(k))
        write_png(root / f"results/depth{k:06d}.png", depth_image(2.0, 6553.5))
    np.savetxt(root / "traj.txt", [moved(0, 0, k).ravel() for k in range(count)])
    (root / "cam_params.json").write_text('{"camera": {"w": 80, "h": 60, "fx": 70, "fy": 70, "cx": 39.5, "cy": 29.5}}')
    return root

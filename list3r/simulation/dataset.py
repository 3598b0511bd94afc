"""A simulated walk as a folder in the TUM RGB-D layout, with the truth next to it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.evaluation.trajectory import Trajectory, write_tum
from list3r.frames.base import Camera
from list3r.memory.core.errors import ExportError, OptionError
from list3r.pipeline.workers import OrderedPool
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import SensorSettings, sense
from list3r.simulation.rendering.shading import Lighting
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.objects import MovingObject
from list3r.simulation.worlds.truth import world_truth
from list3r.simulation.worlds.world import SimulatedWorld, make_world

DEPTH_UNITS_PER_M = 5000.0
_BATCH = 12


@dataclass(frozen=True)
class WalkSettings:
    """A walk through two furnished rooms. Subclasses film other worlds, other ways or objects that move."""

    seed: int = 0
    """Decides the world."""
    walk_seed: int | None = None
    """Decides the hand's motion and the noise; None takes `seed`."""
    frames: int | None = None
    """None walks the whole round, about 280; fewer cut it short, more walk it slower."""
    start: int = 0
    """Frames of the walk to leave out at its beginning."""
    size: tuple[int, int] = (320, 240)
    """Width and height, px."""
    focal: float | None = None
    """Focal length, px; None takes the first Kinect's 525 at 640 px."""
    path: PathSettings = field(default_factory=PathSettings)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    lighting: Lighting = field(default_factory=Lighting)
    write_ids: bool = False
    """Also write `ids/`: the id of the object in every pixel, 16 bit."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 2:
            raise OptionError(f"a walk of {self.frames} frames: it needs at least 2")
        if min(self.size) < 32 or max(self.size) > 4096:
            raise OptionError(f"picture size {self.size[0]}x{self.size[1]}: both must be from 32 to 4096 px")
        if self.start < 0:
            raise OptionError(f"start {self.start}: it must not be negative")

    def camera(self) -> Camera:
        """Return the pinhole camera of the pictures."""
        width, height = self.size
        focal = 525.0 * width / 640 if self.focal is None else self.focal
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    def world(self) -> SimulatedWorld:
        """Return the world that is filmed."""
        return make_world(self.seed)

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        seed = self.seed if self.walk_seed is None else self.walk_seed
        frames = None if self.frames is None else self.frames + self.start
        time_s, poses = camera_path(self.world().tour, frames, self.path, seed)
        if len(time_s) - self.start < 2:
            raise OptionError(f"start {self.start} leaves nothing of a walk of {len(time_s)} frames")
        return time_s[self.start :], poses[self.start :]

    def movers(self) -> tuple[MovingObject, ...]:
        """Return the moving objects, with their poses in the frames to be written."""
        return ()

    def truth(self, seen: dict[int, dict[str, int]]) -> dict[str, Any]:
        """Return the content of `truth.json`; `seen` has the counts of each object id, see `world_truth`."""
        return world_truth(self.world(), seen)


def write_walk(
    folder: str | Path,
    settings: WalkSettings | None = None,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render a walk into `folder`, which is made if absent and must hold no walk yet; the same for any `workers`.

    Writes `rgb/`, `depth/` (16 bit, 5000 per metre), `rgb.txt`, `depth.txt`, `groundtruth.txt` (T_world_cam),
    `calibration.txt` (fx fy cx cy) and `truth.json`. `progress` is called with the number of frames just written.
    Raises `OptionError` for a folder that holds a walk, `ExportError` for one that cannot be written.
    """
    settings = settings or WalkSettings()
    root = Path(folder)
    if (root / "rgb.txt").exists():
        raise OptionError(f"{root} already holds a sequence: name another folder or remove it first")
    try:
        return _write(root, settings, workers, progress)
    except OSError as error:
        raise ExportError(f"cannot write the walk to {error.filename or root}: {error.strerror or error}") from error


def _write(root: Path, settings: WalkSettings, workers: int, progress: Callable[[int], None] | None) -> Path:
    for name in ("rgb", "depth", *(["ids"] if settings.write_ids else [])):
        (root / name).mkdir(parents=True, exist_ok=True)
    time_s, poses = settings.poses()
    spans = [(k, min(k + _BATCH, len(time_s))) for k in range(0, len(time_s), _BATCH)]
    seen: dict[int, dict[str, int]] = {}
    pool = OrderedPool(partial(_write_in_process, settings, root), workers) if workers > 1 else None
    with pool or nullcontext():
        for areas in pool.map(spans) if pool else map(_Writer(settings, root).write_span, spans):
            _count(seen, areas)
            if progress is not None:
                progress(len(areas))
    write_tum(root / "groundtruth.txt", Trajectory(time_s, poses))
    (root / "truth.json").write_text(json.dumps(settings.truth(seen), indent=1) + "\n", encoding="utf-8")
    _write_lists(root, time_s, settings.camera())
    return root


class _Writer:
    """Renders and writes frames of one walk; one in every process."""

    def __init__(self, settings: WalkSettings, root: Path) -> None:
        self._settings, self._root = settings, root
        self._time_s, self._poses = settings.poses()
        self._movers = settings.movers()
        objects = [m.obj for m in self._movers]
        self._renderer = Renderer(settings.world(), settings.camera(), objects, settings.lighting)
        self._seed = settings.seed if settings.walk_seed is None else settings.walk_seed

    def write_span(self, span: tuple[int, int]) -> list[dict[int, int]]:
        """Write the frames at positions [start, stop); returns the areas of the objects in each."""
        return [self._write(position) for position in range(*span)]

    def _write(self, position: int) -> dict[int, int]:
        for mover in self._movers:
            self._renderer.scene.place(mover.obj.id, mover.T_world_object[position])
        frame = self._renderer.render(self._poses[position])
        sensed = sense(
            frame, self._settings.sensor, self._seed, position + self._settings.start, float(self._time_s[position])
        )
        name = frame_name(position)
        depth = np.rint(sensed.depth * DEPTH_UNITS_PER_M).astype(np.uint16)
        color = cv2.cvtColor(sensed.color, cv2.COLOR_RGB2BGR)
        _save(self._root / "rgb" / f"{name}.jpg", color, [cv2.IMWRITE_JPEG_QUALITY, 95])
        _save(self._root / "depth" / f"{name}.png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        if self._settings.write_ids:
            _save(self._root / "ids" / f"{name}.png", frame.ids.astype(np.uint16), [])
        area = np.bincount(frame.ids.ravel())
        return {int(k): int(area[k]) for k in np.flatnonzero(area) if k > 0}


@lru_cache(maxsize=1)
def _writer(settings: WalkSettings, root: Path) -> _Writer:
    return _Writer(settings, root)


def _write_in_process(settings: WalkSettings, root: Path, span: tuple[int, int]) -> list[dict[int, int]]:
    return _writer(settings, root).write_span(span)


def frame_name(position: int) -> str:
    """Stem of the picture at a position."""
    return f"{position:06d}"


def _save(path: Path, image: NDArray[Any], options: list[int]) -> None:
    ok, data = cv2.imencode(path.suffix, image, options)
    assert ok
    path.write_bytes(data.tobytes())


def _count(seen: dict[int, dict[str, int]], areas: Iterable[dict[int, int]]) -> None:
    for frame in areas:
        for obj, area in frame.items():
            entry = seen.setdefault(obj, {"frames": 0, "largest_px": 0})
            entry["frames"] += 1
            entry["largest_px"] = max(entry["largest_px"], area)


def _write_lists(root: Path, time_s: NDArray[np.float64], camera: Camera) -> None:
    for name, suffix in (("rgb", "jpg"), ("depth", "png")):
        lines = [f"{t:.6f} {name}/{frame_name(k)}.{suffix}" for k, t in enumerate(time_s)]
        (root / f"{name}.txt").write_text("# timestamp filename\n" + "\n".join(lines) + "\n", encoding="utf-8")
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    (root / "calibration.txt").write_text(" ".join(f"{v:.6f}" for v in numbers) + "\n", encoding="utf-8")

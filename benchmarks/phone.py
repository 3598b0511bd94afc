"""Videos as a phone films them, by colour alone: whether up and a metre are found, and what is said where they are not.

    PYTHONPATH=. python benchmarks/phone.py --keep FOLDER --json benchmarks/results/phone.json

Three clips of RedKitchen (7-Scenes) become mp4 files: the first 300 frames, and two of 150 frames at 480 px. Truth is
given by its poses; up in them is the normal of the table and the floor in its depth. Three simulated walks of 110
frames: `portrait` (240x320 px) through two rooms, `tilted` (320x240) with the camera rolled by 20 degrees, `pan`
(240x320) a turn on the spot by 200 degrees. Of the bedroom (frames of SAM 2) there is no truth: what is found is
listed. With `--detector FILE` things get names. `find "cup on table"` is asked. Reconstructions in `--keep` are used
again, and of memories the chunks with what was named: how they lie, up, the metre and the library are derived anew.

`up_error_deg` is the angle of the memory's z to up where the memory says that z is up, by the cameras' orientations;
`metre_error` is by how much a metre of the memory is too long, by the cameras' places.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from machine import write_json
from numpy.typing import NDArray

from list3r.api import open as open_memory
from list3r.memory.core.geometry import umeyama
from list3r.memory.library.world.guess import GUESS
from list3r.memory.store.store import Store
from list3r.pipeline.filming import film_advice
from list3r.pipeline.finishing import guess_anew
from list3r.pipeline.mapping import finish_session
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import sense
from list3r.simulation.walk import viewing_poses

Array = NDArray[np.float64]
QUESTION = "cup on table"
SIZE, FRAMES = (240, 320), 110
"""Width and height of the simulated pictures, and how many of a walk."""
_LEVEL_DEG = 5.0


@dataclass(frozen=True)
class Clip:
    """A video, and what is true of it."""

    name: str
    video: Path
    T_world_cam: Array | None = None
    """Of every frame, metres. Shape (F, 4, 4)."""
    up: Array | None = None
    """In that world. Shape (3,)."""


@dataclass(frozen=True)
class PhoneWalk(WalkSettings):
    """A simulated walk with a phone; the roll is that of all frames."""

    size: tuple[int, int] = SIZE
    focal: float | None = 300.0
    frames: int | None = FRAMES
    roll_deg: float = 0.0
    pan_deg: float = 0.0
    """A turn by so much on the spot instead of a walk, the camera half a metre from the body."""

    def poses(self) -> tuple[Array, Array]:
        """As of every walk."""
        time_s, poses = super().poses()
        if self.pan_deg:
            share = np.linspace(0.0, 1.0, len(time_s))
            yaw = np.radians(self.pan_deg) * share - 2.0
            sway = np.random.default_rng(self.seed).normal(0.0, np.radians(0.3), (2, len(yaw)))
            middle = np.array([*poses[0, :2, 3], 1.45])
            place = middle + 0.5 * np.stack([np.cos(yaw), np.sin(yaw), 0.1 * np.sin(9 * share)], axis=1)
            poses = viewing_poses(place, yaw, np.radians(-20.0) + sway[0], sway[1])
        c, s = np.cos(np.radians(self.roll_deg)), np.sin(np.radians(self.roll_deg))
        turned = poses.copy()
        turned[:, :3, :3] = poses[:, :3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return time_s, turned


SIMULATED = {
    "portrait": PhoneWalk(seed=5),
    "tilted": PhoneWalk(seed=6, size=(320, 240), roll_deg=20.0),
    "pan": PhoneWalk(seed=7, pan_deg=200.0),
}
KITCHEN = {"kitchen": (0, 300, 1, 640), "kitchen 350": (350, 650, 2, 480), "kitchen 700": (700, 1000, 2, 480)}
"""First frame, stop, every, width."""


def main() -> None:
    """Build all and write what came of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder for videos, reconstructions and memories")
    parser.add_argument("--only", help="names of clips, separated by commas")
    parser.add_argument("--detector", help="a NanoDet detector (.param)")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = asked.keep or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        names = None if asked.only is None else asked.only.split(",")
        rows = [measured(clip, root, asked.detector) for clip in clips(asked.data, root, names)]
    write_json(asked.json, {"data": __doc__.split("\n\n")[2].replace("\n", " "), "clips": rows})


def clips(data: Path, root: Path, names: list[str] | None) -> Iterator[Clip]:
    """The videos, made where they are not there yet."""
    for name, settings in SIMULATED.items():
        if names is None or name in names:
            video = root / f"{name}.mp4"
            poses = settings.poses()[1]
            if not video.exists():
                write_video(video, film(settings), settings.size, 12)
            yield Clip(name, video, poses, np.array([0.0, 0.0, 1.0]))
    kitchen = data / "redkitchen"
    for name, (first, stop, every, width) in KITCHEN.items():
        if kitchen.is_dir() and (names is None or name in names):
            video, chosen = root / f"{name.replace(' ', '-')}.mp4", range(first, stop, every)
            if not video.exists():
                pictures = (cv2.imread(str(kitchen / f"frame-{k:06d}.color.jpg"))[..., ::-1] for k in chosen)
                write_video(video, pictures, (width, width * 3 // 4), 30 // every)
            T = np.array([np.loadtxt(kitchen / f"frame-{k:06d}.pose.txt") for k in chosen])
            yield Clip(name, video, T, up_of_depth(kitchen))
    bedroom = data / "bedroom" / "bedroom.mp4"
    if bedroom.is_file() and (names is None or "bedroom" in names):
        yield Clip("bedroom", bedroom)


def film(walk: PhoneWalk) -> Iterator[NDArray[np.uint8]]:
    """Pictures of a walk."""
    renderer = Renderer(walk.world(), walk.camera())
    for k, (time_s, T_world_cam) in enumerate(zip(*walk.poses(), strict=True)):
        yield sense(renderer.render(T_world_cam), walk.sensor, walk.seed, k, float(time_s)).color


def write_video(path: Path, pictures: Iterator[NDArray[np.uint8]], size: tuple[int, int], rate: int) -> None:
    """An mp4 of RGB pictures, resized where they are of another size."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=rate, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for picture in pictures:
            if picture.shape[1::-1] != size:
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        file.mux(stream.encode())


def up_of_depth(kitchen: Path) -> Array:
    """The normal of what is level, table and floor, by the depth of every 20th frame in the world of its poses."""
    found, mean_up = [], np.zeros(3)
    for k in range(0, 1000, 20):
        depth = cv2.imread(str(kitchen / f"frame-{k:06d}.depth.png"), cv2.IMREAD_UNCHANGED)[::4, ::4] / 1000.0
        depth[depth > 4.0] = 0.0
        v, u = np.mgrid[0:480:4, 0:640:4]
        p = np.stack([(u - 320) / 585 * depth, (v - 240) / 585 * depth, depth], axis=-1)
        across, along = p[4:-4, 8:] - p[4:-4, :-8], p[8:, 4:-4] - p[:-8, 4:-4]
        near = (np.linalg.norm(across, axis=-1) < 0.2) & (np.linalg.norm(along, axis=-1) < 0.2)
        normal = np.cross(across, along)
        length = np.linalg.norm(normal, axis=-1)
        good = near & (length > 0) & (depth[4:-4, 4:-4] > 0)
        n = -normal[good] / length[good][:, None]
        n *= np.where((n * p[4:-4, 4:-4][good]).sum(axis=1) > 0, -1.0, 1.0)[:, None]
        R = np.loadtxt(kitchen / f"frame-{k:06d}.pose.txt")[:3, :3]
        found.append(n[::3] @ R.T)
        mean_up -= R[:, 1]
    normals, near = np.concatenate(found), np.cos(np.radians(_LEVEL_DEG))
    start = normals[:: len(normals) // 2000]
    start = start[start @ mean_up > 0.5 * np.linalg.norm(mean_up)]
    up = start[int(np.argmax([(normals @ n > near).sum() for n in start]))]
    for _ in range(10):
        up = normals[normals @ up > near].mean(axis=0)
        up /= np.linalg.norm(up)
    return np.asarray(up)


def measured(clip: Clip, root: Path, detector: str | None) -> dict[str, Any]:
    """What a build makes of a clip, against the truth."""
    memory = root / f"{clip.video.stem}.l3r"
    if memory.exists():
        derive_anew(memory)
    else:
        named = () if detector is None else ("--detector", detector)
        answer = built(["build", str(clip.video), "-m", str(memory), "--json", *named], root / clip.video.stem)
        if "error" in answer:
            print(clip.name, answer["error"])
            return {"clip": clip.name, "error": answer["error"]["message"]}
    with open_memory(memory) as scene:
        facts, found = scene.info(), scene.find(QUESTION)
        told = ("frames", "posed", "components", "instances", "gravity", "gravity_deviation_deg", "scale")
        row = {
            "clip": clip.name,
            **{k: facts[k] for k in (*told, "metre_deviation", "scale_source")},
            "found": [f"#{m.instance.id} {m.instance.label or m.instance.description}: {m.reason}" for m in found],
            "unknown_words": list(found.unknown_words),
            "film": film_advice(scene.store, 1),
            **errors(scene.store, clip),
        }
    print(row)
    return row


def derive_anew(memory: Path) -> None:
    """Place the chunks of a memory that is there, and derive its library, up and metre from them, without a guess."""
    with Store.open(memory, writable=True) as store:
        with store.transaction():
            store.facts[GUESS] = store.facts.metres_per_graph_unit = None
        finish_session(store, 1)
    guess_anew(memory)


def built(command: list[str], kept: Path) -> dict[str, Any]:
    """The answer of the program; a video that gives no memory is an answer too."""
    program = [sys.executable, str(Path(__file__).with_name("kept.py")), *command]
    done = subprocess.run(program, stdout=subprocess.PIPE, text=True, env=os.environ | {"LIST3R_KEPT": str(kept)})
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def errors(store: Store, clip: Clip) -> dict[str, float | None]:
    """Angle of z to up, and by how much a metre is too long, where the memory says so; of the first part."""
    out: dict[str, float | None] = {"up_error_deg": None, "metre_error": None}
    if clip.T_world_cam is None or clip.up is None:
        return out
    first = min(c.component for c in store.chunks.all())
    rows = {c.chunk_id: c for c in store.chunks.all() if c.component == first}
    frames = {f.frame_index: f for c in rows.values() for f in store.frames.of(c) if f.state == "posed"}
    S = [rows[f.chunk_id].S_world_chunk for f in frames.values()]
    T = np.array([f.T_chunk_cam for f in frames.values()])
    R = np.array([a.rotation @ b[:3, :3] for a, b in zip(S, T, strict=True)])
    places = np.array([a.apply(b[:3, 3][None])[0] for a, b in zip(S, T, strict=True)])
    true = clip.T_world_cam[list(frames)]
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", true[:, :3, :3], R))
    up = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T @ clip.up
    if store.facts.gravity != "unknown":
        out["up_error_deg"] = round(float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))), 2)
    if store.facts.scale_kind != "relative":
        out["metre_error"] = round(float(umeyama(places, true[:, :3, 3], with_scale=True).scale) - 1.0, 3)
    return out


if __name__ == "__main__":
    main()

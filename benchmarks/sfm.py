"""Colour video without weights: `--reconstruction sfm` compared with plain pycolmap of the whole sequence, in one run.

    python benchmarks/sfm.py --source ../shared/data/redkitchen --intrinsics 525,525,320,240 --json FILE

Depth and poses of the source are not used: a folder of its colour pictures alone is built, and the poses serve as
truth. Plain pycolmap (SIFT, sequential matching, incremental mapping, its own defaults) maps every n-th of the same
frames with the same parameters: the focal length fixed where it is given, the distortion free. Times are wall and CPU
seconds, of the whole program for ours, of features, matching and mapping for the other.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from machine import machine, run_list3r, write_json

from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory
from list3r.frames.base import Camera, Frame
from list3r.frames.options import parse_intrinsics
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.store.store import Store


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--source", type=Path, required=True, help="folder that `list3r inspect` recognises, with poses"
    )
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy of the colour camera; estimated where left out")
    parser.add_argument("--frames", type=int, help="only the first so many")
    parser.add_argument("--every", type=int, help="`list3r build` takes every n-th frame")
    parser.add_argument("--plain-every", type=int, default=8, help="plain pycolmap maps every n-th frame")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--given-as", choices=("folder", "mp4", "phone"), default="folder")
    parser.add_argument("--no-plain", action="store_true", help="leave plain pycolmap out")
    parser.add_argument("--keep", type=Path, help="where to keep the memory")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    truth, names = read_truth(args.source, args.frames)
    with tempfile.TemporaryDirectory() as scratch:
        folder = colour_only(Path(scratch) / "colour", names)
        given = folder if args.given_as == "folder" else _video(folder, Path(scratch), args.given_as)
        ours = {
            "given_as": args.given_as,
            **built(given, args.keep or Path(scratch) / "memory.l3r", _options(args), truth),
        }
        print(ours)
        if args.no_plain:
            write_json(args.json, {"source": args.source.name, "list3r": ours})
            return
        plain = plain_pycolmap(folder, Path(scratch), args.intrinsics, truth, args.plain_every)
        print(plain)
    ratio = ours["ate_sim3_m"] / plain["ate_sim3_m"] if plain["posed"] else float("nan")
    print(f"ATE ours by plain {ratio:.3f}", machine())
    write_json(args.json, {"source": args.source.name, "list3r": ours, "pycolmap": plain, "ratio": round(ratio, 4)})


def read_truth(source: Path, count: int | None) -> tuple[Trajectory, list[Path]]:
    """Given poses of the colour camera, at index / 30 s, and the colour pictures in order."""
    opened = open_source(source, SourceOptions(stop=count))
    poses = {index: T for index, _, T in opened.read_poses()}  # type: ignore[attr-defined]
    rows = sorted(poses)
    names = [file.color for file in opened._layout.files][: opened.info.frame_count]  # type: ignore[attr-defined]
    return Trajectory(np.array(rows) / 30.0, np.stack([poses[k] for k in rows])), names


def colour_only(folder: Path, names: list[Path]) -> Path:
    """A folder of links to the colour pictures, with names that say nothing of their camera."""
    folder.mkdir()
    for number, name in enumerate(names):
        (folder / f"{number:06d}{name.suffix}").symlink_to(name.resolve())
    return folder


def _video(folder: Path, scratch: Path, kind: str) -> Path:
    """The pictures as an mp4; for a phone rotated with a tag to turn them, at an uneven rate."""
    import av

    phone = kind == "phone"
    path = scratch / ("IMG_0001.mov" if phone else "walk.mp4")
    jitter = np.random.default_rng(1).integers(-9, 10, 100_000) if phone else np.zeros(100_000, int)
    clock = Fraction(1, 30_000)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.time_base = stream.codec_context.time_base = clock
        stream.options = {"crf": "18", "g": "30"}
        for number, name in enumerate(sorted(folder.iterdir())):
            picture = cv2.imread(str(name))[..., ::-1]
            picture = np.ascontiguousarray(np.rot90(picture, 1 if phone else 0))
            if number == 0:
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                if phone:
                    stream.set_display_rotation(-90)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = number * 1000 + int(jitter[number]) * 30, clock
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    first = next(iter(open_source(path).read(0, 1)))
    upright = cv2.imread(str(min(folder.iterdir())))[..., ::-1]
    assert isinstance(first, Frame) and first.color.shape == upright.shape
    assert np.abs(first.color.astype(int) - upright).mean() < 8, "the clip does not show the filmed pictures"
    return path


def _options(args: argparse.Namespace) -> list[str]:
    options = ["--workers", str(args.workers)]
    options += ["--intrinsics", args.intrinsics] if args.intrinsics else []
    return options + (["--every", str(args.every)] if args.every else [])


def built(folder: Path, memory: Path, options: list[str], truth: Trajectory) -> dict[str, Any]:
    """Result of `list3r build FOLDER --reconstruction sfm`; `truth` at index / 30 s."""
    options = ["--reconstruction", "sfm", *options]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    report, usage = run_list3r("build", str(folder), "-m", str(memory), *options)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    with Store.open(memory) as store:
        rows = [(f.frame_index, S.rotation, S.translation) for f, S in store.trajectory.poses()]
        focal = store.chunks.all()[0].intrinsics[0]
    return {
        "frames": report["frames"],
        "posed": report["posed"],
        "components": report["components"],
        "loops": report["loops"],
        "instances": report["instances"],
        "focal_px": round(focal, 1),
        **usage,
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "frames_per_s": round(report["frames"] / usage["wall_s"], 2),
        "ate_sim3_m": sim3_error(truth, {k: (R, t) for k, R, t in rows}),
        "stage_cpu_seconds": report["stage_seconds"],
    }


def plain_pycolmap(
    folder: Path, scratch: Path, intrinsics: str | None, truth: Trajectory, every: int = 1
) -> dict[str, Any]:
    """Whole-sequence incremental mapping by pycolmap on every n-th frame; `truth` at index / 30 s."""
    import pycolmap

    pictures, database = scratch / "pictures", scratch / "plain.db"
    camera = _write_frames(folder, pictures, intrinsics, every)
    wall, cpu = time.monotonic(), time.process_time()
    pycolmap.set_random_seed(1)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 1
    if camera is not None:
        reader.camera_params = f"{(camera.fx + camera.fy) / 2},{camera.cx + 0.5},{camera.cy + 0.5},0"
        options.ba_refine_focal_length = False
    device = pycolmap.Device.cpu
    pycolmap.extract_features(
        database, pictures, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, device=device
    )
    pycolmap.match_sequential(database, device=device)
    (scratch / "plain").mkdir()
    made = pycolmap.incremental_mapping(database, pictures, scratch / "plain", options)
    wall, cpu = time.monotonic() - wall, time.process_time() - cpu
    poses: dict[int, tuple[Any, Any]] = {}
    for image in max(made.values(), key=lambda m: m.num_reg_images()).images.values() if made else ():
        if image.has_pose:
            T = image.cam_from_world().matrix()
            poses[int(Path(image.name).stem)] = T[:, :3].T, -T[:, :3].T @ T[:, 3]
    return {
        "every": every,
        "frames": len(list(pictures.iterdir())),
        "posed": len(poses),
        "models": len(made),
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "ate_sim3_m": sim3_error(truth, poses),
    }


def _write_frames(folder: Path, pictures: Path, intrinsics: str | None, every: int) -> Camera | None:
    """Every n-th frame as it is handed out."""
    pictures.mkdir()
    known = parse_intrinsics(intrinsics) if intrinsics else None
    source = open_source(folder, SourceOptions(intrinsics=known, every=every))
    for frame in source.read(0, source.info.frame_count):
        if isinstance(frame, Frame):
            cv2.imwrite(str(pictures / f"{frame.index:06d}.png"), frame.color[..., ::-1])
    return source.info.camera


def sim3_error(truth: Trajectory, poses: dict[int, tuple[Any, Any]]) -> float:
    """RMS distance of cameras (rotation, place) by index from the truth at index / 30 s, after Sim(3), metres."""
    rows = sorted(poses)
    if len(rows) < 3:
        return float("nan")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = [poses[k][0] for k in rows], [poses[k][1] for k in rows]
    return round(float(evaluate_trajectory(truth, Trajectory(np.array(rows) / 30.0, T)).ate_sim3_m.rmse), 5)


if __name__ == "__main__":
    main()

"""What lies beside pictures is read, or refused with what to do, and never dropped without a word."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource
from list3r.frames.inspection import SourceReport
from list3r.frames.options import SourceOptions
from list3r.frames.pose_agreement import disagreements
from list3r.frames.quick_look import unusable
from list3r.frames.recordings.stamps import as_seconds
from list3r.frames.registration.edge_look import depth_doubts
from list3r.frames.source import open_source
from list3r.memory.core.errors import List3rError, SourceError
from tests.frames_scenes import color_image, depth_image, moved, write_png, write_replica, write_tum
from tests.recordings import exr, put, shots
from tests.recordings_robots import write_video
from tests.test_frames_recordings import frames_of

MM = SourceOptions(depth_scale=1000.0)
COUNT = 6
K = (70.0, 70.0, 39.5, 29.5)
CASES = Path(__file__).resolve().parents[2] / "shared" / "data" / "cases"


def depth_of(k: int) -> NDArray[np.uint16]:
    """Depth that tells which frame it is of."""
    return depth_image(1.0 + 0.1 * k, 1000)


def write(root: Path, color: Callable[[int], str], depth: Callable[[int], str], count: int = COUNT) -> Path:
    for k in range(count):
        write_png(root / color(k), color_image(k))
        write_png(root / depth(k), depth_of(k))
    return root


def write_film(path: Path) -> Path:
    write_video(path, [shot.color for shot in shots()])
    return path


def told(source: FrameSource) -> str:
    return "; ".join(source.info.notes)


def depths(path: Path) -> list[float]:
    """Depth of each frame, metres."""
    return [round(float(np.median(f.depth)), 3) for f in frames_of(path, depth_scale=1000.0) if f.depth is not None]


NS = 17 * 10**17
OWN = [round(1.0 + 0.1 * k, 3) for k in range(COUNT)]
NAMES: dict[str, tuple[Callable[[int], str], Callable[[int], str], str]] = {
    "same": (lambda k: f"rgb/{k}.jpg", lambda k: f"depth/{k}.png", "name"),
    "prefixes": (lambda k: f"rgb/rgb_{k:04d}.jpg", lambda k: f"depth/depth_{k:04d}.png", "name"),
    "suffixes": (lambda k: f"color/{k}-color.png", lambda k: f"depth/{k}-depth.png", "name"),
    "numbers": (lambda k: f"images/IMG_{k}.jpg", lambda k: f"depth_maps/d{k:06d}.png", "number"),
    "order": (lambda k: f"rgb/a{k}.jpg", lambda k: f"depth/b{k + 1}.png", "order"),
    "one folder": (lambda k: f"frame_{k:04d}.jpg", lambda k: f"depth_{k:04d}.png", "name"),
    "one folder, one name": (lambda k: f"{k:04d}.jpg", lambda k: f"{k:04d}.png", "name"),
    "upper folder": (lambda k: f"{k:04d}.jpg", lambda k: f"Depth/{k:04d}.png", "name"),
    "rtabmap": (lambda k: f"rtabmap_rgb/{k + 10**9}.5.jpg", lambda k: f"rtabmap_depth/{k + 10**9}.5.png", "name"),
    "Redwood": (
        lambda k: f"image/{k + 1:07d}-{33369 * k:012d}.jpg",
        lambda k: f"depth/{k + 1:07d}-{33369 * k + 9000:012d}.png",
        "time",
    ),
    "stamps": (lambda k: f"rgb/17000000{k:02d}.500.png", lambda k: f"depth/17000000{k:02d}.512.png", "time"),
    "nanoseconds": (lambda k: f"rgb/{NS + k * 10**8}.png", lambda k: f"depth/{NS + k * 10**8 + 10**6}.png", "time"),
}  # fmt: skip
"""By what names differ: the names of colour and depth, and by what they are brought together."""


@pytest.mark.parametrize("name", NAMES)
def test_depth_belongs_to_its_picture_whatever_it_is_called(name: str, tmp_path: Path) -> None:
    color, depth, how = NAMES[name]
    path = write(tmp_path / "walk", color, depth)
    assert depths(path) == OWN
    assert how in told(open_source(path, MM)) and open_source(path, MM).info.frame_count == COUNT


def test_a_list_of_pairs_is_read_and_says_the_times(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.jpg", lambda k: f"depth/x{COUNT - 1 - k}.png")
    rows = [f"{10 + 0.1 * k:.1f} rgb\\{k}.jpg {10 + 0.1 * k:.1f} depth/x{COUNT - 1 - k}.png" for k in range(COUNT)]
    put(path / "associations.txt", "\n".join(rows))
    assert depths(path) == OWN
    assert [round(f.time_s, 3) for f in frames_of(path, depth_scale=1000.0)] == [
        round(10 + 0.1 * k, 3) for k in range(COUNT)
    ]


def test_depth_of_some_pictures_leaves_the_others_without(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/a{k}.jpg", lambda k: f"depth/b{k}.png")
    for k in (1, 4):
        (path / f"depth/b{k}.png").unlink()
    put(path / "depth/b77.png", (path / "depth/b0.png").read_bytes())
    source = open_source(path, MM)
    assert "2 of 6 frames have no depth" in told(source) and "1 of 5 depth images belong to no picture" in told(source)
    whole = [f.index for f in source.read(0, COUNT) if isinstance(f, Frame)]
    assert whole == [0, 2, 3, 5]


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing fits": (lambda p: [(p / f"depth/{k}.png").rename(p / f"depth/{chr(97 + k)}.png") for k in range(5)]
                     and (p / "depth/5.png").unlink(), "depth beside the pictures has 5 images"),
    "another form": (lambda p: [f.rename(f.with_suffix(".pfm")) for f in (p / "depth").iterdir()], "depth/ looks like"),
    "a film": (lambda p: shutil.rmtree(p / "depth") or put(p / "depth.mp4", "x"), "depth.mp4 looks like depth"),
    "for people": (lambda p: [write_png(f, color_image(1)) for f in (p / "depth").iterdir()], "3 channels"),
    "8 bits": (lambda p: [write_png(f, np.full((60, 80), 99, np.uint8)) for f in (p / "depth").iterdir()], "8 bits"),
    "two of it": (lambda p: shutil.copytree(p / "depth", p / "depth_raw") and (p / "depth").rename(p / "depth_old"),
                  "several folders look like depth"),
    "poses of others": (lambda p: put(p / "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 4), "4 poses .* for 6 pictures"),
    "mixed columns": (lambda p: put(p / "poses.txt", "1 0 0 0 0 3 2 1\n" * 6), "line 1: the quaternion has length"),
    "poses as JSON": (lambda p: put(p / "poses.json", "{}"), "poses.json looks like poses"),
    "poses of the base": (lambda p: put(p / "rtabmap_poses.txt", "1 0 0 0 0 0 0 1\n" * 6), "--poses_camera"),
    "no camera in it": (lambda p: put(p / "intrinsic.json", "{}"), "states no camera"),
    "camera as XML": (lambda p: put(p / "calibration.xml", "<x/>"), "calibration.xml looks like a camera"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_refused_with_its_name(name: str, tmp_path: Path) -> None:
    change, words = REFUSED[name]
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.jpg", lambda k: f"depth/{k}.png")
    change(path)
    with pytest.raises(SourceError, match=words) as caught:
        open_source(path, MM)
    assert "\n" not in str(caught.value)


def test_a_part_of_a_recording_is_refused_and_can_be_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.jpg", lambda k: f"depth/{k}.png")
    with pytest.raises(SourceError, match="holds depth images and no pictures"):
        open_source(path / "depth")
    with pytest.raises(SourceError, match=f"depth beside it.*give the folder {path}"):
        open_source(path / "rgb")
    assert not open_source(path / "rgb", SourceOptions(kind="images")).info.has_depth
    shutil.rmtree(path / "rgb")
    with pytest.raises(SourceError) as caught:
        open_source(path)
    assert f"give {path / 'depth'}" not in str(caught.value)


def test_confidence_in_the_same_folder_is_no_picture_and_blanks_depth(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"frame_{k:05d}.jpg", lambda k: f"depth_{k:05d}.png")
    sure = np.full((60, 80), 2, np.uint8)
    sure[:, :40] = 0
    for k in range(COUNT):
        write_png(path / f"conf_{k:05d}.png", sure)
        write_png(path / f"mask_{k:05d}.png", sure)
    frames = frames_of(path, depth_scale=1000.0)
    assert len(frames) == COUNT and all(not f.depth[:, :40].any() and f.depth[:, 40:].all() for f in frames)
    assert "6 images beside the pictures are named as masks" in told(open_source(path, MM))


def test_pictures_of_another_size_are_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.png", lambda k: f"depth/{k}.png", 40)
    for k in (3, 17):
        write_png(path / f"rgb/{k}.png", color_image(k, 64, 48))
    assert "2 of 40 pictures looked at are of another size (64x48) than most (80x60)" in told(open_source(path, MM))


def test_pictures_on_their_side_are_of_another_size(tmp_path: Path) -> None:
    for k in range(8):
        write_png(tmp_path / f"{k}.png", color_image(k, *((60, 80) if k % 4 == 0 else (80, 60))))
    assert "2 of 8 pictures looked at are of another size (60x80)" in told(open_source(tmp_path))


def test_depth_that_only_its_pixels_tell_is_not_dropped(tmp_path: Path) -> None:
    path = write_replica(tmp_path / "walk")
    for file in sorted((path / "results").glob("depth*")):
        file.rename(file.with_name(file.name.replace("depth", "z")))
    with pytest.raises(SourceError, match=r"z000000\.png looks like depth"):
        open_source(path)
    assert not open_source(path, SourceOptions(kind="replica")).info.has_depth


def test_a_video_with_depth_beside_it_is_refused_and_can_be_asked_for(tmp_path: Path) -> None:
    path = write_film(tmp_path / "walk.mp4")
    assert open_source(path).info.frame_count > 0
    for k in range(COUNT):
        write_png(tmp_path / f"depth/{k}.png", depth_of(k))
    with pytest.raises(SourceError, match="has depth beside it, depth, which would be lost"):
        open_source(path)
    assert not open_source(path, SourceOptions(kind="video")).info.has_depth


FOUR = {"fx": 70.0, "fy": 71.0, "cx": 39.0, "cy": 29.0}
ROWS = [70, 0, 39, 0, 71, 29, 0, 0, 1]
COLUMNS = [70, 0, 0, 0, 71, 0, 39, 29, 1]
CAMERAS = {
    "camera_intrinsic.json": json.dumps({"width": 80, "height": 60, "intrinsic_matrix": COLUMNS}),
    "intrinsic.json": json.dumps({"color": {"width": 80, "height": 60, "intrinsic_matrix": COLUMNS}}),
    "camera.json": json.dumps({**FOUR, "scale": 500}),
    "intrinsics.json": json.dumps({"fx": 140, "fy": 142, "ppx": 78.5, "ppy": 58.5, "width": 160, "height": 120}),
    "metadata.json": json.dumps({"K": COLUMNS, "w": 80, "h": 60}),
    "camera-intrinsics.txt": "70 0 39\n0 71 29\n0 0 1\n",
    "calibration.txt": "70 71 39 29",
    "calib/1.yaml": f"%YAML:1.0\nimage_width: 80\nimage_height: 60\ncamera_matrix:\n   rows: 3\n   data: {ROWS}\n",
}


@pytest.mark.parametrize("name", CAMERAS)
def test_the_camera_beside_the_pictures_is_read(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.jpg", lambda k: f"depth/{k}.png")
    put(path / name, CAMERAS[name])
    info = open_source(path, SourceOptions(depth_scale=None if name == "camera.json" else 1000.0)).info
    assert info.camera is not None and not [n for n in info.notes if n.startswith("not read")]
    assert np.allclose([getattr(info.camera, n) for n in FOUR], list(FOUR.values()), atol=0.01)
    assert info.depth_scale == (500.0 if name == "camera.json" else 1000.0)


def test_poses_of_any_rows_are_those_of_their_pictures(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/17000000{k:02d}.5.jpg", lambda k: f"depth/17000000{k:02d}.5.png")
    tum = [f"{1700000000.5 + k} {k} 0 0 0 0 0 1" for k in range(COUNT)]
    log = [f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(str, row)) for row in moved(k, 0)) for k in range(COUNT)]
    for name, rows in {
        "poses.txt": tum[::-1],
        "rtabmap_camera_poses.txt": [f"{row} {k + 1}" for k, row in enumerate(tum)],
        "trajectory.txt": [
            row.replace("1700000000.5", "9.5") for row in [f"{k} {k} 0 0 0 0 0 1" for k in range(COUNT)]
        ],
        "trajectory.log": log,
    }.items():
        put(path / name, "\n".join(rows))
        assert [f.T_source_cam[0, 3] for f in frames_of(path, depth_scale=1000.0)] == list(range(COUNT)), name
        (path / name).unlink()


def test_exr_depth_is_in_metres_and_odd_files_are_bad_frames(tmp_path: Path) -> None:
    z = np.linspace(1, 3, 60 * 80, dtype=np.float32).reshape(60, 80)
    for k in range(COUNT):
        write_png(tmp_path / f"walk/rgb/{k}.png", color_image(k))
        put(tmp_path / f"walk/depth/{k}.exr", exr(z, packing=0 if k % 2 else 3))
    put(tmp_path / "walk/depth/4.exr", exr(z)[:-900])
    put(
        tmp_path / "walk/depth/5.exr", exr(z, packing=0).replace(b"compression\0\1\0\0\0\0", b"compression\0\1\0\0\0\4")
    )
    found = list(open_source(tmp_path / "walk", SourceOptions(depth_scale=1.0)).read(0, COUNT))
    assert all(isinstance(f, Frame) and np.array_equal(f.depth, z) for f in found[:4])
    assert [f.reason for f in found[4:] if isinstance(f, BadFrame)] == [
        "4.exr is damaged or cut off",
        "5.exr is compressed by PIZ; zip, RLE and none are read",
    ]


def test_lists_of_windows_and_of_nanoseconds_are_read(tmp_path: Path) -> None:
    path = write_tum(tmp_path / "walk")
    before = [(f.time_s, f.T_source_cam) for f in frames_of(path, intrinsics=K)]
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        rows = [line.split(maxsplit=1) for line in (path / name).read_text().splitlines()[1:]]
        put(path / name, "\n".join(f"{round((float(t) + 1.7e9) * 1e6)}000 {rest}" for t, rest in rows))
    put(path / "rgb.txt", (path / "rgb.txt").read_text().replace("/", "\\"))
    after = frames_of(path, intrinsics=K)
    assert len(after) == len(before) and 9.9 < open_source(path, SourceOptions(intrinsics=K)).info.fps < 10.1
    for (time_s, T), frame in zip(before, after, strict=True):
        assert abs(frame.time_s - time_s - 1.7e9) < 1e-3 and np.allclose(frame.T_source_cam, T, atol=1e-3)


def test_panoramas_are_named_and_wide_pictures_are_not(tmp_path: Path) -> None:
    half = cv2.resize(color_image(7, 10, 5), (480, 240), interpolation=cv2.INTER_CUBIC)
    for k in range(3):
        write_png(tmp_path / f"around/{k}.png", np.roll(np.hstack([half, half[:, ::-1]]), 100 + k, axis=1)[:, ::2])
        write_png(tmp_path / f"wide/{k}.png", cv2.resize(color_image(k, 24, 12), (480, 240)))
    with pytest.raises(SourceError, match="equirectangular"):
        open_source(tmp_path / "around")
    assert open_source(tmp_path / "around", SourceOptions(intrinsics=(300, 300, 240, 120))).info.frame_count == 3
    assert open_source(tmp_path / "wide").info.frame_count == 3


@pytest.mark.parametrize(
    ("case", "options", "camera", "posed"),
    [
        ("depth_names_differ/prefix", MM, False, False),
        ("rtabmap_export/export", None, True, True),
        ("record3d_exr/EXR_RGBD", None, True, True),
    ],
)
def test_the_cases_of_strangers_are_read_whole(
    case: str, options: SourceOptions | None, camera: bool, posed: bool
) -> None:
    if not CASES.is_dir():
        pytest.skip(f"the cases are not at {CASES}")
    info = open_source(CASES / case, options).info
    assert info.has_depth and info.frame_count == 6 and (info.camera is not None) == camera and info.has_poses == posed


# ---------------------------------------------------------------------------------------------- folders at random


def mess(rng: random.Random, root: Path) -> tuple[int, int]:
    """Write a folder as somebody may hand it over. Returns how many depth images and how many poses lie in it."""
    color, depth, _ = NAMES[rng.choice([n for n in NAMES if n != "upper folder"])]
    path = write(root, color, depth, 8)
    if rng.random() < 0.4:
        put(
            path / rng.choice(["poses.txt", "traj.txt", "poses.json", "camera_poses.csv"]),
            "1 0 0 0 0 1 0 0 0 0 1 0\n" * rng.choice([7, 8]),
        )
    if rng.random() < 0.4:
        name = rng.choice(list(CAMERAS))
        put(path / name, CAMERAS[name][: rng.choice([5, 500])])
    for _ in range(rng.randrange(4)):
        files = sorted(p for p in path.rglob("*") if p.suffix in (".png", ".jpg"))
        victim, other = rng.choice(files), rng.choice(files)
        match rng.randrange(6):
            case 0:
                victim.unlink()
            case 1:
                victim.write_bytes(victim.read_bytes()[: rng.randrange(200)])
            case 2:
                write_png(victim, color_image(1, 64, 48))
            case 3:
                victim.write_bytes(other.read_bytes())
            case 4:
                victim.rename(victim.with_name(f"copy of {victim.name}"))
            case _:
                folder = rng.choice(sorted({p.parent for p in files if p.parent != path} or {path / "depth"}))
                if folder.is_dir():
                    folder.rename(folder.with_name(rng.choice(["Depth16", "left", "RGB", "depth_maps", "old"])))
    return sum(_is_depth(p) for p in path.rglob("*.png")), len(list(path.glob("*poses*"))) + len(
        list(path.glob("traj*"))
    )


def _is_depth(path: Path) -> bool:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image is not None and image.dtype == np.uint16


@pytest.mark.parametrize("seed", range(40))
def test_a_folder_in_disorder_is_read_whole_or_refused_in_one_line(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    deep, posed = mess(rng, tmp_path / "walk")
    try:
        source = open_source(tmp_path / "walk", MM)
    except List3rError as error:
        assert "\n" not in str(error) and 20 < len(str(error)) < 600, error
        return
    info, said = source.info, told(source)
    assert info.has_depth == (deep > 0) or "depth" in said, said
    assert info.has_poses == (posed > 0) or "pose" in said, said
    lines = SourceReport(info, None, None, unusable(source), depth_doubts(source), disagreements(source)).lines()
    bad = sum(isinstance(f, BadFrame) for f in source.read(0, info.frame_count))
    assert not bad or any(f"{bad} of {info.frame_count} frames cannot be used" in line for line in lines), lines


@pytest.mark.parametrize("per_s", [1, 10**3, 10**6, 10**9])
@pytest.mark.parametrize("begin_s", [40, 50_000, 1_700_000_000])
def test_stamps_of_any_unit_are_seconds(per_s: int, begin_s: int) -> None:
    if per_s == 1000 and begin_s < 1e6:
        pytest.skip("milliseconds from elsewhere may be seconds")
    true_s = begin_s + np.arange(20) / 30
    assert np.allclose(as_seconds(true_s * per_s), true_s, rtol=1e-9)


def test_a_camera_that_is_given_stands_for_a_file_without_one(tmp_path: Path) -> None:
    path = write(tmp_path / "walk", lambda k: f"rgb/{k}.jpg", lambda k: f"depth/{k}.png")
    put(path / "intrinsic.json", "{}")
    info = open_source(path, SourceOptions(intrinsics=K, depth_scale=1000.0)).info
    assert info.camera is not None and any("not read: intrinsic.json" in note for note in info.notes)

"""Writers of data sets of robots, of the same wall as `tests.recordings`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.recordings import COUNT, HEIGHT, WIDTH, K, jpeg, plane_depth, put, shots

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
DEPTH = f"{FRONT}_depth"
BEFORE = 3
"""Frames of the episode before the one of the wall, in the same file."""
FPS = 30
CODE = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}


def write_lerobot(root: Path, *, wrist: bool = True, coded: bool = True, **changes: object) -> Path:
    """A data set of two episodes in one file, the second of the wall; depth coded in 12 bits, or 16 of millimetres."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    pictures = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * BEFORE + [s.color for s in shots()]
    depths = [plane_depth(s.T_world_cam, K, (HEIGHT, WIDTH)) for s in shots()]
    far = [np.zeros((HEIGHT, WIDTH), np.float32)] * BEFORE
    keys = [FRONT, WRIST, DEPTH] if wrist else [FRONT, DEPTH]
    for key in keys:
        path = root / f"videos/{key}/chunk-000/file-000.mp4"
        path.parent.mkdir(parents=True)
        if key == DEPTH:
            write_depth_video(path, [*far, *depths], coded=coded)
        else:
            write_video(path, pictures)
    about = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "info": {"video.fps": FPS}}
    features: dict[str, object] = {key: about for key in keys}
    features[DEPTH] = {"dtype": "video", "info": {"is_depth_map": True, **(CODE if coded else {})}}
    features |= {"observation.state": {"dtype": "float32", "shape": [6]}, "timestamp": {"dtype": "float32"}}
    info = {"codebase_version": "v3.0", "fps": FPS, "total_episodes": 2, "features": features}
    put(root / "meta/info.json", json.dumps(info | changes))
    columns: dict[str, list[float]] = {"episode_index": [0, 1], "length": [BEFORE, COUNT]}
    for key in keys:
        columns |= {f"videos/{key}/chunk_index": [0, 0], f"videos/{key}/file_index": [0, 0]}
        columns |= {f"videos/{key}/from_timestamp": [0.0, BEFORE / FPS]}
    table = root / "meta/episodes/chunk-000/file-000.parquet"
    table.parent.mkdir(parents=True)
    pq.write_table(pa.table(columns), table)
    return root


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]]) -> None:
    """Write pictures of WIDTH x HEIGHT."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())


def write_depth_video(path: Path, depths: Iterable[NDArray[np.float32]], *, coded: bool) -> None:
    """Write depth without loss: codes of 12 bits over the logarithm, or millimetres in 16 bits."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray12le" if coded else "gray16le"
        low, high = np.log(CODE["video.depth_min"] + 3.5), np.log(CODE["video.depth_max"] + 3.5)
        for depth in depths:
            share = (np.log(depth + 3.5) - low) / (high - low)
            stored = np.rint(4095 * share.clip(0, 1)) if coded else np.rint(1000 * depth)
            image = av.VideoFrame(WIDTH, HEIGHT, stream.pix_fmt)
            plane = image.planes[0]
            rows = np.zeros((plane.buffer_size // plane.line_size, plane.line_size // 2), "<u2")
            rows[:HEIGHT, :WIDTH] = stored
            plane.update(rows.tobytes())
            container.mux(stream.encode(image))
        container.mux(stream.encode())


T_RIG_SIDE = np.eye(4)
"""Place of the second camera of a rig in the first: half a metre to the right, turned to the left."""
T_RIG_SIDE[:3, :3] = Rotation.from_euler("y", -20, degrees=True).as_matrix()
T_RIG_SIDE[:3, 3] = 0.5, 0.0, 0.1
SIDE_K = (130.0, 130.0, 78.0, 60.0)


def write_colmap_rig(root: Path, *, binary: bool = True) -> Path:
    """A model of two cameras on one rig: `K/front.jpg` of the wall's shots, `K/side.jpg` of the second camera."""
    import pycolmap as pc

    model = pc.Reconstruction()
    for number, k in ((1, K), (2, SIDE_K)):
        values = [k[0], k[1], k[2] + 0.5, k[3] + 0.5]
        model.add_camera(pc.Camera(camera_id=number, model="PINHOLE", width=WIDTH, height=HEIGHT, params=values))
    rig = pc.Rig(rig_id=1)
    sensors = [pc.sensor_t(type=pc.SensorType.CAMERA, id=number) for number in (1, 2)]
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pc.Rigid3d(np.linalg.inv(T_RIG_SIDE)[:3]))
    model.add_rig(rig)
    for k, shot in enumerate(shots()):
        frame = pc.Frame(frame_id=k + 1, rig_id=1)
        frame.rig_from_world = pc.Rigid3d(np.linalg.inv(shot.T_world_cam)[:3])
        images = [
            pc.Image(name=f"{n}/{k:04d}.jpg", camera_id=i, image_id=10 * k + i) for i, n in ((1, "front"), (2, "side"))
        ]
        for image in images:
            image.frame_id = frame.frame_id
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
            put(root / "images" / image.name, jpeg(shot.color))
        model.register_frame(frame.frame_id)
    (root / "sparse/0").mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(root / "sparse/0"))
    return root

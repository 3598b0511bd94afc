"""Writers of recordings as phones and tools make them, of one small scene whose geometry is known."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
WIDTH, HEIGHT, DEPTH_WIDTH, DEPTH_HEIGHT = 160, 120, 64, 48
K = (140.0, 140.0, 79.5, 59.5)
PLANE = np.array([0.1, -0.2, 0.97, 2.0])
"""Normal and distance of the wall that all frames see, z-up world, metres."""
COUNT = 4


@dataclass(frozen=True)
class Shot:
    """A frame of the scene."""

    T_world_cam: Array
    """OpenCV axes, z-up world. Shape (4, 4)."""
    color: NDArray[np.uint8]
    """RGB. Shape (HEIGHT, WIDTH, 3)."""
    depth: NDArray[np.float32]
    """Metres at DEPTH_WIDTH x DEPTH_HEIGHT. Shape (DEPTH_HEIGHT, DEPTH_WIDTH)."""


def shots() -> list[Shot]:
    """Frames of a tilted wall from cameras that turn and move."""
    rng = np.random.default_rng(5)
    out = []
    for k in range(COUNT):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [10 * k - 15, 8 * k - 12, 5 * k], degrees=True).as_matrix()
        T[:3, 3] = 0.1 * k, -0.05 * k, 0.03 * k
        color = cv2.resize(rng.integers(0, 255, (30, 40, 3), np.uint8), (WIDTH, HEIGHT))
        out.append(Shot(T, np.asarray(color, np.uint8), plane_depth(T, K, (DEPTH_HEIGHT, DEPTH_WIDTH))))
    return out


def plane_depth(T_world_cam: Array, camera: tuple[float, ...], size: tuple[int, int]) -> NDArray[np.float32]:
    """Depth of the wall at a size, for a camera stated for WIDTH x HEIGHT. Shape `size`."""
    x, y = WIDTH / size[1], HEIGHT / size[0]
    u = (np.arange(size[1]) + 0.5) * x - 0.5
    v = (np.arange(size[0]) + 0.5) * y - 0.5
    rays = np.stack(np.broadcast_arrays((u - camera[2]) / camera[0], ((v - camera[3]) / camera[1])[:, None], 1.0), -1)
    normal = PLANE[:3] / np.linalg.norm(PLANE[:3])
    turned = rays @ T_world_cam[:3, :3].T
    return np.asarray((PLANE[3] - T_world_cam[:3, 3] @ normal) / (turned @ normal), np.float32)


def off_plane(points: Array) -> Array:
    """Distance of world points from the wall, metres. Shape (N,)."""
    return np.asarray(np.abs(points @ (PLANE[:3] / np.linalg.norm(PLANE[:3])) - PLANE[3]))


def arkit(T_world_cam: Array) -> Array:
    """The pose as ARKit has it: world with y up, camera with x right, y up, z back."""
    y_up_from_z_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return np.asarray(y_up_from_z_up @ T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0]))


def millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.rint(1000 * depth).astype(np.uint16)


def jpeg(color: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 98])[1])


def png(image: NDArray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


def put(path: Path, data: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def write_record3d(root: Path, *, left: int = 2, **changes: object) -> Path:
    """An .r3d file; the left half of depth has the confidence `left`."""
    import lzfse

    poses = []
    members: dict[str, bytes] = {}
    confidence = np.full((DEPTH_HEIGHT, DEPTH_WIDTH), 2, np.uint8)
    confidence[:, : DEPTH_WIDTH // 2] = left
    for k, shot in enumerate(shots()):
        T = arkit(shot.T_world_cam)
        poses.append([*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]])
        members[f"rgbd/{k}.jpg"] = jpeg(shot.color)
        members[f"rgbd/{k}.depth"] = lzfse.compress(shot.depth.astype("<f4").tobytes())
        members[f"rgbd/{k}.conf"] = lzfse.compress(confidence.tobytes())
    meta = {"w": WIDTH, "h": HEIGHT, "dw": DEPTH_WIDTH, "dh": DEPTH_HEIGHT, "fps": 30, "poses": poses}
    meta |= {"K": [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1], "frameTimestamps": [10 + k / 30 for k in range(COUNT)]}
    members["metadata"] = json.dumps(meta | changes).encode()
    path = root / "walk.r3d"
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def write_stray(root: Path) -> Path:
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    y_up_from_z_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    root.mkdir(parents=True, exist_ok=True)
    with av.open(str(root / "rgb.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k, shot in enumerate(shots()):
            T = y_up_from_z_up @ shot.T_world_cam
            numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
            rows.append(", ".join([f"{100 + k / 30:.6f}", f"{k:06d}", *(f"{v:.9f}" for v in numbers)]))
            put(root / "depth" / f"{k:06d}.png", png(millimetres(shot.depth)))
            put(root / "confidence" / f"{k:06d}.png", png(np.full((DEPTH_HEIGHT, DEPTH_WIDTH), 2, np.uint8)))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shot.color, "rgb24")))
        container.mux(stream.encode())
    put(root / "odometry.csv", "\n".join(rows) + "\n")
    put(root / "camera_matrix.csv", f"{K[0]}, 0.0, {K[2]}\n0.0, {K[1]}, {K[3]}\n0.0, 0.0, 1.0\n")
    return root


def write_scannetpp(root: Path, *, packed: str = "lz4") -> Path:
    """Whole millimetres packed with LZ4, or float metres with deflate; depth of 256 x 192."""
    import lz4.block

    rows, depth = {}, b""
    base = root / "iphone"
    base.mkdir(parents=True, exist_ok=True)
    with av.open(str(base / "rgb.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k, shot in enumerate(shots()):
            z = plane_depth(shot.T_world_cam, K, (192, 256))
            if packed == "lz4":
                data = lz4.block.compress(millimetres(z).tobytes(), store_size=False)
            else:
                pack = zlib.compressobj(wbits=-zlib.MAX_WBITS)
                data = pack.compress(z.astype("<f4").tobytes()) + pack.flush()
            depth += len(data).to_bytes(4, "little") + data
            pose = shot.T_world_cam.tolist()
            rows[f"frame_{k:06d}"] = {"intrinsic": matrix(K)[:3, :3].tolist(), "pose": pose, "aligned_pose": pose}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shot.color, "rgb24")))
        container.mux(stream.encode())
    put(base / "depth.bin", depth)
    put(base / "pose_intrinsic_imu.json", json.dumps(rows))
    return root


def write_polycam(root: Path) -> Path:
    for k, shot in enumerate(shots()):
        T, name = arkit(shot.T_world_cam), f"{5_000_000 + 33_333 * k}"
        camera = {"fx": K[0], "fy": K[1], "cx": K[2], "cy": K[3], "width": WIDTH, "height": HEIGHT}
        camera |= {f"t_{r}{c}": T[r, c] for r in range(3) for c in range(4)}
        put(root / f"keyframes/cameras/{name}.json", json.dumps(camera))
        put(root / f"keyframes/images/{name}.jpg", jpeg(shot.color))
        put(root / f"keyframes/depth/{name}.png", png(millimetres(shot.depth)))
        put(root / f"keyframes/confidence/{name}.png", png(np.full(shot.depth.shape, 255, np.uint8)))
    return root


def write_scannerapp(root: Path) -> Path:
    for k, shot in enumerate(shots()):
        table = {"intrinsics": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1], "time": 5 + k / 10, "frame_index": k}
        table["cameraPoseARFrame"] = arkit(shot.T_world_cam).ravel().tolist()
        put(root / f"frame_{k:05d}.json", json.dumps(table))
        put(root / f"frame_{k:05d}.jpg", jpeg(shot.color))
        put(root / f"depth_{k:05d}.png", png(millimetres(shot.depth)))
        put(root / f"conf_{k:05d}.png", png(np.full(shot.depth.shape, 2, np.uint8)))
    return root


def write_record3d_exr(root: Path) -> Path:
    """An export "EXR + JPG"."""
    poses = []
    for k, shot in enumerate(shots()):
        T = arkit(shot.T_world_cam)
        poses.append([*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]])
        put(root / f"rgb/{k}.jpg", jpeg(shot.color))
        put(root / f"depth/{k}.exr", exr(shot.depth))
    meta = {"w": WIDTH, "h": HEIGHT, "dw": DEPTH_WIDTH, "dh": DEPTH_HEIGHT, "fps": 30, "poses": poses}
    put(root / "metadata.json", json.dumps(meta | {"K": [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]}))
    return root


def exr(depth: NDArray[np.float32], packing: int = 3) -> bytes:
    """An OpenEXR file of the channel R, by scan lines: 0 as it is, 3 zip of 16 lines."""
    height, width = depth.shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = b"R\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0"
    head = b"v/1\x01" + struct.pack("<I", 2)
    for name, kind, value in (
        (b"channels", b"chlist", channel), (b"compression", b"compression", bytes([packing])),
        (b"dataWindow", b"box2i", box), (b"displayWindow", b"box2i", box), (b"lineOrder", b"lineOrder", b"\0"),
    ):  # fmt: skip
        head += name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value
    lines = 16 if packing == 3 else 1
    blocks = []
    for top in range(0, height, lines):
        raw = np.frombuffer(depth[top : top + lines].astype("<f4").tobytes(), np.uint8)
        if packing == 3:
            mixed = np.concatenate([raw[::2], raw[1::2]]).astype(np.int64)
            steps = np.append(mixed[0], np.diff(mixed) + 128)
            packed = zlib.compress(steps.astype(np.uint8).tobytes())
            raw = raw if len(packed) >= len(raw) else np.frombuffer(packed, np.uint8)
        blocks.append(struct.pack("<iI", top, len(raw)) + raw.tobytes())
    start = len(head) + 1 + 8 * len(blocks)
    places = np.cumsum([start, *(len(b) for b in blocks[:-1])])
    return head + b"\0" + places.astype("<u8").tobytes() + b"".join(blocks)


def write_arkitscenes(root: Path) -> Path:
    rows = []
    for k, shot in enumerate(shots()):
        time, T = 20.0 + k / 10, np.linalg.inv(shot.T_world_cam)
        small = cv2.resize(shot.color, (DEPTH_WIDTH, DEPTH_HEIGHT))
        x, y = DEPTH_WIDTH / WIDTH, DEPTH_HEIGHT / HEIGHT
        camera = (K[0] * x, K[1] * y, (K[2] + 0.5) * x - 0.5, (K[3] + 0.5) * y - 0.5)
        name = f"40_{time:.3f}"
        rows.append(" ".join(f"{v:.9f}" for v in (time, *Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3])))
        put(root / f"lowres_wide/{name}.png", png(cv2.cvtColor(small, cv2.COLOR_RGB2BGR)))
        put(root / f"lowres_depth/{name}.png", png(millimetres(shot.depth)))
        put(root / f"confidence/{name}.png", png(np.full(shot.depth.shape, 2, np.uint8)))
        pincam = " ".join(f"{v:.6f}" for v in (DEPTH_WIDTH, DEPTH_HEIGHT, *camera))
        put(root / f"lowres_wide_intrinsics/{name}.pincam", pincam)
    put(root / "lowres_wide.traj", "\n".join(rows))
    return root


def write_nerfstudio(root: Path, **changes: object) -> Path:
    frames = []
    for k, shot in enumerate(shots()):
        put(root / f"images/frame_{k + 1:05d}.jpg", jpeg(shot.color))
        put(root / f"depth/frame_{k + 1:05d}.png", png(millimetres(shot.depth)))
        T = shot.T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        names = {"file_path": f"images/frame_{k + 1:05d}.jpg", "depth_file_path": f"depth/frame_{k + 1:05d}.png"}
        frames.append(names | {"transform_matrix": T.tolist()})
    camera = {"fl_x": K[0], "fl_y": K[1], "cx": K[2], "cy": K[3], "w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV"}
    put(root / "transforms.json", json.dumps(camera | {"frames": frames} | changes))
    return root


def write_scannet(root: Path) -> Path:
    x, y = DEPTH_WIDTH / WIDTH, DEPTH_HEIGHT / HEIGHT
    depth_k = (K[0] * x, K[1] * y, (K[2] + 0.5) * x - 0.5, (K[3] + 0.5) * y - 0.5)
    for k, shot in enumerate(shots()):
        put(root / f"color/{k}.jpg", jpeg(shot.color))
        put(root / f"depth/{k}.png", png(millimetres(shot.depth)))
        put(root / f"pose/{k}.txt", "\n".join(" ".join(f"{v:.9f}" for v in row) for row in shot.T_world_cam))
    for name, camera in (("color", K), ("depth", depth_k)):
        text = "\n".join(" ".join(f"{v:.9f}" for v in row) for row in matrix(camera))
        put(root / f"intrinsic/intrinsic_{name}.txt", text)
        put(root / f"intrinsic/extrinsic_{name}.txt", "\n".join(" ".join(map(str, row)) for row in np.eye(4)))
    return root


def write_sens(root: Path, *, lost: int | None = None) -> Path:
    x, y = DEPTH_WIDTH / WIDTH, DEPTH_HEIGHT / HEIGHT
    depth_k = (K[0] * x, K[1] * y, (K[2] + 0.5) * x - 0.5, (K[3] + 0.5) * y - 0.5)
    out = struct.pack("<IQ4s", 4, 4, b"scan")
    for m in (matrix(K), np.eye(4), matrix(depth_k), np.eye(4)):
        out += m.astype("<f4").tobytes()
    out += struct.pack("<iiIIIIfQ", 2, 1, WIDTH, HEIGHT, DEPTH_WIDTH, DEPTH_HEIGHT, 1000.0, COUNT)
    for k, shot in enumerate(shots()):
        color, depth = jpeg(shot.color), zlib.compress(millimetres(shot.depth).tobytes())
        pose = np.full((4, 4), -np.inf) if k == lost else shot.T_world_cam
        stamp = 1_000_000 + 33_333 * k
        out += pose.astype("<f4").tobytes() + struct.pack("<QQQQ", stamp, stamp, len(color), len(depth)) + color + depth
    put(root / "scene.sens", out)
    return root / "scene.sens"


def write_colmap(root: Path, *, binary: bool = False) -> Path:
    """Text or binary model; lengths three times as long, as in a model of its own unit."""
    images = []
    for k, shot in enumerate(shots()):
        put(root / f"images/{k:04d}.jpg", jpeg(shot.color))
        T = np.linalg.inv(shot.T_world_cam)
        q = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
        numbers = " ".join(f"{v:.9f}" for v in (*q, *(3 * T[:3, 3])))
        images.append(f"{k + 1} {numbers} 1 {k:04d}.jpg\n\n")
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {K[0]} {K[1]} {K[2] + 0.5} {K[3] + 0.5}\n"
    put(root / "sparse/0/cameras.txt", camera)
    put(root / "sparse/0/images.txt", "".join(images))
    put(root / "sparse/0/points3D.txt", "")
    if binary:
        from pycolmap import Reconstruction

        Reconstruction(str(root / "sparse/0")).write_binary(str(root / "sparse/0"))
        for name in ("cameras", "images", "points3D", "rigs", "frames"):
            (root / f"sparse/0/{name}.txt").unlink(missing_ok=True)
    return root


def matrix(camera: tuple[float, ...]) -> Array:
    out = np.eye(4)
    out[0, 0], out[1, 1], out[0, 2], out[1, 2] = camera
    return out


WITH_DEPTH: dict[str, Callable[[Path], Path]] = {
    "record3d": write_record3d,
    "stray": write_stray,
    "scannetpp": write_scannetpp,
    "polycam": write_polycam,
    "arkitscenes": write_arkitscenes,
    "nerfstudio": write_nerfstudio,
    "scannet": write_scannet,
    "sens": write_sens,
}


def write_bag(
    root: Path,
    kind: str = "mcap",
    *,
    registered: bool = False,
    odometry: bool = False,
    chunk_bytes: int = 1 << 20,
    packed: str = "",
) -> Path:
    """A recording of ROS 1 ("bag") or ROS 2 ("mcap", "db3"): colour, compressed depth, cameras, `/tf`, interleaved,
    in chunks (but of a db3) of so many bytes, `packed` as rosbags names it: "lz4" and "bz2" of ROS 1; of ROS 2, by
    zstd, "storage" (mcap), "message" or "file".

    The depth camera stands 2 cm beside the colour camera unless depth is registered; the robot carries both.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    root.parent.mkdir(parents=True, exist_ok=True)
    path = root.with_suffix(".bag") if kind == "bag" else root
    with _bag_writer(path, kind, packed) as writer:
        writer.chunk_threshold = chunk_bytes
        put_ = _Put(writer, store, ros1=kind == "bag")
        for message in _messages(put_, registered=registered, odometry=odometry):
            put_(*message)
    return path


def _bag_writer(path: Path, kind: str, packed: str) -> object:
    if kind == "bag":
        from rosbags.rosbag1 import Writer as Writer1

        first = Writer1(path)
        if packed:
            first.set_compression(Writer1.CompressionFormat[packed.upper()])
        return first
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if packed:
        writer.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
    return writer


class _Put:
    """Writes messages to topics that it opens as they come."""

    def __init__(self, writer: object, store: object, *, ros1: bool) -> None:
        self._writer, self.store, self._ros1, self._open = writer, store, ros1, {}

    def __call__(self, topic: str, kind: str, time_s: float, message: object) -> None:
        if topic not in self._open:
            self._open[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        self._writer.write(self._open[topic], int(1e9 * time_s), pack(message, kind))
        storage = getattr(self._writer, "storage", None)
        if hasattr(storage, "close_chunk") and storage.chunk.bio.tell() > self._writer.chunk_threshold:
            storage.close_chunk()  # rosbags has one length for all

    def make(self, kind: str, **fields: object) -> object:
        if self._ros1 and kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        if self._ros1 and kind == "sensor_msgs/msg/CameraInfo":
            fields = {name.upper() if name in ("d", "k", "r", "p") else name: value for name, value in fields.items()}
        return self.store.types[kind](**fields)

    def header(self, time_s: float, frame: str) -> object:
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(time_s), nanosec=round(1e9 * (time_s % 1)))
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


SIDE_M = 0.02
"""The depth camera's place to the right of the colour camera."""


def _messages(put_: _Put, *, registered: bool, odometry: bool) -> Iterator[tuple[str, str, float, object]]:
    T_base_color = np.eye(4)
    T_base_color[:3, :3] = Rotation.from_euler("xyz", [-90, 0, -90], degrees=True).as_matrix()
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.0 if registered else SIDE_M
    static = [("base", "color_optical", T_base_color), ("color_optical", "depth_optical", T_color_depth)]
    yield "/tf_static", "tf2_msgs/msg/TFMessage", 50.0, _tf(put_, 50.0, static)
    depth_frame = "color_optical" if registered else "depth_optical"
    size = (HEIGHT, WIDTH) if registered else (DEPTH_HEIGHT, DEPTH_WIDTH)
    for k, shot in enumerate(shots()):
        time = 51.0 + 0.1 * k
        T_world_base = shot.T_world_cam @ np.linalg.inv(T_base_color)
        if odometry:
            yield "/odom", "nav_msgs/msg/Odometry", time, _odometry(put_, time, T_world_base)
        else:
            yield "/tf", "tf2_msgs/msg/TFMessage", time, _tf(put_, time, [("map", "base", T_world_base)])
        color = np.ascontiguousarray(shot.color)
        pixels = put_.make(
            "sensor_msgs/msg/Image", header=put_.header(time, "color_optical"), height=HEIGHT, width=WIDTH,
            encoding="rgb8", is_bigendian=0, step=3 * WIDTH, data=color.ravel(),
        )  # fmt: skip
        yield "/camera/color/image_raw", "sensor_msgs/msg/Image", time + 0.01, pixels
        depth = millimetres(plane_depth(shot.T_world_cam @ T_color_depth, K, size))
        packed = np.frombuffer(bytes(12) + png(depth), np.uint8)
        small = put_.make(
            "sensor_msgs/msg/CompressedImage", header=put_.header(time + 0.004, depth_frame),
            format="16UC1; compressedDepth png", data=packed,
        )  # fmt: skip
        yield "/camera/depth/image_raw/compressedDepth", "sensor_msgs/msg/CompressedImage", time + 0.02, small
        for name, frame, shape in (("color", "color_optical", (HEIGHT, WIDTH)), ("depth", depth_frame, size)):
            info = _camera_info(put_, time, frame, shape)
            yield f"/camera/{name}/camera_info", "sensor_msgs/msg/CameraInfo", time + 0.02, info


def _tf(put_: _Put, time_s: float, links: list[tuple[str, str, Array]]) -> object:
    out = []
    for parent, child, T in links:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        out.append(
            put_.make(
                "geometry_msgs/msg/TransformStamped",
                header=put_.header(time_s, parent),
                child_frame_id=child,
                transform=put_.make(
                    "geometry_msgs/msg/Transform",
                    translation=put_.make("geometry_msgs/msg/Vector3", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
                    rotation=put_.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
                ),
            )
        )
    return put_.make("tf2_msgs/msg/TFMessage", transforms=out)


def _odometry(put_: _Put, time_s: float, T: Array) -> object:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    pose = put_.make(
        "geometry_msgs/msg/Pose", position=put_.make("geometry_msgs/msg/Point", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
        orientation=put_.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )  # fmt: skip
    zero = put_.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = put_.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    unknown = np.zeros(36)
    return put_.make(
        "nav_msgs/msg/Odometry", header=put_.header(time_s, "odom"), child_frame_id="base",
        pose=put_.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
        twist=put_.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
    )  # fmt: skip


def _camera_info(put_: _Put, time_s: float, frame: str, size: tuple[int, int]) -> object:
    x, y = size[1] / WIDTH, size[0] / HEIGHT
    k = matrix((K[0] * x, K[1] * y, (K[2] + 0.5) * x - 0.5, (K[3] + 0.5) * y - 0.5))
    roi = put_.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return put_.make(
        "sensor_msgs/msg/CameraInfo", header=put_.header(time_s, frame), height=size[0], width=size[1],
        distortion_model="plumb_bob", d=np.zeros(5), k=k[:3, :3].ravel(), r=np.eye(3).ravel(),
        p=k[:3, :4].ravel(), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def write_euroc(root: Path) -> Path:
    """Grey pictures of one camera that is turned on its body; ground truth of the body every 5 ms."""
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    T_body_cam[:3, 3] = 0.05, -0.02, 0.01
    listing, truth = ["#timestamp [ns],filename"], ["#timestamp, p, q wxyz, v"]
    for k, shot in enumerate(shots()):
        stamp = 1_403_636_579_763_555_584 + 50_000_000 * k
        listing.append(f"{stamp},{stamp}.png")
        put(root / f"mav0/cam0/data/{stamp}.png", png(cv2.cvtColor(shot.color, cv2.COLOR_RGB2GRAY)))
        T = shot.T_world_cam @ np.linalg.inv(T_body_cam)
        q = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
        truth.append(",".join([str(stamp), *(f"{v:.9f}" for v in (*T[:3, 3], *q)), "0", "0", "0"]))
    put(root / "mav0/cam0/data.csv", "\n".join(listing))
    put(root / "mav0/state_groundtruth_estimate0/data.csv", "\n".join(truth))
    rows = ",\n         ".join(", ".join(f"{v:.9f}" for v in row) for row in T_body_cam)
    put(
        root / "mav0/cam0/sensor.yaml",
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\nrate_hz: 20\n"
        f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [{', '.join(map(str, K))}]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
    )
    return root

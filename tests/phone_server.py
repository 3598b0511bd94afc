"""A usbmuxd with an iPhone that streams as Record3D does, on a socket of its own."""

from __future__ import annotations

import plistlib
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.live.usbmux import ADDRESS
from tests.recordings import Array, arkit, jpeg

PORT = 1337
LIDAR, FRONT = 1, 0
SERIAL = "00008101-AB"


def message(
    color: Array,
    depth: Array,
    T_world_cam: Array,
    K: Sequence[float],
    *,
    confidence: Array | None = None,
    device: int = LIDAR,
    packed_depth: bytes | None = None,
) -> bytes:
    """One frame as the app sends it; `packed_depth` stands in the place of the depth."""
    import lzfse

    sure = np.full(depth.shape, 2, np.uint8) if confidence is None else confidence
    parts = jpeg(color), packed_depth or lzfse.compress(depth.astype("<f4").tobytes()), lzfse.compress(sure.tobytes())
    sizes = [s for image in (color, depth, sure) for s in (image.shape[1], image.shape[0])]
    T = arkit(T_world_cam)
    body = struct.pack("<11I", *sizes, *map(len, parts), 0, device)
    body += struct.pack("<11f", *K, *Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3])
    body += b"".join(parts)
    return struct.pack(">4I", 1, 101, 0, len(body)) + body


@contextmanager
def usbmuxd(
    connections: Sequence[Sequence[bytes]],
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    *,
    serials: Sequence[str] = (SERIAL,),
    pause_s: float = 0.005,
) -> Iterator[None]:
    """Serve what the phone sends over one connection after the other; then the app does not stream any more."""
    path, scripts, over = folder / "mux", iter(connections), threading.Event()
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.listen()
    monkeypatch.setenv(ADDRESS, f"UNIX:{path}")

    def serve() -> None:
        while True:
            client, _ = server.accept()
            with client, suppress(ConnectionError):
                if over.is_set():
                    return
                _talk(client, scripts, serials, pause_s)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        over.set()
        with socket.socket(socket.AF_UNIX) as last:
            last.connect(str(path))
        thread.join()
        server.close()


def _talk(client: socket.socket, scripts: Iterator[Sequence[bytes]], serials: Sequence[str], pause_s: float) -> None:
    while head := client.recv(16, socket.MSG_WAITALL):
        length, version, kind, tag = struct.unpack("<4I", head)
        assert (version, kind) == (1, 8)
        asked = plistlib.loads(client.recv(length - 16, socket.MSG_WAITALL))
        if asked["MessageType"] == "ListDevices":
            _answer(client, tag, {"DeviceList": [_device(k, serial) for k, serial in enumerate(serials, start=4)]})
            continue
        assert asked["MessageType"] == "Connect" and socket.ntohs(asked["PortNumber"]) == PORT
        sent = next(scripts, None)
        _answer(client, tag, {"MessageType": "Result", "Number": 3 if sent is None else 0})
        for data in sent or ():
            client.sendall(data)
            time.sleep(pause_s)
        return


def _device(number: int, serial: str) -> dict[str, object]:
    properties = {"ConnectionType": "USB", "DeviceID": number, "SerialNumber": serial, "ProductID": 4776}
    return {"DeviceID": number, "MessageType": "Attached", "Properties": properties}


def _answer(client: socket.socket, tag: int, said: dict[str, object]) -> None:
    body = plistlib.dumps(said)
    client.sendall(struct.pack("<4I", 16 + len(body), 1, 8, tag) + body)

"""Whether binary files of a model of COLMAP are whole.

Of one that was cut off pycolmap reads what is missing as nonsense: a wrong camera or place on a rig, or a number of
pictures that takes minutes to count to.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from list3r.frames.files import read_file

_POSE = 56
"""Bytes of a quaternion and a translation."""


def frames_are_whole(path: Path) -> bool:
    """Return whether a file of frames holds as much as it says, or is not there. Raises `OSError`."""
    if not path.is_file():
        return True
    data = read_file(path)
    if len(data) < 8:
        return False
    at = 8
    for _ in range(int.from_bytes(data[:8], "little")):
        at += 8 + _POSE  # its number, its rig's and its pose, before the pictures are counted
        if at + 4 > len(data):
            return False
        at += 4 + 16 * struct.unpack_from("<I", data, at)[0]
    return at == len(data)


def written_sizes(found: Any) -> dict[str, int]:
    """Return how many bytes the files of cameras and rigs have that hold a `pycolmap.Reconstruction`, by name."""
    cameras = 8 + sum(24 + 8 * len(camera.params) for camera in found.cameras.values())
    rigs = 8
    for rig in found.rigs.values():
        others = [s for s in rig.sensor_ids() if s != rig.ref_sensor_id]
        rigs += 8 + 8 * bool(rig.num_sensors()) + sum(9 + _POSE * rig.has_sensor_from_rig(s) for s in others)
    return {"cameras.bin": cameras, "rigs.bin": rigs}

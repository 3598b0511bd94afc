"""Transforms of a robot recording (`/tf`, `/tf_static`, odometry): where a camera was at given times."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.readers.tum import poses_at
from list3r.frames.recordings.axes import pose_of_quaternion

Array = NDArray[np.float64]
WORLDS = ("map", "world", "odom", "vicon", "mocap")
"""Frames of reference in which a camera is placed, the most lasting first."""
DRIFTING = "odom"
"""The one in which poses drift, by its definition (REP 105)."""
_LONGEST_CHAIN = 64


@dataclass
class TransformTree:
    """Every frame with its parent: fixed, or by rows of time, translation and quaternion xyzw."""

    parents: dict[str, str] = field(default_factory=dict)
    fixed: dict[str, Array] = field(default_factory=dict)
    """T_parent_child by child. Shape (4, 4)."""
    moving: dict[str, list[list[float]]] = field(default_factory=lambda: defaultdict(list))
    """Rows of 8 numbers by child."""

    def add(self, message: Any, *, fixed: bool) -> None:
        """Take in a TFMessage."""
        for stamped in message.transforms:
            t, q = stamped.transform.translation, stamped.transform.rotation
            parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
            self._put(parent, child, stamped.header.stamp, (t.x, t.y, t.z, q.x, q.y, q.z, q.w), fixed=fixed)

    def add_pose(self, message: Any, child: str) -> None:
        """Take in an Odometry or PoseStamped message; `child` is moved where the message does not say what is."""
        pose = getattr(message.pose, "pose", message.pose)
        t, q = pose.position, pose.orientation
        moved = _name(getattr(message, "child_frame_id", "") or child)
        numbers = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
        self._put(_name(message.header.frame_id) or "world", moved, message.header.stamp, numbers, fixed=False)

    def _put(self, parent: str, child: str, stamp: Any, numbers: tuple[float, ...], *, fixed: bool) -> None:
        T = pose_of_quaternion(numbers[:3], numbers[3:])
        if T is None or parent == child:
            return
        self.parents[child] = parent
        if fixed:
            self.fixed[child] = T
        else:
            self.moving[child].append([stamp.sec + 1e-9 * stamp.nanosec, *numbers])

    def rename(self, child: str, name: str) -> None:
        """Give a frame another name, unless something has that name already."""
        if child in self.parents and _name(name) not in self.parents:
            self.parents[_name(name)] = self.parents.pop(child)
            self.moving[_name(name)] = self.moving.pop(child)

    def world_of(self, frame: str) -> str | None:
        """Return the frame of reference that a frame moves in: one of `WORLDS`, else the root.

        None where nothing moves it.
        """
        chain = self._up(_name(frame))
        if not any(child in self.moving for child in chain[:-1]):
            return None
        return next((w for w in WORLDS if w in chain), chain[-1])

    def poses(self, frame: str, world: str, times_s: Array) -> list[Array | None]:
        """T_world_frame at times; None where a link of the way is not known then. Shapes (N,) -> N of (4, 4)."""
        out: list[Array | None] = [np.eye(4)] * len(times_s)
        for child in self._up(_name(frame)):
            if child == world:
                break
            links = self._link(child, times_s)
            out = [None if T is None or step is None else step @ T for T, step in zip(out, links, strict=True)]
        return out

    def between(self, a: str, b: str) -> Array | None:
        """T_a_b of two frames that do not move against each other, None where no fixed way is known."""
        chain_a, chain_b = self._up(_name(a)), self._up(_name(b))
        common = next((f for f in chain_a if f in chain_b), None)
        if common is None:
            return None
        T_common_a, T_common_b = self._fixed_to(chain_a, common), self._fixed_to(chain_b, common)
        if T_common_a is None or T_common_b is None:
            return None
        return np.asarray(np.linalg.inv(T_common_a) @ T_common_b)

    def _fixed_to(self, chain: list[str], top: str) -> Array | None:
        T = np.eye(4)
        for child in chain[: chain.index(top)]:
            if child not in self.fixed:
                return None
            T = self.fixed[child] @ T
        return T

    def _link(self, child: str, times_s: Array) -> list[Array | None]:
        if child not in self.moving:
            return [self.fixed.get(child)] * len(times_s)
        table = np.array(self.moving[child])
        table = table[np.argsort(table[:, 0], kind="stable")]
        return poses_at(times_s, table[:, 0], table[:, 1:])

    def _up(self, frame: str) -> list[str]:
        """Return a frame and its parents up to the root; a circle ends where it closes."""
        chain = [frame]
        while chain[-1] in self.parents and len(chain) < _LONGEST_CHAIN and self.parents[chain[-1]] not in chain:
            chain.append(self.parents[chain[-1]])
        return chain


def _name(frame: str) -> str:
    return frame.lstrip("/")

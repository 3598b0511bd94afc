"""What `list3r inspect` says of a source."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from list3r.frames.base import Camera, SourceInfo
from list3r.frames.registration.calibrate import DepthCalibration
from list3r.frames.registration.overlay import draw_registration

__all__ = ["SourceReport", "draw_registration"]


@dataclass(frozen=True)
class SourceReport:
    """What was recognised in a source, and what was asked for besides."""

    info: SourceInfo
    calibration: DepthCalibration | None = None
    overlay: Path | None = None
    """The picture of depth edges over colour that was written."""
    unusable: tuple[str, ...] = ()
    """Frames that cannot be used, as far as a quick look tells: a build leaves them out."""
    doubts: tuple[str, ...] = ()
    """What looks wrong with depth and pictures, though a build takes them."""
    wrong: tuple[str, ...] = ()
    """How poses, depth and camera contradict each other: a build that uses the poses is refused."""

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        info = self.info
        report = {
            "kind": info.kind,
            "path": info.path,
            "frames": info.frame_count,
            "fps": round(info.fps, 6),
            "size": None if info.image_size is None else [info.image_size[1], info.image_size[0]],
            "camera": _camera(info.camera),
            "camera_guess": _camera(info.camera_guess),
            "depth": info.has_depth,
            "depth_units_per_metre": info.depth_scale,
            "depth_registered": info.has_depth and info.depth_camera is None,
            "depth_camera": _camera(info.depth_camera),
            "depth_to_color": None if info.T_color_depth is None else info.T_color_depth.tolist(),
            "poses": info.has_poses,
            "scale": info.scale_kind,
            "z_up": info.z_up,
            "fingerprint": info.fingerprint,
            "notes": list(info.notes),
            "missing": list(info.missing),
            "unusable": list(self.unusable),
            "doubts": list(self.doubts),
            "wrong": list(self.wrong),
        }
        if self.calibration is not None:
            report["calibration"] = self.calibration.as_dict()
        if self.overlay is not None:
            report["overlay"] = str(self.overlay)
        return report

    def lines(self) -> list[str]:
        """Return the same for a person."""
        info = self.info
        return [
            f"kind         {info.kind}",
            f"frames       {info.frame_count} at {info.fps:.4g} a second",
            f"camera       {_seen_text(info)}",
            f"depth        {_depth_text(info)}",
            f"poses        {_poses_text(info)}",
            f"scale        {_scale_text(info)}",
            f"vertical     {_vertical_text(info)}",
            *(f"note         {note}" for note in info.notes),
            *(f"missing      {what}" for what in info.missing),
            *(f"unusable     {what}; build leaves such frames out" for what in self.unusable),
            *(f"warning      {what}" for what in self.doubts),
            *(f"wrong        {what}; build refuses such poses (--poses estimate needs none)" for what in self.wrong),
            *([] if self.calibration is None else _calibration_lines(self.calibration)),
            *([] if self.overlay is None else [f"overlay      {self.overlay}"]),
        ]


def _calibration_lines(found: DepthCalibration) -> list[str]:
    out = [f"calibration  {found.status}: {found.reason}"]
    if found.status != "estimated":
        return out
    fx, fy, cx, cy = found.intrinsics
    x, y, z = 1000.0 * found.T_color_depth[:3, 3]
    std, k1 = found.std, found.distortion[0] if found.distortion else 0.0
    out.append(f"  colour     fx {fx:.1f} fy {fy:.1f} (+-{std['f']:.1f}) cx {cx:g} cy {cy:g} px")
    out.append(f"  lens       k1 {k1:.3f} (+-{std['k1']:.3f})")
    out.append(f"  offset     {x:.1f} {y:.1f} {z:.1f} mm (+-{1000 * std['tx']:.1f} {1000 * std['ty']:.1f})")
    out.append(f"  options    {found.command_line()}")
    return out


def _camera(camera: Camera | None) -> dict[str, float] | None:
    if camera is None:
        return None
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _seen_text(info: SourceInfo) -> str:
    """Return the camera, or what is known of it where it is not."""
    if info.camera is not None or info.image_size is None:
        return _camera_text(info.camera)
    height, width = info.image_size
    guess = info.camera_guess
    return f"unknown, {width}x{height}" + (f", about fx {guess.fx:.0f} px by its EXIF" if guess else "")


def _camera_text(camera: Camera | None) -> str:
    if camera is None:
        return "unknown"
    c = camera
    return f"{c.width}x{c.height}, fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g} px"


_UNITS = {1.0: "in metres", 1000.0: "in millimetres"}


def _depth_text(info: SourceInfo) -> str:
    if not info.has_depth:
        return "none"
    units = _UNITS.get(info.depth_scale or 0.0, f"{info.depth_scale:g} units a metre")
    if info.depth_camera is None or info.T_color_depth is None:
        return f"{units}, on the pixels of the colour image"
    x, y, z = 1000.0 * info.T_color_depth[:3, 3]
    camera = _camera_text(info.depth_camera)
    if info.T_color_depth[:3, 3].any():
        own = f"of a camera of its own, ({x:.0f}, {y:.0f}, {z:.0f}) mm from the colour camera ({camera})"
    else:
        own = f"seen from where the colour is ({camera})"
    return f"{units}, {own}; build lays it on the pixels of the colour image"


def _poses_text(info: SourceInfo) -> str:
    """Return whether there are poses, and what a build makes of them by default."""
    if not info.has_poses:
        return "none; build estimates them"
    if info.poses_drift and info.poses_metric and info.has_depth:
        return "given; build corrects them by the depth (--poses prior), since they drift"
    return "given; build uses them as they are (--poses given)"


def _scale_text(info: SourceInfo) -> str:
    """Return what a unit of the memory will be."""
    if info.has_depth:
        return "metric, by the depth"
    if info.has_poses:
        return "metric, by the poses" if info.poses_metric else "relative, in the unit of the poses"
    return "relative; give a known length with build --scale-anchor"


def _vertical_text(info: SourceInfo) -> str:
    """Return what says which way is up."""
    if info.z_up:
        return "z of the poses is up, by the recorder's gravity (not with --poses estimate)"
    return "build looks for it in floors, tables and walls"

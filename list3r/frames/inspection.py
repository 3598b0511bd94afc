"""What `list3r inspect` says of a source."""

from __future__ import annotations

from typing import Any

from list3r.frames.base import Camera, SourceInfo
from list3r.frames.registration.overlay import draw_registration

__all__ = ["describe", "draw_registration", "lines"]


def describe(info: SourceInfo) -> dict[str, Any]:
    """Return what was recognised, ready for JSON."""
    return {
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
        "fingerprint": info.fingerprint,
        "notes": list(info.notes),
        "missing": list(info.missing),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """A report of `describe`, with `calibration` (of `Calibration.as_dict`) and `overlay` if added, for a person."""
    out = [
        f"kind         {report['kind']}",
        f"frames       {report['frames']} at {report['fps']:.4g} a second",
        f"camera       {_seen_text(report)}",
        f"depth        {_depth_text(report)}",
        f"poses        {'given' if report['poses'] else 'none'}",
        f"scale        {report['scale']}",
    ]
    out += [f"note         {note}" for note in report["notes"]]
    out += [f"missing      {what}" for what in report["missing"]]
    if "calibration" in report:
        out += _calibration_lines(report["calibration"])
    if "overlay" in report:
        out.append(f"overlay      {report['overlay']}")
    return out


def _calibration_lines(found: dict[str, Any]) -> list[str]:
    out = [f"calibration  {found['status']}: {found['reason']}"]
    if found["status"] != "estimated":
        return out
    fx, fy, cx, cy = found["intrinsics"]
    x, y, z = (1000.0 * row[3] for row in found["depth_to_color"][:3])
    std, k1 = found["std"], found["distortion"][0] if found["distortion"] else 0.0
    out.append(f"  colour     fx {fx:.1f} fy {fy:.1f} (+-{std['f']:.1f}) cx {cx:g} cy {cy:g} px")
    out.append(f"  lens       k1 {k1:.3f} (+-{std['k1']:.3f})")
    out.append(f"  offset     {x:.1f} {y:.1f} {z:.1f} mm (+-{1000 * std['tx']:.1f} {1000 * std['ty']:.1f})")
    out.append(f"  options    {found['command_line']}")
    return out


def _camera(camera: Camera | None) -> dict[str, float] | None:
    if camera is None:
        return None
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _seen_text(report: dict[str, Any]) -> str:
    """Return the camera, or what is known of it where it is not."""
    if report["camera"] is not None or report["size"] is None:
        return _camera_text(report["camera"])
    width, height = report["size"]
    guess = report["camera_guess"]
    return f"unknown, {width}x{height}" + (f", about fx {guess['fx']:.0f} px by its EXIF" if guess else "")


def _camera_text(camera: dict[str, float] | None) -> str:
    if camera is None:
        return "unknown"
    return "{width}x{height}, fx {fx:g} fy {fy:g} cx {cx:g} cy {cy:g} px".format(**camera)


def _depth_text(report: dict[str, Any]) -> str:
    if not report["depth"]:
        return "none"
    units = f"{report['depth_units_per_metre']:g} units a metre"
    if report["depth_camera"] is None:
        return f"{units}, registered into the colour image"
    x, y, z = (1000.0 * row[3] for row in report["depth_to_color"][:3])
    own = _camera_text(report["depth_camera"])
    return f"{units}, own camera {own}, {x:.0f} {y:.0f} {z:.0f} mm off; registered here"

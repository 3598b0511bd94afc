"""What `list3r inspect` says of a source."""

from __future__ import annotations

from typing import Any

from list3r.frames.base import Camera, SourceInfo


def describe(info: SourceInfo) -> dict[str, Any]:
    """What was recognised, ready for JSON."""
    return {
        "kind": info.kind,
        "path": info.path,
        "frames": info.frame_count,
        "fps": round(info.fps, 6),
        "size": [info.camera.width, info.camera.height] if info.camera else None,
        "camera": _camera(info.camera),
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


def describe_text(info: SourceInfo) -> str:
    """The same in a few lines for a person."""
    camera = info.camera
    lines = [
        f"kind       {info.kind}",
        f"frames     {info.frame_count} at {info.fps:.4g} a second",
        f"camera     {_camera_text(camera)}",
        f"depth      {_depth_text(info)}",
        f"poses      {'given' if info.has_poses else 'none'}",
        f"scale      {info.scale_kind}",
    ]
    lines += [f"note       {note}" for note in info.notes]
    lines += [f"missing    {what}" for what in info.missing]
    return "\n".join(lines)


def _camera(camera: Camera | None) -> dict[str, float] | None:
    if camera is None:
        return None
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names}


def _camera_text(camera: Camera | None) -> str:
    if camera is None:
        return "unknown"
    return f"{camera.width}x{camera.height}, fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} cy {camera.cy:g} px"


def _depth_text(info: SourceInfo) -> str:
    if not info.has_depth:
        return "none"
    units = f"{info.depth_scale:g} units a metre"
    if info.depth_camera is None or info.T_color_depth is None:
        return f"{units}, registered into the colour image"
    x, y, z = (1000.0 * info.T_color_depth[:3, 3]).tolist()
    return f"{units}, own camera {_camera_text(info.depth_camera)}, {x:.0f} {y:.0f} {z:.0f} mm off; registered here"

"""Write the camera path as animated USD cameras."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from list3r.exporters.components import Component, frames_per_second
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation
from list3r.memory.core.records import FrameRow
from list3r.memory.store.store import Store

USD_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""R_cam_usdcam: USD cameras look along -z with y up, OpenCV ones along +z with y down."""

_APERTURE = 0.36
"""Width of the film in tenths of a stage unit, so 36 mm where the unit is the metre."""


def add_cameras(stage: Usd.Stage, scope: Sdf.Path, component: Component) -> None:
    """Add one animated camera a session, `Camera`, then `Camera_session_2` and so on; time codes are frame numbers."""
    sessions: dict[int, list[tuple[FrameRow, Sim3]]] = {}
    for pose in component.poses:
        sessions.setdefault(pose[0].session_id, []).append(pose)
    for n, (session, poses) in enumerate(sessions.items()):
        camera = UsdGeom.Camera.Define(stage, scope.AppendChild("Camera" if n == 0 else f"Camera_session_{session}"))
        camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
        _animate(camera, poses)
        _set_lens(camera, component, poses)
        camera.GetPrim().SetCustomDataByKey("list3r", {"session": session, "timeCode": "frame number of the source"})


def _animate(camera: UsdGeom.Camera, poses: list[tuple[FrameRow, Sim3]]) -> None:
    rotations = np.stack([S_world_cam.rotation for _, S_world_cam in poses]) @ USD_FROM_OPENCV
    quats_wxyz = quat_wxyz_from_rotation(rotations)
    translate = camera.AddTranslateOp()
    orient = camera.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    clock = camera.GetPrim().CreateAttribute("list3r:time", Sdf.ValueTypeNames.Double, custom=True)
    for (frame, S_world_cam), (w, x, y, z) in zip(poses, quats_wxyz.tolist(), strict=True):
        translate.Set(Gf.Vec3d(*S_world_cam.translation.tolist()), frame.frame_index)
        orient.Set(Gf.Quatd(w, x, y, z), frame.frame_index)
        clock.Set(frame.time_s, frame.frame_index)


def _set_lens(camera: UsdGeom.Camera, component: Component, poses: list[tuple[FrameRow, Sim3]]) -> None:
    """Set the intrinsics: constant where all chunks agree, else sampled where they change and held by neighbouring
    samples."""
    chunks = {c.chunk_id: c for c in component.chunks}
    lenses = [_lens((*chunks[f.chunk_id].intrinsics, *chunks[f.chunk_id].image_size)) for f, _ in poses]
    attributes = [
        camera.CreateHorizontalApertureAttr(),
        camera.CreateVerticalApertureAttr(),
        camera.CreateFocalLengthAttr(),
        camera.CreateHorizontalApertureOffsetAttr(),
        camera.CreateVerticalApertureOffsetAttr(),
    ]
    for k, attribute in enumerate(attributes):
        attribute.Set(lenses[0][k])
        if len(set(lenses)) > 1:
            for (frame, _), lens in zip(poses, lenses, strict=True):
                attribute.Set(lens[k], frame.frame_index)


def _lens(camera: tuple[float, ...]) -> tuple[float, float, float, float, float]:
    """Return the horizontal and vertical aperture, focal length, offsets; the image spans [-0.5, width - 0.5] px."""
    fx, fy, cx, cy, height, width = camera
    focal = _APERTURE * fx / width
    return (
        _APERTURE,
        focal * height / fy,
        focal,
        focal * ((width - 1) / 2 - cx) / fx,
        focal * (cy - (height - 1) / 2) / fy,
    )


def set_time_range(stage: Usd.Stage, components: list[Component], store: Store) -> None:
    """Set start, end and rate of the stage: frame numbers, at the rate of the first session."""
    frames = [frame.frame_index for c in components for frame, _ in c.poses]
    if not frames:
        return
    stage.SetStartTimeCode(min(frames))
    stage.SetEndTimeCode(max(frames))
    rates = [frames_per_second(store.frames.all(s.session_id)) for s in store.sessions.all()]
    rate = next((r for r in rates if r is not None), 30.0)
    stage.SetTimeCodesPerSecond(round(rate, 3))
    stage.SetFramesPerSecond(round(rate, 3))

"""Stored pictures: which keyframes have one, what shows in them, and the picture that shows an instance best."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import too_many_pixels
from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.core.masks import FULL_SIDE_PX, decode_mask, shown_surface
from list3r.memory.core.records import ChunkRow, Instance, MaskTrack, Observation
from list3r.memory.store.store import Store
from list3r.queries.match import checked_instance
from list3r.queries.views.camera import PosedCamera, cameras_of_frames
from list3r.queries.views.visibility import in_front, look

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class PictureSettings:
    """How the picture of an instance is chosen."""

    full_side_px: float = FULL_SIDE_PX
    """As in `list3r.memory.core.masks.shown_surface`."""
    projected_frames: int = 12
    """So many keyframes at most are looked at for an instance that was followed in none of them."""


@dataclass(frozen=True)
class InstanceSight:
    """How an instance shows in one picture."""

    instance_id: int
    box_xyxy: Box
    """px."""
    area_px: int
    """Of its mask."""
    visible_fraction: float
    """Share of its surface inside the frame that nothing hides, in [0, 1]."""
    mask: NDArray[np.uint32]
    """Run-length code at the picture's size, see `list3r.memory.core.masks`. Shape (R,)."""

    def worth(self, settings: PictureSettings | None = None) -> float:
        """Tell how well a picture shows the instance, in [0, 1]: how much of it, and whether large enough to see."""
        s = settings or PictureSettings()
        return float(shown_surface(self.visible_fraction, self.area_px, s.full_side_px))


@dataclass(frozen=True)
class KeyframePicture:
    """A keyframe whose colour picture is stored, and the instances that were followed in it."""

    session_id: int
    frame_index: int
    chunk_id: int
    """The chunk that keeps the picture."""
    component: int
    image_size: tuple[int, int]
    """(height, width), px."""
    sights: tuple[InstanceSight, ...]
    """By id."""


@dataclass(frozen=True)
class InstancePicture:
    """The stored picture that shows an instance best."""

    instance_id: int
    session_id: int
    frame_index: int
    rgb: NDArray[np.uint8]
    """The whole keyframe. Shape (H, W, 3)."""
    box_xyxy: Box
    """Round the instance, px."""
    mask: NDArray[np.bool_] | None
    """Its pixels, shape (H, W); None where it was not followed in this frame: then the box is its projection."""
    visible_fraction: float
    """Share of it that nothing hides, in [0, 1]."""

    def crop(self, margin: float = 0.25) -> NDArray[np.uint8]:
        """Return the part round the box, wider by a share of its longer side on each side. Shape (h, w, 3)."""
        x0, y0, x1, y1 = self.box_xyxy
        room = max(margin * max(x1 - x0, y1 - y0), 4.0)
        height, width = self.rgb.shape[:2]
        left, top = int(max(0, x0 - room)), int(max(0, y0 - room))
        right, bottom = int(min(width, np.ceil(x1 + room))), int(min(height, np.ceil(y1 + room)))
        return self.rgb[top : max(bottom, top + 1), left : max(right, left + 1)]

    def marked(self) -> NDArray[np.uint8]:
        """Return the whole picture with the outline of the instance. Shape (H, W, 3)."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self.rgb)
        if self.mask is None:
            ImageDraw.Draw(image).rectangle(self.box_xyxy, outline=(255, 210, 0), width=3)
            return np.asarray(image)
        out = self.rgb.copy()
        out[mask_border(self.mask)] = (255, 210, 0)
        return out

    def _repr_png_(self) -> bytes:
        from PIL import Image

        out = io.BytesIO()
        Image.fromarray(self.crop()).save(out, format="PNG")
        return out.getvalue()


def mask_border(mask: NDArray[np.bool_], width: int = 2) -> NDArray[np.bool_]:
    """Return the pixels within `width` of the edge of a mask, inside of it. Shape (H, W)."""
    from scipy.ndimage import binary_erosion

    return np.asarray(mask & ~binary_erosion(mask, iterations=width))


def decode_picture(jpeg: bytes) -> NDArray[np.uint8]:
    """Return the RGB picture of JPEG bytes, shape (H, W, 3). Raises `MemoryFileError` where they are none."""
    from PIL import Image, UnidentifiedImageError

    size = too_many_pixels(jpeg)
    if size is not None:
        raise MemoryFileError(f"a stored picture claims {size[0]}x{size[1]} pixels; the file is damaged or hostile")
    try:
        return np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))
    except (OSError, UnidentifiedImageError) as error:
        raise MemoryFileError("a stored picture cannot be decoded; run `list3r verify`") from error


def keyframe_pictures(store: Store, instance_ids: Sequence[int] | None = None) -> list[KeyframePicture]:
    """Return the keyframes with a stored picture in the order of session and frame, with what was followed in each.

    With `instance_ids` only those instances, and only the pictures that show one of them. Of a frame that two chunks
    share, an instance counts where it is seen better. Raises `UnknownIdError`.
    """
    chunks = {c.chunk_id: c for c in store.chunks.all()}
    followed = _observations_by_chunk(store, instance_ids)
    sights: dict[tuple[int, int], dict[int, InstanceSight]] = {}
    keeper: dict[tuple[int, int], ChunkRow] = {}
    for chunk_id in sorted(chunks if instance_ids is None else followed):
        chunk = chunks[chunk_id]
        frames = store.keyframes.with_picture(chunk_id)
        for frame in frames:
            keeper.setdefault((chunk.session_id, frame), chunk)
            sights.setdefault((chunk.session_id, frame), {})
        observations = followed.get(chunk_id, []) if frames else []
        found = (
            x
            for o in observations
            for x in _sights(o, store.local_instances.mask_track(o.chunk_id, o.local_id), frames)
        )
        for frame, sight in found:
            seen = sights[(chunk.session_id, frame)]
            if sight.instance_id not in seen or seen[sight.instance_id].worth() < sight.worth():
                seen[sight.instance_id] = sight
    out = []
    for key in sorted(sights):
        chunk, seen = keeper[key], sights[key]
        if seen or instance_ids is None:
            order = tuple(seen[n] for n in sorted(seen))
            out.append(KeyframePicture(*key, chunk.chunk_id, chunk.component, chunk.image_size, order))
    return out


def _observations_by_chunk(store: Store, instance_ids: Sequence[int] | None) -> dict[int, list[Observation]]:
    if instance_ids is None:
        found = store.observations.all()
    else:
        wanted = sorted({checked_instance(store, n).id for n in instance_ids})
        found = [o for n in wanted for o in store.observations.of(n)]
    out: dict[int, list[Observation]] = {}
    for o in found:
        out.setdefault(o.chunk_id, []).append(o)
    return out


def _sights(o: Observation, track: MaskTrack, frames: list[int]) -> list[tuple[int, InstanceSight]]:
    out = []
    for n in np.flatnonzero(np.isin(track.frames, frames)).tolist():
        x0, y0, x1, y1 = (float(v) for v in track.boxes_xyxy[n])
        share = float(track.visible_fraction[n])
        sight = InstanceSight(o.instance_id, (x0, y0, x1, y1), int(track.areas_px[n]), share, track.masks[n])
        out.append((int(track.frames[n]), sight))
    return out


def keyframe_rgb(store: Store, picture: KeyframePicture) -> NDArray[np.uint8]:
    """Return the stored picture itself. Shape (H, W, 3)."""
    return decode_picture(store.keyframes.get(picture.chunk_id, picture.frame_index).jpeg)


def instance_picture(store: Store, instance_id: int, settings: PictureSettings | None = None) -> InstancePicture:
    """Return the stored picture that shows most of an instance's surface, large enough to see.

    An instance that was followed in no stored picture is projected into those that look its way. Raises
    `UnknownIdError`, and `OptionError` where no stored picture shows it.
    """
    settings = settings or PictureSettings()
    instance = checked_instance(store, instance_id)
    views = [v for o in store.observations.of(instance.id) for v in _views(store, o, settings)]
    if not views:
        return _projected(store, instance, settings)
    largest = max(v.points for v in views)
    best = max(views, key=lambda v: (v.shown * v.points / largest, v.sight.area_px, -v.frame_index))
    rgb, sight = decode_picture(store.keyframes.get(best.chunk_id, best.frame_index).jpeg), best.sight
    mask = decode_mask(sight.mask, (rgb.shape[0], rgb.shape[1])) if rgb.shape[:2] == best.image_size else None
    session = store.chunks.get(best.chunk_id).session_id
    return InstancePicture(instance.id, session, best.frame_index, rgb, sight.box_xyxy, mask, sight.visible_fraction)


@dataclass(frozen=True)
class _View:
    """A stored picture in which a local instance of an instance was followed."""

    chunk_id: int
    frame_index: int
    image_size: tuple[int, int]
    points: int
    """Surface points of the local instance: how much of the instance its chunk knows."""
    shown: float
    """Share of those that shows, see `shown_surface`."""
    sight: InstanceSight


def _views(store: Store, o: Observation, settings: PictureSettings) -> list[_View]:
    track = store.local_instances.mask_track(o.chunk_id, o.local_id)
    found = _sights(o, track, store.keyframes.with_picture(o.chunk_id))
    support = store.supports.get(o.chunk_id, o.local_id) if found else None
    points = 1 if support is None else max(len(support.points), 1)
    return [_View(o.chunk_id, n, track.image_size, points, s.worth(settings), s) for n, s in found]


def _projected(store: Store, instance: Instance, settings: PictureSettings) -> InstancePicture:
    best: tuple[float, PosedCamera, int, Box, float] | None = None
    for camera, chunk_id in _cameras_towards(store, instance, settings.projected_frames):
        for s in look(store, camera, in_front(store, camera, None)):
            worth = s.visible * s.inside * min(1.0, s.picture**0.5)
            if s.instance.id == instance.id and (best is None or worth > best[0]):
                best = worth, camera, chunk_id, s.box_xyxy, s.visible
    if best is None:
        raise OptionError(
            f"no stored picture of {store.path} shows instance {instance.id}; "
            "pictures are kept by a build without --no-pictures"
        )
    _, camera, chunk_id, box, visible = best
    assert camera.frame is not None
    rgb = decode_picture(store.keyframes.get(chunk_id, camera.frame.frame_index).jpeg)
    return InstancePicture(instance.id, camera.session_id, camera.frame.frame_index, rgb, box, None, visible)


def _cameras_towards(store: Store, instance: Instance, most: int) -> list[tuple[PosedCamera, int]]:
    """Return the cameras whose stored picture holds an instance's centre, the nearest first, each with the chunk that
    keeps the picture.
    """
    keeper: dict[tuple[int, int], int] = {}
    for chunk in (c for c in store.chunks.all() if c.component == instance.component):
        for frame in store.keyframes.with_picture(chunk.chunk_id):
            keeper.setdefault((chunk.session_id, frame), chunk.chunk_id)
    found = []
    for camera in cameras_of_frames(store, keeper) if keeper else ():
        x, y, z = camera.T_world_cam[:3, :3].T @ (instance.center - camera.place)
        (fx, fy, cx, cy), (height, width) = camera.intrinsics, camera.image_size
        inside = z > 0 and 0 <= fx * x + cx * z < width * z and 0 <= fy * y + cy * z < height * z
        if inside and camera.frame is not None:
            found.append((z, camera, keeper[camera.session_id, camera.frame.frame_index]))
    return [(camera, chunk) for _, camera, chunk in sorted(found, key=lambda f: float(f[0]))[:most]]

"""Frames from the files of a recognised folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Camera, Frame, FrameSource, LazyFrame, SourceInfo
from list3r.frames.beside import refuse_left
from list3r.frames.decoding.decode import (
    clean_depth,
    fault_of,
    read_color,
    read_gray,
    read_raw_depth,
    sure_depth,
    used_bits,
)
from list3r.frames.decoding.exif import exif_focal, stated_size
from list3r.frames.decoding.shown import LOOKED_AT, ShownPart, check_no_panorama, shown_note, shown_part
from list3r.frames.layout import FolderLayout, pose_matrix, read_numbers
from list3r.frames.listing import DEPTH, POSE, POSE_FILE, FrameFile
from list3r.frames.options import SourceOptions
from list3r.frames.recordings.axes import lying_note, turns_in_gravity
from list3r.frames.recordings.stored import CodedArray, Stored, stored_size
from list3r.frames.registration.rig import Rig, build_rig, merge_optics
from list3r.frames.selection import select, sharpness
from list3r.frames.unread import not_read, not_read_note
from list3r.memory.core.errors import FrameError, SourceError

DEFAULT_FPS = 30.0
_PROBES = 9
_LEAST_M, _MOST_M = 0.1, 30.0
_POSES_TRIED = 50
_FILES_TRIED = 12
_SIZES_LOOKED_AT = 500
"""Pictures whose size is looked at, by their heads."""
_MOST_OFF_CENTRE = 0.2
"""Of a camera's centre from the middle of its picture, as a share of the side."""
NOWHERE_SURE = "the sensor is not sure of any depth that was sampled; does `confidence` belong to this recording?"


NOT_STANDING = "the cameras do not stand upright in the poses' world: its vertical is not used"


class FolderSource(FrameSource):
    """A `FrameSource` over files; nothing is kept between frames."""

    def __init__(self, root: Path, layout: FolderLayout, options: SourceOptions) -> None:
        """Raises `SourceError` and `OptionError` where the first images and the cameras do not fit together."""
        self._layout, self._options = layout, options
        files = layout.files
        rate = _rate(files.times_s)
        self._clock = rate is not None
        self._fps = rate or options.fps or DEFAULT_FPS
        times_s = files.times_s if self._clock else np.arange(len(files)) / self._fps
        self._chosen = select(times_s, options, root, clock=self._clock, video=False)
        self._sharpest: dict[int, int] = {}
        self.optics, notes = merge_optics(layout, options)
        optics = self.optics
        depths = (files[k].depth for k in files.that_hold(DEPTH))
        self._has_depth = any(depth is not None and depth.is_file() for depth in depths)
        self._typical_raw = 0.0
        self._floats, self._bits = False, 16
        sizes = self._probe(root)
        fractions = self._floats and options.depth_scale is None and optics.depth_scale not in (None, 1.0)
        if fractions and self._typical_raw <= _MOST_M:  # larger numbers with fractions are in the layout's unit
            self.optics = optics = replace(optics, depth_scale=1.0)
            notes = (*notes, "depth is stored with fractions: metres are assumed; --depth-scale changes that")
        self._rig = build_rig(optics, *sizes, options.max_depth_m, options.max_side, self._shown_part(root))
        self._T_posed_color: NDArray[np.float64] = np.eye(4)
        if layout.poses_of == "depth" and optics.T_color_depth is not None:
            self._T_posed_color = np.asarray(np.linalg.inv(optics.T_color_depth), dtype=np.float64)
        self._empty: dict[int, str] = {}
        self._info = self._describe(root, notes)

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        for position in range(len(self._chosen))[start:stop:step]:
            yield self._read(self._number(position))

    def read_some(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        """As `read`, but frames at positions that are no multiple of `step` are read when they are looked at.

        Of those whose files are known to be empty or missing it is said at once.
        """
        for position in range(len(self._chosen))[start:stop]:
            number = self._number(position)
            file = self._layout.files[number]
            lacking = number in self._empty or (self._has_depth and file.depth is None)
            if position % step and not lacking:
                yield LazyFrame(number, self._time_s(number, file), self._pose(file), partial(self._read, number))
            else:
                yield self._read(number)

    def _read(self, number: int) -> Frame | BadFrame:
        try:
            return self._frame(number)
        except FrameError as error:
            return BadFrame(number, str(error))

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        found = [(k, self._layout.files[k]) for k in map(self._number, range(len(self._chosen)))]
        poses = [(k, self._time_s(k, file), self._pose(file)) for k, file in found]
        return [(k, time_s, T) for k, time_s, T in poses if T is not None]

    def read_raw(self, position: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour as stored, shape (H, W, 3), and metric depth on the depth camera's own pixels, shape (h, w).

        Raises `FrameError` when one of them is missing or cannot be decoded.
        """
        file = self._layout.files[self._number(position)]
        if file.depth is None:
            raise FrameError(f"{file.color.name} has no depth image")
        raw = read_raw_depth(file.depth)
        return self._color(file), clean_depth(raw, self._rig.depth_scale, self._options.max_depth_m)

    def thumbnails(self) -> Iterator[NDArray[np.uint8] | None]:
        return map(partial(self._gray, reduction=8), range(len(self._chosen)))

    def read_grays(self, start: int, stop: int) -> Iterator[NDArray[np.uint8] | None]:
        return map(self._gray, range(len(self._chosen))[start:stop])

    def _gray(self, position: int, reduction: int = 1) -> NDArray[np.uint8] | None:
        try:
            return read_gray(self._layout.files[self._number(position)].color, reduction)
        except FrameError:
            return None

    def _number(self, position: int) -> int:
        """Return the frame number handed out at a position."""
        first, stop = int(self._chosen.starts[position]), int(self._chosen.stops[position])
        if stop - first > 1 and position not in self._sharpest:
            scores = [self._sharpness(k) for k in range(first, stop)]
            self._sharpest[position] = first + int(np.argmax(scores))
        return self._sharpest.get(position, first)

    def _sharpness(self, number: int) -> float:
        try:
            return sharpness(read_gray(self._layout.files[number].color, 2))
        except FrameError:
            return -1.0

    def _frame(self, number: int) -> Frame:
        file = self._layout.files[number]
        color = self._rig.color(self._color(file), file.lens)
        depth = None
        if self._has_depth:
            if file.depth is None:
                raise FrameError(f"{file.color.name} has no depth image")
            depth = self._rig.depth(self._sure(read_raw_depth(file.depth), file), file.lens)
            if file.mask is not None:
                depth = np.where(self._shown(file.mask, depth.shape), depth, np.float32(0.0))
        return Frame(number, self._time_s(number, file), color, depth, self._pose(file))

    def _shown(self, mask: Stored, size: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return where a mask lets a picture count. Shape `size`."""
        gray = read_gray(mask, 1)
        height, width = gray.shape
        if abs(width * size[0] - height * size[1]) > 0.02 * height * size[1]:
            raise FrameError(f"{mask.name} is {width}x{height}, unlike its picture")
        return np.asarray(cv2.resize(gray, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT) > 0)

    def _color(self, file: FrameFile) -> NDArray[np.uint8]:
        """Return the picture as stored, upright where that is asked for. Shape (H, W, 3)."""
        return read_color(file.color, self._bits, upright=self._layout.upright_tags)

    def _sure(self, raw: NDArray[Any], file: FrameFile) -> NDArray[Any]:
        """Depth as stored, 0 where the sensor is not sure enough of it."""
        least = self._layout.least_confidence
        if least is None or file.confidence is None:
            return raw
        return sure_depth(raw, read_raw_depth(file.confidence), least)

    def _time_s(self, number: int, file: FrameFile) -> float:
        return file.time_s if self._clock and file.time_s is not None else number / self._fps

    def _pose(self, file: FrameFile) -> NDArray[np.float64] | None:
        """Return the colour camera's pose, None where the file has none or an invalid one."""
        T_source_given = file.T_source_camera
        if file.pose is not None:
            try:
                T_source_given = pose_matrix(v for row in read_numbers(file.pose) for v in row)
            except SourceError:
                return None
        return None if T_source_given is None else T_source_given @ self._T_posed_color

    def _probe(self, root: Path) -> tuple[tuple[int, int], tuple[int, int] | None]:
        """Image sizes of the first frame that decodes, among the first and some spread over the source.

        Those come first whose picture has the size that most of the ones spread have. Of a stretch of a source in which
        none decodes the others tell.
        """
        files, count = self._layout.files, len(self._chosen)
        spread = set(np.linspace(0, count - 1, _PROBES).astype(int).tolist())
        tried = sorted({*range(min(3, count)), *spread})
        paths = [files[int(self._chosen.starts[k])] for k in tried]
        sizes = [_size_of(file) for file in paths]
        known = Counter(size for k, size in zip(tried, sizes, strict=True) if size and k in spread)
        usual = known.most_common(1)[0][0] if known else ()
        first = [file for _, file in sorted(zip(sizes, paths, strict=True), key=lambda pair: pair[0] != usual)]
        others = (files[k] for k in range(0, len(files), -(-len(files) // _PROBES)))
        reason = ""
        for file in chain(first, others if count < len(files) else ()):
            try:
                if found := self._sizes(root, file, [f.color for f in paths]):
                    return found
            except FrameError as error:
                reason = reason or str(error)
        raise SourceError(f"{root}: none of {len(tried)} frames tried can be decoded ({reason}); is the copy complete?")

    def _sizes(
        self, root: Path, file: FrameFile, colors: list[Stored]
    ) -> tuple[tuple[int, int], tuple[int, int] | None] | None:
        """Image sizes of a frame, None for one without the depth that others have. Raises `FrameError`."""
        color = read_color(file.color, upright=self._layout.upright_tags)
        self._first_picture, self._bits = file.color, used_bits(colors)
        if not self._has_depth:
            return color.shape[:2], None
        if file.depth is None:
            return None
        raw = read_raw_depth(file.depth)
        if raw.dtype == np.uint8:
            raise SourceError(
                f"{root}: depth images like {file.depth.name} have 8 bits, 255 steps, as pictures of depth for people "
                "have; export depth with 16 bits, or use --kind images on the pictures' folder to take colour alone"
            )
        self._typical_raw, self._floats = _median_known(raw), raw.dtype.kind == "f"
        return color.shape[:2], (raw.shape[0], raw.shape[1])

    def _shown_part(self, root: Path) -> ShownPart | None:
        """Return the part of pictures without depth that is no black bar. Raises `SourceError` for panoramas."""
        files, chosen = self._layout.files, self._chosen
        if (
            self._has_depth
            or self._layout.kind == "live"
            or any(files[k].lens is not None for k in (0, len(files) - 1))
        ):
            return None
        numbers = np.unique(np.linspace(0, len(chosen) - 1, LOOKED_AT).astype(int))
        pictures = self._decodable(files[int(chosen.starts[k])] for k in numbers.tolist())
        first = next(pictures, None)
        if first is None:
            return None
        if self.optics.intrinsics is None:
            check_no_panorama([first], str(root))
        return shown_part(chain([first], pictures))

    def _decodable(self, files: Iterable[FrameFile]) -> Iterator[NDArray[np.uint8]]:
        for file in files:
            with contextlib.suppress(FrameError):
                yield self._color(file)

    def _doubts(self) -> tuple[str, ...]:
        """Return what looks wrong with depth, poses and times."""
        return (
            *self._file_doubts(),
            *self._scale_doubts(),
            *self._depth_doubts(),
            *self._pose_doubts(),
            *self._count_doubts(),
            *self._time_doubts(),
            *self._camera_doubts(),
        )

    def _file_doubts(self) -> tuple[str, ...]:
        """Return how many files are empty or missing, and of others spread over the source, those that cannot be read.

        Steps that are not even miss no pattern.
        """
        files, empty = self._layout.files, self._empty
        out = []
        if empty:
            first, reason = next(iter(empty.items()))
            rest = ", and those of all frames behind it" if len(empty) == len(files) - first > 1 else ""
            out.append(
                f"{len(empty)} of {len(files)} frames cannot be used: the first is frame {first} ({reason}){rest}"
            )
        tried = np.unique((np.linspace(0, 1, _FILES_TRIED) ** 1.1 * (len(files) - 1)).round()).astype(int).tolist()
        some = [files[k] for k in tried if k not in empty]
        sizes = Counter(
            size
            for k in _spread(len(files), _SIZES_LOOKED_AT)
            if (size := stated_size(files[k].color, self._layout.upright_tags))
        )
        if len(sizes) > 1:
            (usual, most), total = sizes.most_common(1)[0], sum(sizes.values())
            others = ", ".join(f"{w}x{h}" for w, h in [s for s, _ in sizes.most_common(4)][1:])
            out.append(
                f"{total - most} of {total} pictures looked at are of another size ({others}) than most "
                f"({usual[0]}x{usual[1]}) and cannot be used"
            )
        faults = [found for f in some if (found := fault_of(f.color) or (fault_of(f.depth) if f.depth else None))]
        if faults:
            out.append(f"{len(faults)} of {len(some)} frames looked at cannot be used ({faults[0]})")
        return tuple(found if "size" in found else f"{found}; is the copy complete?" for found in out)

    def _scale_doubts(self) -> tuple[str, ...]:
        """A `--depth-scale` that is not that of the layout: depth, and all that is made of it, has another size."""
        given, usual = self._options.depth_scale, self._layout.optics.depth_scale
        if not self._has_depth or given is None or usual is None or usual == given:
            return ()
        times = usual / given
        how = f"{times:.3g} times larger" if times > 1 else f"{1 / times:.3g} times smaller"
        kind = self._layout.kind
        return (f"--depth-scale {given:g} makes depth {how}: the {kind} layout has {usual:g} units a metre",)

    def _camera_doubts(self) -> tuple[str, ...]:
        """Return what looks wrong with the camera: a centre far from the middle is that of another size."""
        camera = self._rig.camera
        if camera is None:
            return ()
        off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
        if off < _MOST_OFF_CENTRE:
            return ()
        size = f"{camera.width}x{camera.height}"
        where = f"({camera.cx:.0f}, {camera.cy:.0f})"
        return (f"the camera's centre {where} lies far from the middle of {size}: is it for pictures of another size?",)

    def _turns(self) -> int | None:
        """Return how the pictures are turned in the world whose z is said to point up, None where it does not."""
        some = map(self._pose, self._some_that_hold(POSE_FILE | POSE)) if self._layout.z_up else ()
        return turns_in_gravity([T for T in some if T is not None])

    def _some_that_hold(self, what: int) -> list[FrameFile]:
        """Return frames that hold something, spread over the source."""
        given = self._layout.files.that_hold(what)
        return [self._layout.files[k] for k in given[:: max(1, len(given) // _POSES_TRIED)]]

    def _depth_doubts(self) -> tuple[str, ...]:
        typical_m = self._typical_raw / self._rig.depth_scale
        if not self._has_depth:
            return ()
        if _LEAST_M <= typical_m <= _MOST_M:
            return (NOWHERE_SURE,) if self._nowhere_sure() else ()
        if typical_m == 0:
            return ("the sampled depth is unknown everywhere (all 0, or all of the largest value)",)
        return (f"depth is typically {typical_m:.3g} m, which is unlikely indoors: --depth-scale may be wrong",)

    def _nowhere_sure(self) -> bool:
        """Whether no frame that is looked at has depth that the sensor is sure enough of."""
        some = [f for f in self._some_that_hold(DEPTH) if f.confidence is not None]
        with contextlib.suppress(FrameError):
            return bool(some) and not any(self._sure(read_raw_depth(f.depth), f).any() for f in some if f.depth)
        return False

    def _pose_doubts(self) -> tuple[str, ...]:
        """Of poses that are given, spread over the source, those that are no rigid motion."""
        some = self._some_that_hold(POSE_FILE)
        wrong = sum(self._pose(f) is None for f in some)
        if not wrong:
            return ()
        return (f"{wrong} of {len(some)} poses looked at are not rigid motions (mirrored, stretched or not finite)",)

    def _count_doubts(self) -> tuple[str, ...]:
        """Return how many frames lack a pose or a depth image that others have."""
        files = self._layout.files
        total = len(files)
        posed, deep = len(files.that_hold(POSE_FILE | POSE)), len(files.that_hold(DEPTH))
        return (
            *((without_pose(total - posed, total),) if 0 < posed < total else ()),
            *((without_depth(files.that_hold(DEPTH), total),) if self._has_depth and deep < total else ()),
        )

    def _time_doubts(self) -> tuple[str, ...]:
        if self._clock:
            return ()
        stated = np.count_nonzero(~np.isnan(self._layout.files.times_s)) > 1
        why = "the time stamps do not ascend" if stated else "no times are stated"
        return (
            () if self._options.fps and not stated else (f"{why}: {self._fps:g} frames a second are assumed (--fps)",)
        )

    def _describe(self, root: Path, notes: tuple[str, ...]) -> SourceInfo:
        layout, rig = self._layout, self._rig
        found = fingerprint(layout.kind, self._listing(root), self._options)
        notes = (*notes, *self._doubts())
        guess, turns = self._camera_guess(), self._turns()
        if rig.shown is not None:
            notes = (*notes, shown_note(rig.shown, rig.stored_size))
        if rig.color_size != rig.shown_size:
            notes = (*notes, reduced_note(rig))
        if self._bits < 16:
            notes = (
                *notes,
                f"the pictures use {self._bits} of their 16 bits; these are taken as the full range of brightness",
            )
        has_poses = len(layout.files.that_hold(POSE_FILE | POSE)) > 0
        left = not_read(root, layout.kind, self._some_files(), layout.read)
        if self._options.kind == "auto":
            refuse_left(root, layout.kind, left, depth=self._has_depth, poses=has_poses, camera=rig.camera is not None)
        separate = rig.registration
        if layout.z_up and turns is None and len(layout.files.that_hold(POSE_FILE | POSE)):
            notes = (*notes, NOT_STANDING)
        notes = (*notes, *lying_note(turns or 0))
        return SourceInfo(
            kind=layout.kind,
            path=str(root),
            frame_count=len(self._chosen),
            fps=self._fps,
            camera=rig.camera,
            has_depth=self._has_depth,
            has_poses=has_poses,
            fingerprint=found,
            depth_camera=separate.depth_camera if separate else None,
            T_color_depth=separate.T_color_depth if separate else None,
            depth_scale=rig.depth_scale if self._has_depth else None,
            notes=(*layout.notes, *notes, *not_read_note(left)),
            image_size=rig.color_size,
            stored_size=rig.shown_size,
            corner=(0, 0) if rig.shown is None else (rig.shown.top, rig.shown.left),
            camera_guess=guess,
            poses_metric=layout.poses_metric,
            z_up=turns is not None,
            poses_drift=layout.poses_drift,
        )

    def _listing(self, root: Path) -> Iterator[tuple[str, int]]:
        """Yield names and sizes of all files, and keep which frames have none to read."""
        above = f"{root}{os.sep}"
        for number, file in enumerate(self._layout.files):
            for stored in (p for p in (file.color, file.depth, file.pose) if p is not None):
                size = stored_size(stored)
                if size <= 0 and stored is not file.pose:
                    reason = f"{stored.name} is {'missing' if size else 'empty'}"
                    self._empty.setdefault(number, reason)
                isfile = isinstance(stored, Path)
                name = str(stored).removeprefix(above).replace(os.sep, "/") if isfile else stored.name
                yield name, size

    def _some_files(self) -> list[Stored | CodedArray | None]:
        """Return the files of the first frame, the last and one between."""
        files = self._layout.files
        some = [files[k] for k in sorted({0, len(files) // 2, len(files) - 1})]
        return [p for f in some for p in (f.color, f.depth, f.pose, f.confidence, f.mask)]

    def _camera_guess(self) -> Camera | None:
        """Return what the first picture's EXIF says of a camera that is unknown."""
        picture = self._first_picture
        focal = exif_focal(picture) if self._rig.camera is None and isinstance(picture, Path) else None
        return None if focal is None else centred_camera(focal, self._rig)


def _spread(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist() if count else []


def without_pose(count: int, total: int) -> str:
    """That some frames have no pose, for people."""
    return f"{count} of {total} frames have no pose"


def without_depth(deep: Sequence[int] | NDArray[np.int64], total: int) -> str:
    """That some frames have no depth image, for people; `deep` are the numbers of those that have, ascending."""
    missing, ends = total - len(deep), int(deep[-1]) + 1 if len(deep) else 0
    where = f" (all from frame {ends} on)" if missing == total - ends > 1 else ""
    return f"{missing} of {total} frames have no depth image and cannot be used{where}"


def centred_camera(focal: float, rig: Rig) -> Camera:
    """Return a camera with its centre in the middle, for a focal length in px of the pictures as stored."""
    height, width = rig.shown_size
    stored = Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
    return stored.resized(*rig.color_size)


def reduced_note(rig: Rig) -> str:
    """That frames are smaller than stored, for people."""
    (h, w), (height, width) = rig.shown_size, rig.color_size
    return f"pictures of {w}x{h} are reduced to {width}x{height}; --max-side changes that (0: never)"


def fingerprint(kind: str, listing: Iterable[tuple[str, int]], options: SourceOptions) -> str:
    """Hash of the files' names and sizes and of every option that shapes frames. 32 hexadecimal digits."""
    found = hashlib.sha256(repr((kind, sorted(asdict(replace(options, kind="auto")).items()))).encode())
    for row in listing:
        found.update(repr(row).encode())
    return found.hexdigest()[:32]


def _size_of(file: FrameFile) -> tuple[int, ...]:
    """Return the size of a picture, an eighth of it; empty where it cannot be decoded."""
    try:
        return read_gray(file.color, 8).shape
    except FrameError:
        return ()


def _median_known(raw: NDArray[Any]) -> float:
    """Median of the values that can be depth, in stored units; 0 when there are none."""
    known = raw[clean_depth(raw, 1.0, None) > 0]
    return float(np.median(known)) if known.size else 0.0


def _rate(times_s: NDArray[np.float64]) -> float | None:
    """Median frame rate of a source with a clock, None without."""
    usual_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    return 1.0 / usual_s if usual_s > 0 else None  # NaN, where a frame has no time, is no rate either

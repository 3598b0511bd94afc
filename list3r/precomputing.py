"""A video as files of geometry: the chunks of a build, reconstructed and written, for a build somewhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from list3r.calibration_stage import estimated_camera, told_camera
from list3r.chunk_stage import BuildSettings
from list3r.frames.base import Camera, Frame, FrameSource, SourceInfo, guessed_camera
from list3r.frames.chunks import ChunkSpan, plan_chunks
from list3r.frames.cuts import find_cuts
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.errors import OptionError, TrackingError
from list3r.models.licences import DEFAULT_PROFILE
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.precomputed_files import (
    MANIFEST,
    Manifest,
    Piece,
    read_manifest,
    read_piece,
    write_manifest,
    write_piece,
)
from list3r.reconstruction.registry import ModelOptions, make_reconstructor
from list3r.session_stage import Look, check_buildable, resolve_settings, with_weights


@dataclass(frozen=True)
class PrecomputeReport:
    """What was written."""

    files: int
    frames: int
    posed: int
    bytes: int
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def precompute(
    source: str | Path,
    out: Path,
    options: SourceOptions,
    settings: BuildSettings,
    info: SourceInfo,
    *,
    force: bool = False,
    licence: str = DEFAULT_PROFILE,
    progress: Callable[[int, int], None] | None = None,
    look: Look | None = None,
) -> PrecomputeReport:
    """Reconstruct every chunk of a source and write one file for each into `out`; finished files are kept.

    `look` hears of what is done before the chunks: as in a build, jumps are looked for and an unknown camera estimated.
    Raises `SourceError`, and `OptionError` when the folder holds files of other settings.
    """
    settings = resolve_settings(settings, info)
    check_buildable(info, settings)
    settings = with_weights(settings, licence)
    _begin(out, settings, info, force)
    scan = None if look is None else (lambda done, total: look("cuts", done, total))
    cuts = () if settings.poses == "given" else tuple(find_cuts(open_source(source, options), progress=scan))
    spans = plan_chunks(info.frame_count, settings.chunks, cuts)
    notes: list[str] = []
    if force or not all(_file(out, span).exists() for span in spans):
        camera = estimated_camera(source, options, settings.reconstruction, info, look)
        if camera is not None:
            options, notes = told_camera(options, camera), [*camera["notes"], _said(camera)]
    opened = open_source(source, options)
    known = opened.info.camera is not None
    s = settings
    model = make_reconstructor(
        s.reconstruction,
        ModelOptions(s.poses, known, s.device, s.weights, s.local_features, s.feature_weights),
    )
    posed: set[int] = set()
    for span in spans:
        path = _file(out, span)
        if force or not path.exists():
            try:
                made = model(*_chunk(opened, span))
            except TrackingError as error:
                notes.append(f"chunk {span.index} is left out: {error}")
                continue
            _write(path, made)
        piece = read_piece(path)
        posed.update(piece.frames[np.isfinite(piece.T_world_cam).all(axis=(1, 2))].tolist())
        if progress is not None:
            progress(span.stop, info.frame_count)
    files = sorted(out.glob("chunk-*.npz"))
    if not files:
        raise TrackingError(f"no chunk of {info.path} could be reconstructed: {'; '.join(notes)}")
    alone = [a for a, b in pairwise(spans) if b.start >= a.stop]
    if alone:
        notes.append(f"the video jumps after {len(alone)} chunks; their files share no frames")
    size = sum(p.stat().st_size for p in files)
    return PrecomputeReport(len(files), info.frame_count, len(posed), size, tuple(notes))


def _begin(out: Path, settings: BuildSettings, info: SourceInfo, force: bool) -> None:
    """Write the manifest, or check that the one that is there says the same."""
    metric = settings.poses == "given" or (settings.reconstruction == "rgbd" and info.has_depth)
    named = settings.reconstruction + (f" {settings.weights}" if settings.weights else "")
    chunks = settings.chunks
    manifest = Manifest("metric" if metric else "relative", named, chunks.length, chunks.overlap)
    out.mkdir(parents=True, exist_ok=True)
    if (out / MANIFEST).exists() and not force and read_manifest(out) != manifest:
        raise OptionError(f"{out} holds files of another model or other chunks; give another --out, or --force")
    write_manifest(out, manifest)


def _said(camera: dict[str, Any]) -> str:
    """What the build that reads the files has to be told, so that its pictures are those that were looked at."""
    words = [f"--{name} {','.join(f'{v:.5g}' for v in camera[name])}" for name in ("intrinsics", "distortion")]
    return f"the camera was estimated; give the build the same: {' '.join(words)}"


def _file(out: Path, span: ChunkSpan) -> Path:
    return out / f"chunk-{span.index:04d}.npz"


def _chunk(source: FrameSource, span: ChunkSpan) -> tuple[list[Frame], Camera]:
    """The frames of a chunk that can be decoded, and their camera."""
    frames = [f for f in source.read(span.start, span.stop) if isinstance(f, Frame)]
    if not frames:
        raise TrackingError("no frame of it could be decoded")
    return frames, source.info.camera or guessed_camera(source.info)


def _write(path: Path, made: Reconstruction) -> None:
    """Write a file; until it is whole it has another name."""
    camera, count = made.camera, len(made.frame_indices)
    T = np.where(made.posed[:, None, None], made.T_chunk_cam, np.nan)
    intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (count, 1))
    piece = Piece(made.frame_indices, T, intrinsics, made.depth, made.confidence.astype(np.float32))
    part = path.with_suffix(".part")
    write_piece(part, piece)
    part.replace(path)

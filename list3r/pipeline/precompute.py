"""A video as files of geometry: the chunks of a build, reconstructed and written, for a build somewhere else."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from list3r.frames.base import BadFrame, Frame, FrameSource, SourceInfo, guessed_camera
from list3r.frames.chunking.chunks import ChunkSpan, plan_chunks, shot_of
from list3r.frames.chunking.cuts import find_cuts
from list3r.frames.options import SourceOptions
from list3r.frames.source import check_bad_share, open_source
from list3r.memory.core.address_space import BUILD_MB, check_address_space
from list3r.memory.core.errors import OptionError, TrackingError
from list3r.memory.core.records import JsonFields, SessionCamera
from list3r.pipeline.chunks.calibration import estimated_camera, stated_camera
from list3r.pipeline.chunks.chunk import ChunkTask, reconstruct
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.pipeline.session import prepare
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.target import make_folder
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
from list3r.reconstruction.registry import entry


@dataclass(frozen=True)
class PrecomputeReport(JsonFields):
    """What was written."""

    files: int
    frames: int
    posed: int
    bytes: int
    notes: tuple[str, ...]


def precompute(
    source: str | Path,
    out: Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    run: RunOptions | None = None,
    watch: Watch | None = None,
) -> PrecomputeReport:
    """Reconstruct every chunk of a source and write one file for each into `out`; finished files are kept.

    As in a build, jumps are looked for and an unknown camera is estimated. Raises `SourceError`, and `OptionError` when
    the folder holds files of other settings.
    """
    check_address_space(BUILD_MB, "a reconstruction")
    run, watch = run or RunOptions(), watch or Watch()
    job = prepare(source, options, settings, run, watch=watch)
    watch.tell(job.notes)
    options, settings, info, force = job.options, job.settings, job.info, run.force
    _begin(out, settings, info, force)
    looking = watch.looking("cuts")
    cuts = () if settings.poses == "given" else tuple(find_cuts(job.frames(), settings.cuts, looking))
    spans = plan_chunks(info.frame_count, settings.chunks, cuts)
    notes: list[str] = []
    if force or not all(_file(out, span).exists() for span in spans):
        camera = estimated_camera(job.frames(), options, settings, watch.look)
        if camera is not None:
            options, notes = stated_camera(options, camera), [*camera.notes, _said(camera)]
    opened = open_source(source, options)
    posed: set[int] = set()
    bad: dict[int, str] = {}
    for span in spans:
        path = _file(out, span)
        if force or not path.exists():
            try:
                shot = shot_of(span, cuts, info.frame_count)
                _write(path, *_chunk(ChunkTask(str(source), options, span, settings, shot=shot), opened, bad))
            except TrackingError as error:
                notes.append(f"chunk {span.index} is left out: {error}")
                continue
        piece = read_piece(path)
        posed.update(piece.frames[np.isfinite(piece.T_world_cam).all(axis=(1, 2))].tolist())
        watch.show(span.stop, info.frame_count)
    check_bad_share(len(bad), info.frame_count, next(iter(bad.values()), ""))
    files = sorted(out.glob("chunk-*.npz"))
    if not files:
        why = [note for note in notes if note.startswith("chunk ")]
        raise TrackingError(f"no chunk of {info.path} could be reconstructed: {'; '.join(why)}")
    if bad:
        notes.append(f"{len(bad)} frames could not be used: {next(iter(bad.values()))}")
    alone = [a for a, b in pairwise(spans) if b.start >= a.stop]
    if alone:
        notes.append(f"the video jumps after {len(alone)} chunks; their files share no frames")
    size = sum(p.stat().st_size for p in files)
    return PrecomputeReport(len(files), info.frame_count, len(posed), size, tuple(notes))


def _begin(out: Path, settings: BuildSettings, info: SourceInfo, force: bool) -> None:
    """Write the manifest, or check that the one that is there says the same."""
    metric = settings.poses == "given" or (entry(settings.reconstruction).needs_depth and info.has_depth)
    named = settings.reconstruction + (f" {settings.weights}" if settings.weights else "")
    chunks = settings.chunks
    manifest = Manifest("metric" if metric else "relative", named, chunks.length, chunks.overlap)
    make_folder(out)
    if (out / MANIFEST).exists() and not force and read_manifest(out) != manifest:
        raise OptionError(f"{out} holds files of another model or of other chunks; give another --out, or --force")
    write_manifest(out, manifest)


def _said(camera: SessionCamera) -> str:
    """Options for the build that reads the files, so that it takes the same pictures."""
    values = (("intrinsics", camera.intrinsics), ("distortion", camera.distortion))
    words = [f"--{name} {','.join(f'{v:.5g}' for v in numbers) or 0}" for name, numbers in values]
    return f"the camera was estimated; give the build the same: {' '.join(words)}"


def _file(out: Path, span: ChunkSpan) -> Path:
    return out / f"chunk-{span.index:04d}.npz"


def _chunk(task: ChunkTask, source: FrameSource, bad: dict[int, str]) -> tuple[Reconstruction, dict[int, int]]:
    """The largest part of a chunk that hangs together, and of its frames the numbers, each with that of the frame that
    shows what it shows; why frames cannot be used goes into `bad`. Raises `TrackingError`."""
    found = list(source.read(task.span.start, task.span.stop))
    bad.update((f.index, f.reason) for f in found if isinstance(f, BadFrame))
    frames = [f for f in found if isinstance(f, Frame)]
    if not frames:
        raise TrackingError("no frame of it could be decoded")
    _, parts, repeats = reconstruct(task, source, frames, source.info.camera or guessed_camera(source.info))
    shown = {r.index: r.shown for r in repeats}
    return max(parts, key=lambda part: int(part.posed.sum())), {f.index: shown.get(f.index, f.index) for f in frames}


def _write(path: Path, made: Reconstruction, shown: dict[int, int]) -> None:
    """Write a file; until it is whole it has another name."""
    place = {index: k for k, index in enumerate(made.frame_indices.tolist())}
    held = {index: place[s] for index, s in sorted(shown.items()) if s in place}
    camera, rows = made.camera, list(held.values())
    T = np.where(made.posed[:, None, None], made.T_chunk_cam, np.nan)[rows]
    intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (len(rows), 1))
    noise = None if made.depth_noise is None else np.array(astuple(made.depth_noise))
    indices, confidence = np.array(list(held), np.int64), made.confidence[rows].astype(np.float32)
    piece = Piece(indices, T, intrinsics, made.depth[rows], confidence, depth_noise=noise)
    part = path.with_suffix(".part")
    try:
        write_piece(part, piece)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OptionError(
            f"{path} cannot be written: {error.strerror or error}; finished files are kept: run the command again"
        ) from error

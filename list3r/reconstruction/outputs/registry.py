"""The programs whose output is read, and its conversion to a folder of `precomputed`."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from list3r.memory.core.errors import ExportError, SourceError
from list3r.reconstruction.outputs.arrays import ArraysReader
from list3r.reconstruction.outputs.base import OutputOptions, OutputReader
from list3r.reconstruction.outputs.chunks import ChunksReader
from list3r.reconstruction.outputs.cut3r import Cut3rReader
from list3r.reconstruction.outputs.entitysam import EntityMasks
from list3r.reconstruction.outputs.scal3r import Scal3rReader
from list3r.reconstruction.precomputed_files import write_manifest, write_piece

READERS: tuple[OutputReader, ...] = (ArraysReader(), ChunksReader(), Cut3rReader(), Scal3rReader())


def convert_predictions(path: Path, folder: Path, options: OutputOptions | None = None) -> int:
    """Write the folder of `precomputed` from a program's saved output; the number of frames, each counted once.

    Raises `SourceError` for no such output, `OptionError` for a damaged one, `ExportError` for a folder that
    exists or cannot be written.
    """
    reader = next((r for r in READERS if r.recognises(path)), None)
    if reader is None:
        known = "; ".join(r.name for r in READERS)
        what = "is not a known output" if path.exists() else "does not exist"
        raise SourceError(f"{path} {what}; give {known}")
    if folder.exists():
        raise ExportError(f"{folder} already exists; name another folder or remove it first")
    if not folder.parent.is_dir():
        raise ExportError(f"the folder {folder.parent} does not exist; create it first")
    chosen = options or OutputOptions()
    output = reader.read(path, chosen)
    masks = None if chosen.masks is None else EntityMasks(chosen.masks, chosen.every)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    frames: set[int] = set()
    try:
        temporary.mkdir()
        for n, piece in enumerate(output.pieces):
            write_piece(temporary / f"predictions-{n:06d}.npz", piece if masks is None else masks.added(piece))
            frames.update(piece.frames.tolist())
        write_manifest(temporary, output.manifest)
        temporary.rename(folder)
    except OSError as error:
        raise ExportError(f"{folder} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return len(frames)

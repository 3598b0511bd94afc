"""Options of build and update besides the source and the memory."""

from __future__ import annotations

from dataclasses import dataclass

from list3r.cli.build.source_options import SourceArguments
from list3r.pipeline.request import BuildRequest, RunOptions


@dataclass(frozen=True)
class BuildOptions:
    """How a video is read and reconstructed, and how the work runs, as options."""

    request: BuildRequest
    given: SourceArguments
    run: RunOptions

"""The options that describe a source, the same on every command that reads one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.pipeline.request import option

if TYPE_CHECKING:
    from list3r.frames.options import SourceOptions

SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="A video file or a folder of frames; for build also a webcam (/dev/video0), a stream's URL or record3d:.",
        show_default=False,
    ),
]
MoreArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="MORE", help="Further video files of the same recording, in order.", show_default=False),
]


@dataclass(frozen=True)
class SourceArguments:
    """What is said of a source, as it was given."""

    kind: str = option("auto", "Format of the source: auto, or a name from docs/sources.md.", "FORMAT")
    every: int = option(1, "Take every N-th frame.", "N")
    frames: str | None = option(None, "Take frames START to STOP only, before --every.", "START:STOP")
    intrinsics: str | None = option(None, "Colour camera, px.", "FX,FY,CX,CY")
    distortion: str | None = option(None, "Lens of the colour camera (OpenCV).", "K1,K2,P1,P2,K3")
    depth_intrinsics: str | None = option(None, "Depth camera, px, if depth is not registered.", "FX,FY,CX,CY")
    depth_to_color: str | None = option(
        None,
        "From depth camera to colour camera: tx,ty,tz,qx,qy,qz,qw in metres, a 4x4 matrix row by row, or a file.",
        "TRANSFORM",
    )
    topics: str | None = option(
        None,
        "Topics of a ROS recording (color=/a,depth=/b,pose=/c) or cameras of LeRobot; default: matching ones.",
        "ROLE=TOPIC,...",
    )
    episode: int | None = option(None, "Episode of a LeRobot data set.", "N")
    registered: bool = option(False, "Depth already is on the colour image's pixels.")
    depth_scale: float | None = option(None, "Stored depth units per metre.", "UNITS")
    fps: float | None = option(
        None,
        "Take this many frames per second; for a source without time stamps, the rate at which it was filmed.",
        "RATE",
    )
    start: float | None = option(None, "Begin this many seconds after the first frame.", "SECONDS")
    end: float | None = option(None, "Stop this many seconds after the first frame.", "SECONDS")
    sharpest: bool | None = option(
        None,
        "With --every or --fps, take the sharpest frame of each group; default: on for videos.",
        flag="--sharpest/--no-sharpest",
    )
    max_side: int | None = option(
        None, "Reduce larger pictures to this side (0: never); default: 960, with depth 1280.", "PX"
    )

    def options(self, more: list[str] | None = None) -> SourceOptions:
        """Return the parsed options, with further files of the recording. Raises `OptionError` naming the option."""
        from list3r.frames import options as parsing

        first, stop = parsing.parse_range(self.frames) if self.frames else (None, None)
        color, depth, transform = self.intrinsics, self.depth_intrinsics, self.depth_to_color
        return parsing.SourceOptions(
            kind=self.kind,
            every=self.every,
            start=first,
            stop=stop,
            intrinsics=parsing.parse_intrinsics(color, "--intrinsics") if color else None,
            distortion=parsing.parse_distortion(self.distortion) if self.distortion else None,
            depth_intrinsics=parsing.parse_intrinsics(depth, "--depth-intrinsics") if depth else None,
            T_color_depth=parsing.parse_transform(transform, "--depth-to-color") if transform else None,
            topics=parsing.parse_topics(self.topics) if self.topics else None,
            episode=self.episode,
            registered=self.registered,
            depth_scale=self.depth_scale,
            fps=self.fps,
            start_s=self.start,
            end_s=self.end,
            sharpest=self.sharpest,
            max_side=self.max_side,
            more=tuple(more) if more else None,
        )

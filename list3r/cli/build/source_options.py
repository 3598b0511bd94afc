"""The options that describe a source, the same on every command that reads one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

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
Kind = Annotated[
    str, typer.Option("--kind", metavar="FORMAT", help="Format of the source: auto, or a name from docs/sources.md.")
]
Every = Annotated[int, typer.Option("--every", metavar="N", help="Take every N-th frame.")]
Frames = Annotated[
    str | None,
    typer.Option("--frames", metavar="START:STOP", help="Take frames START to STOP only, before --every."),
]
Intrinsics = Annotated[str | None, typer.Option("--intrinsics", metavar="FX,FY,CX,CY", help="Colour camera, px.")]
Distortion = Annotated[
    str | None, typer.Option("--distortion", metavar="K1,K2,P1,P2,K3", help="Lens of the colour camera (OpenCV).")
]
DepthIntrinsics = Annotated[
    str | None,
    typer.Option("--depth-intrinsics", metavar="FX,FY,CX,CY", help="Depth camera, px, if depth is not registered."),
]
DepthToColor = Annotated[
    str | None,
    typer.Option(
        "--depth-to-color",
        metavar="TRANSFORM",
        help="From depth camera to colour camera: tx,ty,tz,qx,qy,qz,qw in metres, a 4x4 matrix row by row, or a file.",
    ),
]
Topics = Annotated[
    str | None,
    typer.Option(
        "--topics",
        metavar="ROLE=TOPIC,...",
        help="Topics of a ROS recording (color=/a,depth=/b,pose=/c) or cameras of LeRobot; default: matching ones.",
    ),
]
Episode = Annotated[
    int | None, typer.Option("--episode", metavar="N", help="Episode of a LeRobot data set.", show_default=False)
]
Registered = Annotated[bool, typer.Option("--registered", help="Depth already is on the colour image's pixels.")]
DepthScale = Annotated[
    float | None, typer.Option("--depth-scale", metavar="UNITS", help="Stored depth units per metre.")
]
Fps = Annotated[
    float | None,
    typer.Option(
        "--fps",
        metavar="RATE",
        help="Take this many frames per second; for a source without time stamps, the rate at which it was filmed.",
    ),
]
Start = Annotated[
    float | None, typer.Option("--start", metavar="SECONDS", help="Begin this many seconds after the first frame.")
]
End = Annotated[
    float | None, typer.Option("--end", metavar="SECONDS", help="Stop this many seconds after the first frame.")
]
Sharpest = Annotated[
    bool | None,
    typer.Option(
        "--sharpest/--no-sharpest",
        help="With --every or --fps, take the sharpest frame of each group; default: on for videos.",
        show_default=False,
    ),
]
MaxSide = Annotated[
    int | None,
    typer.Option(
        "--max-side",
        metavar="PX",
        help="Reduce larger pictures to this side (0: never); default: 960, with depth 1280.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class SourceArguments:
    """The options above as they were given."""

    kind: Kind = "auto"
    every: Every = 1
    frames: Frames = None
    intrinsics: Intrinsics = None
    distortion: Distortion = None
    depth_intrinsics: DepthIntrinsics = None
    depth_to_color: DepthToColor = None
    topics: Topics = None
    episode: Episode = None
    registered: Registered = False
    depth_scale: DepthScale = None
    fps: Fps = None
    start: Start = None
    end: End = None
    sharpest: Sharpest = None
    max_side: MaxSide = None

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

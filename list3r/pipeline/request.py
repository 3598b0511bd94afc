"""What a user asks of a build or an update: the arguments of Python and the options of the command line, written once.

A field with help is an option of the commands; `list3r.cli.common.expanded` makes it from its definition here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

Progress = Callable[[int, int], None]
"""Called with (frames done, frames in all) at the start and after every chunk."""
Look = Callable[[str, int, int], None]
"""Called with (what is looked for, done, in all) while a video is looked at before its chunks, or named after them."""


@dataclass(frozen=True)
class Help:
    """How a field is shown as an option of a command."""

    text: str
    metavar: str | None = None
    flag: str | None = None
    """The option, where it is not the field's name."""


def option(default: Any, text: str, metavar: str | None = None, flag: str | None = None) -> Any:
    """Return a field of a dataclass that is also an option of commands."""
    return field(default=default, metadata={"help": Help(text, metavar, flag)})


@dataclass(frozen=True)
class BuildRequest:
    """Which models work on a video and how it is cut. What is left out is chosen by the source and the machine.

    A resumed build or update takes what is left out from the session that it goes on with.
    """

    reconstruction: str | None = option(
        None,
        "rgbd, sfm, pi3, pi3x, vggt, mapanything, da3, dust3r, mast3r, cut3r, ttt3r, fast3r, precomputed or auto "
        "(rgbd with depth, else sfm).",
        "MODEL",
    )
    preset: str | None = option(
        None,
        "cpu: nothing to download; light: small networks, free for any use; auto: what this machine can run.",
        "cpu|light|paper|auto",
    )
    discovery: str | None = option(
        None, "Model that finds things; default: learned.", "learned|eomt|mask2former|sam2|sam3|precomputed"
    )
    tracking: str | None = option(
        None, "Model that follows things from frame to frame.", "reprojection|sam2|sam3|edgetam"
    )
    features: str | None = option(
        None, "Model that describes the look of a thing; default: by --discovery.", "geometric|own|dinov2|dinov3"
    )
    device: str = option("auto", "Where networks run.", "auto|cpu|cuda|cuda:N")
    weights: tuple[str, ...] = option(
        (),
        "Weights instead of the model's own: a folder, a file or owner/name@revision. PART is reconstruction (the "
        "default), discovery, tracking or features.",
        "[PART=]WHERE",
    )
    local_features: str = option(
        "sift",
        "Features by which keyframes are matched: sift, or aliked=FILE with its weights. With colour alone, aliked "
        "also joins frames that optical flow cannot.",
        "KIND[=FILE]",
    )
    poses: str = option(
        "auto",
        "Camera poses. estimate: from the pictures; given: from the source; prior: given, then corrected; auto: prior"
        " for phones with depth, given for other sources with poses, else estimate.",
        "auto|estimate|given|prior",
    )
    up: str | None = option(
        None,
        "Which way is up: camera (as it was held), unknown, or x,y,z: in the world of given poses, else in the axes "
        "of the first camera (x right, y down, z ahead); default: by surfaces, else as the camera was held.",
        "camera|x,y,z|unknown",
    )
    association: str | None = option(
        None,
        "How chunks are joined: list3r; paper (the paper's steps as written); frames (no instances, VGGT-Long's "
        "rule). For comparison on your own video.",
        "list3r|paper|frames",
    )
    chunk: int | None = option(None, "Frames in a chunk; default: 100, with a network as many as the GPU holds.", "N")
    overlap: int | None = option(None, "Frames that neighbouring chunks share; default: 30 %.", "N")
    depth_every: int | None = option(
        None,
        "With colour alone or a depth sensor: depth and things from every n-th frame, the others get a pose; default:"
        " by how fast the picture moves.",
        "N",
    )
    pictures: bool = option(True, "Keep a JPEG of each keyframe.", flag="--pictures/--no-pictures")


@dataclass(frozen=True)
class RunOptions:
    """How a build or an update is run, and what is done to the memory once the video is in it."""

    licence: str = option(
        "research",
        "Licences that weights may have. permissive: none that is non-commercial, gated, copyleft or custom.",
        "permissive|research|any",
    )
    workers: int | None = option(
        None, "Worker processes; 0: work in this process; default: one per core, at most 4.", "N"
    )
    engine: str = option(
        "local", "Where chunks are processed: local, or ray (a cluster whose machines all see SOURCE at the same path)."
    )
    address: str | None = option(
        None, "Address of the Ray cluster; default: RAY_ADDRESS, else a cluster started here.", "HOST:PORT"
    )
    scale_anchor: str | None = option(
        None,
        "A length that you know, for videos without depth: camera_height=1.5m, x,y,z:x,y,z=1.2m or ID=0.095m.",
        "ANCHOR",
    )
    names: str = option(
        "none",
        "Who names things: detector (NanoDet, 2 MB are fetched once) or open (OWLv2, about 0.6 GB).",
        "none|detector|open",
    )
    detector: Path | None = option(
        None, "A NanoDet box detector for ncnn (.param, with its .bin beside it) that names things.", "FILE"
    )
    detector_classes: Path | None = option(
        None, "The detector's classes, one name per line; default: the 80 classes of COCO.", "FILE"
    )
    live: bool = option(
        False, "build: SOURCE is a folder or recording that still grows. Webcams and streams are always live."
    )
    resume: bool = option(False, "Continue a build or update that was interrupted.")
    force: bool = option(False, "build: replace an existing memory. update: give up an update that was interrupted.")


class RunArguments(TypedDict, total=False):
    """The fields of `RunOptions` as arguments of Python."""

    licence: str
    workers: int | None
    engine: str
    address: str | None
    scale_anchor: str | None
    names: str
    detector: Path | None
    detector_classes: Path | None
    live: bool
    resume: bool
    force: bool


@dataclass(frozen=True)
class Watch:
    """Who hears of the work while it goes on."""

    progress: Progress | None = None
    look: Look | None = None
    note: Callable[[str], None] | None = None
    """Called with what the user should know before the work begins, one sentence each."""
    debug_dir: Path | None = None
    """Folder for pictures of what was found."""

    def tell(self, notes: Iterable[str]) -> None:
        """Hand on notes."""
        if self.note is not None:
            for line in notes:
                self.note(line)

    def show(self, done: int, total: int) -> None:
        """Hand on how many frames are done, of all."""
        if self.progress is not None:
            self.progress(done, total)

    def looking(self, what: str) -> Progress | None:
        """Return who hears of the progress in looking for something."""
        look = self.look
        return None if look is None else (lambda done, total: look(what, done, total))

"""picture: the stored picture that shows an instance best."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import IdArgument, JsonOption, MemoryArgument, open_memory
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError


def picture(
    memory: MemoryArgument,
    instance_id: IdArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Default: instance_ID.jpg.")] = None,
    whole: Annotated[bool, typer.Option("--whole", help="The whole frame with its outline instead of a crop.")] = False,
    json: JsonOption = False,
) -> None:
    """Write the stored picture that shows an instance best: large, complete and not hidden.

    Example: list3r picture house.l3r 12 --out mug.jpg
    """
    from PIL import Image

    from list3r.exporters.output import replacing

    out = out or Path(f"instance_{instance_id}.jpg")
    if out.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise OptionError(f"--out {out}: name a .jpg or .png file")
    with open_memory(memory) as scene:
        found = scene.picture(instance_id)
    with replacing(out) as temporary:
        Image.fromarray(found.marked() if whole else found.crop()).save(temporary, quality=92)
    if json:
        fields = {"id": found.instance_id, "session": found.session_id, "frame": found.frame_index}
        print_answer([{**fields, "box_xyxy": found.box_xyxy, "followed": found.mask is not None, "path": str(out)}])
    else:
        say(f"{out}  frame {found.frame_index} of session {found.session_id}, {found.visible_fraction:.0%} visible")

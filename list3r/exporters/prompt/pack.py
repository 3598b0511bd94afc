"""The pack for a vision language model: text, maps, marked views and crops in one folder."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from list3r.exporters.output import replacing_folder
from list3r.exporters.prompt.cognitive_map import cognitive_maps
from list3r.exporters.prompt.coverage import cover
from list3r.exporters.prompt.marks import draw_marks
from list3r.exporters.prompt.scene_text import scene_prompt
from list3r.exporters.prompt.tokens import counted_by
from list3r.memory.core.errors import OptionError
from list3r.queries.pictures import KeyframePicture

if TYPE_CHECKING:
    from list3r.api import SceneMemory

_OURS = "list3r-prompt.json"
"""Names the files of a pack; a folder that holds it may be replaced."""


@dataclass(frozen=True)
class PackSettings:
    """Content of a pack."""

    tokens: int = 2000
    """Budget of the text."""
    question: str | None = None
    """Instances that it names come first."""
    least_visible: float = 0.3
    """Share of an instance that must show for a view to count for it."""
    least_side_px: float = 12.0
    """Side of a square of the area of its mask, likewise."""


def write_prompt(memory: SceneMemory, folder: str | Path, settings: PackSettings | None = None) -> tuple[Path, ...]:
    """Write scene.md, cognitive_map.json, map.png, views/ and crops/ to a folder; return the files.

    The views are the fewest stored keyframes that together show every listed instance. An earlier pack is replaced,
    another folder is not, and an interruption leaves the earlier state. Raises `OptionError` and `ExportError`.
    """
    folder, settings = Path(folder), settings or PackSettings()
    prompt = scene_prompt(memory, settings.tokens, settings.question)
    instances = [i for i in memory.instances(structure=None) if i.state != "removed"]
    objects = {i.id for i in instances if i.structure is None}
    listed = [n for n in prompt.listed if n in objects]
    with replacing_folder(folder, "prompt") as temporary:
        (temporary / "scene.md").write_text(prompt.text, encoding="utf-8")
        maps = cognitive_maps([i for i in instances if i.id in set(listed)], memory.units)
        maps["left_out"] = len(objects) - len(listed)
        (temporary / "cognitive_map.json").write_text(json.dumps(maps, indent=1) + "\n", encoding="utf-8")
        memory.export("plan", temporary / "map.png")
        views = _write_views(memory, temporary / "views", listed, settings)
        crops = _write_crops(memory, temporary / "crops", listed)
        manifest = {
            "format": "list3r-prompt",
            "version": 1,
            "memory": memory.path.name,
            "question": settings.question,
            "tokens": prompt.tokens,
            "counted_by": counted_by(),
            "listed": list(prompt.listed),
            "views": views,
            "without_picture": sorted(set(listed) - crops),
        }
        (temporary / _OURS).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def chosen_views(
    pictures: Sequence[KeyframePicture], listed: Sequence[int], settings: PackSettings | None = None
) -> list[KeyframePicture]:
    """Return the fewest pictures in which every listed instance shows that is readable in any of them.

    An instance that is nowhere readable counts in the picture that shows it best.
    """
    s, wanted = settings or PackSettings(), set(listed)
    shows: dict[int, set[int]] = {n: set() for n in range(len(pictures))}
    best: dict[int, tuple[float, int]] = {}
    sights = ((n, sight) for n, picture in enumerate(pictures) for sight in picture.sights)
    for n, sight in sights:
        if sight.instance_id not in wanted:
            continue
        best[sight.instance_id] = max(best.get(sight.instance_id, (-1.0, 0)), (sight.worth(), -n))
        if sight.visible_fraction >= s.least_visible and sight.area_px >= s.least_side_px**2:
            shows[n].add(sight.instance_id)
    readable = set[int]().union(*shows.values())
    for instance_id, (_, n) in best.items():
        if instance_id not in readable:
            shows[-n].add(instance_id)
    return [pictures[n] for n in cover(shows)]


def _write_views(
    memory: SceneMemory, folder: Path, listed: Sequence[int], settings: PackSettings
) -> list[dict[str, object]]:
    folder.mkdir()
    out: list[dict[str, object]] = []
    for picture in chosen_views(memory.pictures(listed), listed, settings):
        sights = [s for s in picture.sights if s.instance_id in set(listed)]
        name = f"session{picture.session_id}_frame{picture.frame_index:06d}.jpg"
        draw_marks(memory.pixels(picture), sights).save(folder / name, quality=90)
        out.append({"file": f"views/{name}", "instances": [s.instance_id for s in sights]})
    return out


def _write_crops(memory: SceneMemory, folder: Path, listed: Sequence[int]) -> set[int]:
    """Write the best picture of each instance; returns the ids of instances with a picture."""
    folder.mkdir()
    written = set()
    for instance_id in listed:
        with contextlib.suppress(OptionError):
            crop = memory.picture(instance_id).crop()
            Image.fromarray(np.ascontiguousarray(crop)).save(folder / f"{instance_id}.jpg", quality=90)
            written.add(instance_id)
    return written

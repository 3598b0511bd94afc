"""What pages that open from disk share: data that no name can break out of, and small pictures."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.memory.core.records import Instance


def embedded(data: object) -> str:
    """Return JSON that ends no script element and opens no comment."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def numbers(values: Iterable[float], digits: int = 3) -> list[float | None]:
    """Return rounded numbers for JSON, None for what is not finite."""
    return [round(float(v), digits) + 0.0 if np.isfinite(v) else None for v in values]


def thumbnail(memory: SceneMemory, instance_id: int, side_px: int) -> str | None:
    """Return a JPEG of an instance in Base64, at most so large; None where no stored picture shows it."""
    from PIL import Image

    try:
        crop = memory.picture(instance_id).crop()
    except OptionError:
        return None
    image = Image.fromarray(np.ascontiguousarray(crop))
    image.thumbnail((side_px, side_px))
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=80)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def thumbnails(memory: SceneMemory, instances: Iterable[Instance], most: int, side_px: int) -> dict[str, str]:
    """Return thumbnails by id, of the things seen most."""
    objects = [i for i in instances if i.structure is None and i.state != "removed"]
    chosen = sorted(objects, key=lambda i: (-i.observations, i.id))[:most]
    made = {str(i.id): thumbnail(memory, i.id, side_px) for i in chosen}
    return {n: picture for n, picture in made.items() if picture is not None}

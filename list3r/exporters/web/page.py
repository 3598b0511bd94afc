"""Write a page to look at: the scene, the list of its things and a search in one HTML file that needs no network."""

from __future__ import annotations

import base64
import html
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.components import point_spacing
from list3r.exporters.output import replacing
from list3r.exporters.pages import embedded, numbers, thumbnails
from list3r.memory.core.description.nouns import all_nouns, kinds_of, nouns_of
from list3r.memory.core.description.printable import shown
from list3r.queries.views.fused import Surface, fewer

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.memory.core.records import Instance

_STEPS = 65535
"""Places along each side of the scene's box."""
_PLACE_CHARACTERS, _FACE_CHARACTERS = 12, 16
"""In the page, in Base64: of a place three numbers of two bytes and three of one, of a face three of four bytes."""
_LEAST = 200
"""Places of a thing that are kept where half of the file has room for them."""
_LENGTHS = {
    "metric": "Lengths are metres, as a sensor or given poses have them.",
    "anchored": "Lengths are metres, by one length that somebody gave.",
    "guessed": "Nobody measured a metre: it is guessed from the usual sizes of things, give or take {:.0%}.",
    "relative": "How long a metre is here is not known: lengths are in a unit of the memory's own.",
}
_UP = {
    "assumed": " Which way is up is assumed from how the camera was held.",
    "unknown": " Which way is up is not known: the scene may lie on its side.",
}


@dataclass(frozen=True)
class WebSettings:
    """Content of a page."""

    megabytes: float = 10.0
    """Size of the file, about; so much of the surfaces is kept."""
    crops: int = 500
    """Number of things with a picture, those seen most."""
    crop_px: int = 96
    """Longer side of a picture."""


def write_web(memory: SceneMemory, path: str | Path, settings: WebSettings | None = None) -> tuple[Path, ...]:
    """Write the page. Returns the file written.

    Names are data in it as JSON, which its script shows as text, never as markup; a policy in its head forbids it to
    load anything. Parts that are not placed against the main one are listed, but not drawn.
    """
    path, settings = Path(path), settings or WebSettings()
    parts = {part: _read(f"page.{part}") for part in ("css", "js")}
    with replacing(path) as temporary:
        instances = [i for i in memory.instances(structure=None) if i.state != "removed"]
        crops = thumbnails(memory, instances, settings.crops, settings.crop_px)
        places = {(f.session_id, f.frame_index): S.translation for f, S in memory.camera_poses()}
        main = _main_component(memory)
        drawn = {0, *(i.id for i in instances if i.component == main)}
        surfaces = {n: s for n, s in memory.surfaces().items() if n in drawn and len(s.vertices)}
        data = _about(memory) | {
            "instances": [_instance(i, places.get(_best(i) or (-1, -1))) for i in instances],
            "nouns": _nouns(instances),
            "crops": crops,
            "elsewhere": sum(i.component != main for i in instances),
        }
        left = 1e6 * settings.megabytes - len(embedded(data)) - sum(map(len, parts.values()))
        points, cloud = _scene(surfaces, max(left, 12_000.0))
        data |= {"cloud": cloud}
        parts |= {"title": html.escape(shown(memory.path.name)), "data": embedded(data), "points": points}
        text = re.sub(r"\{(title|css|js|data|points)\}", lambda found: parts[found[1]], _read("page.html"))
        temporary.write_text(text, encoding="utf-8")
    return (path,)


def _read(name: str) -> str:
    return resources.files("list3r.exporters.web").joinpath(name).read_text(encoding="utf-8")


def _main_component(memory: SceneMemory) -> int:
    """Return the component of most posed frames."""
    component = {c.chunk_id: c.component for c in memory.store.chunks.all()}
    frames = [component[f.chunk_id] for f, _ in memory.camera_poses()]
    return max(sorted(set(frames)), key=frames.count, default=0)


def _about(memory: SceneMemory) -> dict[str, Any]:
    lengths = memory.lengths
    said = _LENGTHS[lengths.metric].format(lengths.deviation or 0.3)
    return {"name": shown(memory.path.name), "units": str(lengths), "lengths": said + _UP.get(memory.gravity, "")}


def _instance(i: Instance, eye: NDArray[np.float64] | None) -> dict[str, Any]:
    """`eye`: where the camera was that saw it best, for there nothing hides it; world, shape (3,)."""
    called = i.label or i.structure or i.description.split(",")[0] or "thing"
    return {
        "id": i.id,
        "name": shown(called),
        "description": shown(i.description),
        "structure": i.structure is not None,
        "state": "seen moving" if i.dynamic else "" if i.state == "present" else i.state,
        "confidence": round(float(i.confidence), 2),
        "center": numbers(i.center),
        "size": numbers(i.box.size),
        "corners": numbers(i.box.corners().ravel()),
        "nouns": nouns_of(called)[:1],
        "eye": None if eye is None else numbers(eye),
    }


def _best(i: Instance) -> tuple[int, int] | None:
    return None if i.best_view is None else (i.best_view.session_id, i.best_view.frame_index)


def _nouns(instances: list[Instance]) -> dict[str, list[str]]:
    """Return other words for the nouns of a scene, in all languages, and what they are kinds of."""
    out = {}
    for noun in sorted({n for i in instances for n in nouns_of(i.label or i.structure or i.description.split(",")[0])}):
        known = all_nouns()[noun]
        foreign = [name for names in known.foreign.values() for name in names]
        out[noun] = [*known.synonyms, *foreign, *kinds_of(noun)]
    return out


def _scene(surfaces: dict[int, Surface], most: float) -> tuple[str, dict[str, Any]]:
    """Return surfaces in about so many characters of Base64, faces before places before colours, and what tells how to
    read them: of each instance its id, how many places and faces are its, and how large to draw points without faces.
    """
    known = sum(len(s.vertices) for s in surfaces.values())
    needed = sum(_PLACE_CHARACTERS * len(s.vertices) + _FACE_CHARACTERS * len(s.faces) for s in surfaces.values())
    share, runs, faces, first = min(1.0, most / max(needed, 1)), [], [np.zeros((0, 3), np.uint32)], 0
    least = min(_LEAST, most / _PLACE_CHARACTERS / (2 * max(len(surfaces), 1)))
    parts = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for n, whole in surfaces.items():
        s = fewer(whole, max(share, min(1.0, least / len(whole.vertices)))) if share < 1 else whole
        size = 0.0 if len(s.faces) else 1.5 * point_spacing(s.vertices)
        runs.append([n, len(s.vertices), round(size, 5), len(s.faces)])
        parts[0].append(s.vertices.astype(np.float64))
        parts[1].append(s.rgb)
        faces.append((s.faces + first).astype("<u4"))
        first += len(s.vertices)
    xyz, rgb, corners = np.concatenate(parts[0]), np.concatenate(parts[1]), np.concatenate(faces)
    low, span = (xyz.min(axis=0), float(np.ptp(xyz, axis=0).max()) or 1.0) if len(xyz) else (np.zeros(3), 1.0)
    steps: NDArray[np.uint16] = np.round((xyz - low) / span * _STEPS).astype("<u2")
    told = {"low": numbers(low, 6), "span": span, "runs": runs, "kept": len(xyz), "known": known, "faces": len(corners)}
    content = corners.astype("<u4").tobytes() + steps.tobytes() + rgb.tobytes()
    return base64.b64encode(content).decode("ascii"), told

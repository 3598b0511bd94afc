"""What lies beside pictures: which files are depth, confidence, poses or a camera, and which belongs to which picture.

The law of every folder: what looks like one of these is read, or the folder is refused with what to do.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import IMAGE_ENDINGS, natural_key, read_lines
from list3r.frames.readers.tum import MAX_PAIR_GAP_S, associate
from list3r.frames.recordings.stamps import as_seconds, times_of_names
from list3r.memory.core.errors import SourceError

Role = Literal["color", "depth", "confidence", "mask"]
_WORDS: dict[Role, tuple[str, ...]] = {
    "confidence": ("conf", "confs", "confidence", "confidences"),
    "mask": (
        *("mask", "masks", "ids", "label", "labels", "instance", "instances", "semantic", "semantics", "segmentation"),
        *("normal", "normals", "ir", "infrared", "infra"),
    ),
    "depth": ("depth", "depths", "depthmap", "depthmaps", "depthimage", "depthimages"),
    "color": ("rgb", "color", "colour", "colors", "image", "images", "img", "imgs"),
}
"""Words of names, the strongest first: `depth_confidence` is confidence, `depth_to_color` depth."""
_OF_DEPTH = {"png", "exr", "raw", "mm", "map", "maps", "frame", "frames", "registered", "aligned"}
"""Words that only say more of depth."""
_FIRST_FOLDERS = ("images", "rgb", "color", "colour", "image")
"""Names of folders of pictures, of which a folder may have several; the first is read."""
_DEPTH_ENDINGS = (*IMAGE_ENDINGS, ".npy", ".exr")
_ASSOCIATIONS = re.compile(r"assoc\w*\.txt", re.IGNORECASE)
_POSES = re.compile(
    r"(\w+_)?(poses?|traj(ectory)?|trajectories|groundtruth|ground_truth|odometry|odom|extrinsics?)"
    r"(\.(txt|csv|json|log|npy|npz|ya?ml))?|transforms\w*\.json|.*\.(log|traj)",
    re.IGNORECASE,
)
_CAMERA = re.compile(
    r"(.*intrinsics?.*|cameras?|cam_params|cam|.*calib(ration)?|k)(\.(txt|csv|json|npy|npz|ya?ml|xml))?", re.IGNORECASE
)


def role_of(name: str) -> Role | None:
    """Return what the words of a file's or folder's name say that it is; None where they say nothing."""
    words = _words(name)
    return next((role for role, known in _WORDS.items() if words & set(known)), None)


def _words(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def listed(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """Files of these endings that are not hidden, in natural order; empty for what is not a folder."""
    if not folder.is_dir():
        return []
    found = (p for p in folder.iterdir() if p.name.lower().endswith(endings) and not p.name.startswith("."))
    return sorted((p for p in found if p.is_file()), key=lambda p: natural_key(p.name))


def is_deep(path: Path) -> bool:
    """Whether a file holds one number of over 8 bits a pixel, as depth does; by its head alone."""
    ending = path.suffix.lower()
    if ending in (".npy", ".exr"):
        return True
    if ending == ".png":
        with path.open("rb") as file:
            head = file.read(26)
        return len(head) == 26 and head[24:26] == b"\x10\x00"
    if ending not in (".tif", ".tiff", ".pgm"):
        return False
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.mode.startswith(("I", "F"))
    except Exception:  # whatever the readers of thirty formats raise: it is looked at again when it is decoded
        return False


@dataclass(frozen=True)
class FoundFrames:
    """The pictures of a folder and what lies beside them, by what it is."""

    colors: list[Path]
    depths: list[Path] = field(default_factory=list)
    confidences: list[Path] = field(default_factory=list)
    notes: tuple[str, ...] = ()


def look(root: Path, *, alone: bool = False) -> FoundFrames | None:
    """The pictures in a folder, or in the one of its folders that is named as such; None where there are none.

    `alone`: depth that lies beside the folder itself may be left. Raises `SourceError` for a folder of depth, and where
    several folders may be the depth.
    """
    own, here = _by_role(root), root.resolve()
    folders = {p: _by_role(p) for p in sorted(root.iterdir()) if p.is_dir() and not p.name.startswith(".")}
    folder = root if own["color"] else _color_folder(root, folders)
    if folder is None:
        if own["depth"] and _all_deep(own["depth"]):
            raise SourceError(f"{root} holds depth images and no pictures; give the folder that holds both")
        return None
    if folder == root and not alone and role_of(here.name) == "color" and (deeper := depth_beside(here)):
        raise SourceError(
            f"{root} has depth beside it, {deeper}, which would be lost; give the folder {here.parent}, or use --kind "
            "images to take colour alone"
        )
    inside = own if folder == root else folders[folder]
    others = {p: held for p, held in folders.items() if p != folder}
    depths = inside["depth"] or _folder_of("depth", others)
    confidences = inside["confidence"] or _folder_of("confidence", others)
    masks = len(inside["mask"])
    notes = (f"{masks} images beside the pictures are named as masks and not read",) if masks else ()
    return FoundFrames(inside["color"], depths, confidences, notes)


def _by_role(folder: Path) -> dict[Role, list[Path]]:
    """The images of a folder by what they are. One kind alone is pictures, whatever its name, but for depth."""
    out: dict[Role, list[Path]] = {"color": [], "depth": [], "confidence": [], "mask": []}
    for path in listed(folder, _DEPTH_ENDINGS):
        role = role_of(path.stem)
        if role is not None or path.suffix.lower() not in (".npy", ".exr"):
            out[role or "color"].append(path)
    deep = {p for p in out["color"] if is_deep(p)} if len(out["color"]) <= _MOST_LOOKED_AT else set()
    if 0 < len(deep) < len(out["color"]):
        out["depth"] += [p for p in out["color"] if p in deep]
        out["color"] = [p for p in out["color"] if p not in deep]
    if role_of(folder.resolve().name) == "depth" and len(deep) == len(out["color"]):
        out["depth"], out["color"] = out["depth"] + out["color"], []
    stems = {p.stem for p in out["color"]}
    out["depth"] += [
        p for p in listed(folder, (".npy", ".exr")) if p.stem in stems or (not stems and role_of(p.stem) is None)
    ]
    if not out["color"]:
        depth = out["depth"] and (role_of(folder.name) == "depth" or is_deep(out["depth"][0]))
        others: tuple[Role, ...] = ("confidence", "mask", "depth")
        single = [role for role in others if out[role]]
        if len(single) == 1 and not depth:
            out["color"], out[single[0]] = out[single[0]], []
    return out


_MOST_LOOKED_AT = 20_000


def _color_folder(root: Path, folders: Mapping[Path, Mapping[Role, list[Path]]]) -> Path | None:
    """The folder of pictures: the one named as such, or the only one beside depth whose name says nothing."""
    full = [p for p, held in folders.items() if held["color"] and not _all_deep(held["color"])] or [
        p for p, held in folders.items() if held["color"]
    ]
    named = [p for name in _FIRST_FOLDERS for p in full if p.name.lower() == name]
    named = named or [p for p in full if role_of(p.name) == "color"]
    if named:
        return named[0] if len(named) == 1 or named[0].name.lower() in _FIRST_FOLDERS else None
    mixed = [p for p in full if folders[p]["depth"]]
    other = [p for p in full if role_of(p.name) is None]
    depth = any(role_of(p.name) == "depth" for p in folders)
    return other[0] if len(other) == 1 and (depth or mixed == other) else None


def _folder_of(role: Role, folders: Mapping[Path, Mapping[Role, list[Path]]]) -> list[Path]:
    """The images of the folder of a role. Raises `SourceError` where several may be it."""
    found = {
        p: [q for held in images.values() for q in held] for p, images in folders.items() if role_of(p.name) == role
    }
    found = {p: listed(p, _DEPTH_ENDINGS) for p in found if found[p]}
    if role == "depth" and not found:  # whatever it is called
        found = {p: held["color"] for p, held in folders.items() if held["color"] and _all_deep(held["color"])}
    plain = [p for p in found if p.name.lower() in _WORDS[role]] or [p for p in found if _REGISTERED.search(p.name)]
    if len(found) > 1 and len(plain) != 1:
        names = ", ".join(p.name for p in found)
        raise SourceError(f"{next(iter(found)).parent}: several folders look like {role} ({names}); leave one of them")
    return found[plain[0] if plain else next(iter(found))] if found else []


def _all_deep(images: list[Path]) -> bool:
    return all(map(is_deep, images[:_SAMPLED]))


_SAMPLED = 9
_REGISTERED = re.compile("regist|align", re.IGNORECASE)


# ---------------------------------------------------------------------------------------------- what belongs together


@dataclass(frozen=True)
class Pairs:
    """For each picture what belongs to it, None for nothing."""

    files: list[Path | None]
    how: str
    """By what they were brought together, for people."""
    times_s: NDArray[np.float64] | None = None
    """Seconds of the pictures, where the list of pairs states them. Shape (N,)."""


def pair(root: Path, colors: Sequence[Path], others: Sequence[Path], what: str) -> Pairs:
    """Bring together pictures and depth or confidence: by a list, or their names, numbers, times or order.

    Raises `SourceError` where nothing fits.
    """
    for path in sorted(root.iterdir()):
        if _ASSOCIATIONS.fullmatch(path.name):
            return _by_list(path, colors, others)
    for how, keys in (("name", _stem), ("name", _bare), ("number", _digits)):
        named = {keys(p): p for p in others}
        files = [named.get(keys(c)) for c in colors]
        whole = len(named) == len(others) and len({keys(c) for c in colors}) == len(colors)
        known = len(others) - len({f for f in files if f})
        if whole and any(files) and (keys is _stem or not known or len(colors) != len(others)):
            return Pairs(files, how)
    times, other_s = times_of_names(colors), times_of_names(others)
    if times is not None and other_s is not None:
        found = associate(times, other_s, MAX_PAIR_GAP_S)
        files = [None] * len(colors)
        for c, d in found.tolist():
            files[c] = others[d]
        if len(found):
            return Pairs(files, "the times in their names")
    elif len(colors) == len(others):
        return Pairs(list(others), "order")
    raise SourceError(
        f"{root}: {what} beside the pictures has {len(others)} images, none of which has the name, number or time of "
        f"one of the {len(colors)} pictures; name them alike, list the pairs in associations.txt, or use --kind images "
        "to take colour alone"
    )


def _stem(path: Path) -> str:
    return path.stem


def _bare(path: Path) -> str:
    """The name without the words that say what it is: `rgb_left_1` and `depth_left_1` are one."""
    known = {word for words in _WORDS.values() for word in (*words, "frame")}
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", path.stem)
    return " ".join(p.lower() for p in parts if p.lower() not in known)


def _digits(path: Path) -> tuple[int, ...]:
    return tuple(int(d) for d in re.findall(r"\d+", path.stem))


def _by_list(path: Path, colors: Sequence[Path], others: Sequence[Path]) -> Pairs:
    """The pairs that a list states, a row each, with times before the names or without."""
    place = {p: k for k, p in enumerate(colors)}
    known = set(others)
    files: list[Path | None] = [None] * len(colors)
    times_s = np.full(len(colors), np.nan)
    for line in read_lines(path):
        words = line.partition("#")[0].replace("\\", "/").split()
        named = [path.parent / word for word in words]
        color = next((k for k, p in enumerate(named) if p in place), None)
        other = next((p for p in named if p in known), None)
        if color is None or other is None:
            continue
        files[place[named[color]]] = other
        if color and re.fullmatch(r"\d+(\.\d+)?", words[color - 1]):
            times_s[place[named[color]]] = float(words[color - 1])
    if not any(files):
        raise SourceError(f"{path} names no picture together with a depth image that is there; fix or remove it")
    return Pairs(files, path.name, as_seconds(times_s) if np.isfinite(times_s).all() else None)


# ---------------------------------------------------------------------------------------------- the law


def _looks_deep(path: Path) -> bool:
    """Whether a file or folder is depth by its name, or by what its images are."""
    role = role_of(path.name)
    if path.name.lower().endswith(_TEXTS) or role not in ("depth", None):
        return False
    images = listed(path, IMAGE_ENDINGS) if path.is_dir() else [path] if path.suffix.lower() in IMAGE_ENDINGS else []
    return role == "depth" or (bool(images) and path.exists() and _all_deep(images))


def depth_beside(colors: Path) -> str:
    """Return the name of the depth that lies beside a video or a folder of pictures; empty for none.

    It is a folder of depth, or, where the other says that it is colour, of the same kind as that. Where its name says
    more, that has the other words of the first: `walk_depth` is beside `walk_rgb`, not beside `hall_rgb`.
    """
    own = _words(colors.stem) - set(_WORDS["color"])
    for path in sorted(colors.parent.iterdir()):
        more = _words(path.stem) - set(_WORDS["depth"]) - _OF_DEPTH
        if more and not own <= more:
            continue
        like = role_of(colors.stem) == "color" and path.suffix.lower() == colors.suffix.lower()
        images = listed(path, _DEPTH_ENDINGS)
        if path != colors and role_of(path.stem) == "depth" and (like or (bool(images) and _all_deep(images))):
            return path.name
    return ""


_TEXTS = (".txt", ".json", ".xml", ".yaml", ".yml", ".csv", ".md")


def refuse_left(root: Path, kind: str, left: Iterable[str], *, depth: bool, poses: bool, camera: bool) -> None:
    """Raise `SourceError` where `left`, what no reader took, looks like depth, poses or a camera that the source lacks.

    `depth`, `poses`, `camera`: whether it has them; who names the `kind` goes on without.
    """
    for name in left:
        base = name.rstrip("/").rsplit("/", 1)[-1]
        if not depth and _looks_deep(root / name):
            what, wanted = "depth", "16-bit PNG, TIFF, NumPy or EXR images named as the pictures are, in depth/"
        elif not poses and _POSES.fullmatch(base):
            what, wanted = "poses", "poses.txt with a row for each picture (12 numbers, or time_s tx ty tz qx qy qz qw)"
        elif not camera and _CAMERA.fullmatch(base):
            what, wanted = "a camera", "calibration.txt (fx fy cx cy) or --intrinsics fx,fy,cx,cy"
        else:
            continue
        raise SourceError(
            f"{root}: {name} looks like {what} of these pictures in a form that is not read; give {wanted}, or use "
            f"--kind {kind} to go on without it"
        )

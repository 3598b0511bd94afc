"""A picture of a thing as a vector that can be compared with the things of a memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.decoding.decode import decode_picture
from list3r.frames.files import read_file
from list3r.memory.core.errors import FrameError, OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.semantics.embedding import stored_text_model

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class PictureQuery:
    """What a picture is compared by."""

    space: str
    """The embedding space of the memory, `model@revision/dim`."""
    vector: NDArray[np.float32]
    """Shape (D,), or (n,) where only the first n numbers are known."""
    part: int | None
    """How many numbers of a vector are compared; None for all."""


def picture_query(store: Store, image: str | Path | NDArray[np.uint8], box: Box | None = None) -> PictureQuery:
    """A vector of what a picture shows, or of what lies in its `box` (x0, y0, x1, y1 in px).

    By the model that `list3r embed` was run with where the memory has its vectors; else by colours alone, which is the
    part of the built-in features that needs no depth. `image` is a file or RGB of shape (H, W, 3). Raises `SourceError`
    for a file that is no picture, `OptionError` for a box outside of it or a memory without vectors.
    """
    picture = _read(image) if isinstance(image, str | Path) else np.asarray(image, np.uint8)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise OptionError(f"a picture must have the shape (height, width, 3), not {picture.shape}")
    chosen = _checked_box(box, picture.shape[1], picture.shape[0])
    words = stored_text_model(store)
    if words is not None:
        from list3r.semantics.text_image import square_crop

        return PictureQuery(words.space, words.encode_picture(square_crop(picture, chosen)), None)
    from list3r.instances.geometric.features import COLOR_PART, color_feature
    from list3r.instances.settings import FEATURE_SPACE

    if FEATURE_SPACE not in store.embeddings.spaces():
        held = ", ".join(store.embeddings.spaces()) or "no vectors"
        raise OptionError(f"a picture cannot be compared with {held} in {store.path}; run `list3r embed` on it")
    return PictureQuery(FEATURE_SPACE, color_feature(_middle(picture, chosen)), COLOR_PART)


def _middle(picture: NDArray[np.uint8], box: Box) -> NDArray[np.uint8]:
    """Colours within the ellipse that fills a box, as its corners mostly show what is behind. Shape (N, 3)."""
    x0, y0, x1, y1 = (int(n) for n in (np.floor(box[0]), np.floor(box[1]), np.ceil(box[2]), np.ceil(box[3])))
    crop = picture[y0:y1, x0:x1]
    v, u = np.mgrid[: crop.shape[0], : crop.shape[1]]
    across, down = (2 * u + 1) / crop.shape[1] - 1.0, (2 * v + 1) / crop.shape[0] - 1.0
    return np.asarray(crop[across**2 + down**2 <= 1.0])


def _checked_box(box: Box | None, width: int, height: int) -> Box:
    if box is None:
        return 0.0, 0.0, float(width), float(height)
    x0, y0, x1, y1 = (float(n) for n in box)
    if not np.isfinite([x0, y0, x1, y1]).all() or not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise OptionError(f"the box {x0:g},{y0:g},{x1:g},{y1:g} does not lie in a picture of {width}x{height} px")
    return x0, y0, x1, y1


def _read(path: str | Path) -> NDArray[np.uint8]:
    import cv2

    try:
        data = read_file(Path(path))
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}") from error
    try:
        picture = decode_picture(data, cv2.IMREAD_COLOR, str(path))
    except FrameError as error:
        raise SourceError(f"{error}; make it smaller") from error
    if picture is None:
        raise SourceError(f"{path} is not a picture; give a JPEG or PNG file")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)

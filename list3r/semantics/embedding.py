"""Vectors of a text and image model for the things of a memory, from the pictures that the memory keeps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.models.licences import DEFAULT_PROFILE, choose_weights

if TYPE_CHECKING:
    from list3r.semantics.text_image import TextImageModel

VIEWS = 4
"""Pictures of a thing that are looked at, the largest of different keyframes."""


class PictureEncoder(Protocol):
    """What turns pictures into vectors of a named space."""

    space: str

    def encode_pictures(self, pictures: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Unit vectors (N, D) of pictures (H, W, 3)."""
        ...


@dataclass(frozen=True)
class EmbedReport:
    """What was done."""

    space: str
    instances: int
    without_picture: int
    """Things that no stored picture shows."""


@dataclass(frozen=True)
class _BestView:
    instance: int
    frame: int
    box: tuple[float, ...]
    area: float


def embed_memory(
    path: Path,
    weights: str | None = None,
    device: str = "auto",
    progress: Callable[[int, int], None] | None = None,
    *,
    model: str = "siglip2",
    licence: str = DEFAULT_PROFILE,
) -> EmbedReport:
    """Give every thing of a memory a vector in the model's space; one step, all or nothing.

    `weights` are a folder or a repository instead of the model's own; the memory remembers them by commit, so that
    words can be compared later. Raises `OptionError` when the memory keeps no pictures, the licence profile forbids the
    weights or they cannot be had or loaded, `MemoryFileError`.
    """
    from list3r.models.cache import locate
    from list3r.semantics.text_image import TextImageModel

    Store.open(path).close()  # what is no memory is said before anything is fetched
    weights = _weights(model, weights, licence)
    with Store.open(path, writable=True) as store:
        views = _views(store)
        if not views:
            raise OptionError(f"{path} keeps no pictures of its things; build it without --no-pictures")
        network = TextImageModel(locate(weights), device)
        sums: dict[int, NDArray[np.float64]] = {}
        for done, (chunk_id, wanted) in enumerate(sorted(views.items())):
            _look(store, chunk_id, wanted, network, sums)
            if progress is not None:
                progress(done + 1, len(views))
        ids = sorted(sums)
        vectors = np.array([sums[i] / max(float(np.linalg.norm(sums[i])), 1e-9) for i in ids], np.float32)
        with store.transaction():
            store.embeddings.put(network.space, ids, vectors)
            known = dict(store.facts.text_models)
            known[network.space] = weights
            store.facts.text_models = known
        everything = len(store.instances.all())
    return EmbedReport(network.space, len(ids), everything - len(ids))


class StoredTextModel:
    """The text side of the model that a memory was embedded with, loaded when the first word is compared."""

    def __init__(self, space: str, weights: str, device: str = "auto") -> None:
        self._space, self._weights, self._device = space, weights, device
        self._model: TextImageModel | None = None

    @property
    def space(self) -> str:
        """`model@revision/dim`."""
        return self._space

    @property
    def min_cosine(self) -> float:
        """From here a thing is said to be what a text says."""
        return self._loaded().min_cosine

    def encode(self, text: str) -> NDArray[np.float32]:
        """Unit vector of words (D,). Raises `OptionError` when the weights are no longer there or are others."""
        return self._loaded().encode(text)

    def encode_picture(self, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unit vector of a picture (H, W, 3), (D,). Raises `OptionError` as `encode` does."""
        return np.asarray(self._loaded().encode_pictures([picture])[0], np.float32)

    def _loaded(self) -> TextImageModel:
        if self._model is None:
            from list3r.models.cache import locate
            from list3r.semantics.text_image import TextImageModel

            model = TextImageModel(locate(self._weights), self._device)
            if model.space != self._space:
                raise OptionError(
                    f"the weights {self._weights} have changed since the memory was embedded; run `list3r embed` again"
                )
            self._model = model
        return self._model


def stored_text_model(store: Store, device: str = "auto") -> StoredTextModel | None:
    """What compares free words with the things of a memory, None where `list3r embed` was not run on it."""
    spaces = store.embeddings.spaces()
    for space, weights in sorted(dict(store.facts.text_models).items()):
        if space in spaces:
            return StoredTextModel(space, str(weights), device)
    return None


def _weights(model: str, asked: str | None, licence: str) -> str:
    """The weights of a text and image model, a path or `owner/name@commit`. Raises `OptionError`."""
    from list3r.models.cache import resolve
    from list3r.models.cards import CARDS, find_card
    from list3r.models.choice import check_package

    card = find_card(model, "text")
    if card is None:
        known = " or ".join(sorted(c.name for c in CARDS if c.part == "text"))
        raise OptionError(f"--model {model} compares no words with pictures; choose {known}")
    chosen = choose_weights(card, asked, licence, "--model")
    check_package(card)
    return resolve(asked, chosen, f"--model {model}")


def _views(store: Store) -> dict[int, list[_BestView]]:
    """The best views of every thing among the keyframes with a picture, by chunk."""
    owner: dict[int, dict[int, int]] = defaultdict(dict)
    for seen in store.observations.all():
        owner[seen.chunk_id][seen.local_id] = seen.instance_id
    best: dict[int, list[tuple[int, _BestView]]] = defaultdict(list)
    for chunk_id, locals_ in sorted(owner.items()):
        frames = {k.frame_index for k in store.keyframes.of(chunk_id) if k.jpeg}
        for local_id, instance in sorted(locals_.items()):
            track = store.local_instances.mask_track(chunk_id, local_id)
            for row in np.flatnonzero(np.isin(track.frames, list(frames))).tolist():
                area = float(track.areas_px[row]) * max(float(track.visible_fraction[row]), 0.05)
                view = _BestView(instance, int(track.frames[row]), tuple(track.boxes_xyxy[row].tolist()), area)
                best[instance].append((chunk_id, view))
    out: dict[int, list[_BestView]] = defaultdict(list)
    for instance in sorted(best):
        for chunk_id, view in sorted(best[instance], key=lambda v: (-v[1].area, v[0], v[1].frame))[:VIEWS]:
            out[chunk_id].append(view)
    return out


def _look(
    store: Store, chunk_id: int, wanted: list[_BestView], model: PictureEncoder, sums: dict[int, NDArray[np.float64]]
) -> None:
    """Add the vectors of one chunk's views to those of their things."""
    from list3r.frames.decoding.decode import decode_rgb
    from list3r.semantics.text_image import square_crop

    by_frame: dict[int, list[_BestView]] = defaultdict(list)
    for view in wanted:
        by_frame[view.frame].append(view)
    for frame, views in sorted(by_frame.items()):
        picture = decode_rgb(store.keyframes.get(chunk_id, frame).jpeg)
        if picture is None:
            continue
        vectors = model.encode_pictures([square_crop(picture, v.box) for v in views])
        for view, vector in zip(views, vectors, strict=True):
            sums[view.instance] = sums.get(view.instance, np.zeros(len(vector))) + vector

"""The GPU: its name, its free memory, how many pictures fit, and what to do when they do not."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from list3r.memory.core.errors import OptionError
from list3r.models.cards import MemoryFigures

USABLE_SHARE = 0.9
"""Share of the free memory that a plan uses; the allocator's own fragments take a few percent."""


@dataclass(frozen=True)
class Gpu:
    """One GPU."""

    name: str
    total_mb: float
    free_mb: float


def find_gpu(device: str = "auto") -> Gpu | None:
    """Return the GPU that a device name means, None where there is none or the name is `cpu`."""
    import torch

    if device == "cpu" or not torch.cuda.is_available():
        return None
    index = torch.device("cuda" if device == "auto" else device).index or 0
    free, total = torch.cuda.mem_get_info(index)
    free += torch.cuda.memory_reserved(index) - torch.cuda.memory_allocated(index)  # what this process keeps unused
    return Gpu(torch.cuda.get_device_name(index), total / 2**20, free / 2**20)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, on a GPU or on the CPU (whose allocator raises a `RuntimeError`)."""
    import torch

    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and ("out of memory" in text or "can't allocate memory" in text)


@contextmanager
def out_of_memory_reported(what: str) -> Iterator[None]:
    """Turn memory that runs out into an `OptionError` that names its use."""
    try:
        yield
    except Exception as error:
        if "torch" not in sys.modules or not is_out_of_memory(error):
            raise
        raise OptionError(
            f"{what} does not fit into the GPU memory; free some, use another model, or --device cpu"
        ) from None


def pictures_that_fit(free_mb: float, figures: MemoryFigures, pixels: int) -> int:
    """Pictures of `pixels` pixels that one pass can take, by published figures; 0 where not even the weights fit."""
    left = USABLE_SHARE * free_mb - figures.fixed_mb
    return max(0, int(left // (figures.per_megapixel_mb * pixels / 1e6)))


class MemoryBudget:
    """How many pictures one pass may hold: published figures at first, measured ones from then on.

    On a CPU the only limit is learned from running out of memory.
    """

    def __init__(self, figures: MemoryFigures | None, free_mb: float | None, pixels: int) -> None:
        self._free_mb, self._pixels = free_mb, pixels
        self._limit: int | None = None
        if figures is not None and free_mb is not None:
            self._limit = max(1, pictures_that_fit(free_mb, figures, pixels))

    def limit(self, wanted: int) -> int:
        """Pictures to pass at once when `wanted` are asked for."""
        return wanted if self._limit is None else min(wanted, self._limit)

    def failed(self, pictures: int) -> None:
        """So many did not fit: half of them next time, and never again as many."""
        self._limit = max(1, min(self._limit or pictures, pictures // 2))

    def measured(self, pictures: int, peak_mb: float, weights_mb: float) -> None:
        """A pass over this many took `peak_mb` in all, `weights_mb` of it for the weights: correct the figures by it.

        A pass over a handful of pictures predicts a long one badly, so it is not used.
        """
        if self._free_mb is None or pictures < 8 or peak_mb <= weights_mb:
            return
        each = (peak_mb - weights_mb) / pictures
        self._limit = max(pictures, int((USABLE_SHARE * self._free_mb - weights_mb) // each))

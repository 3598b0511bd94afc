"""Reconstruction by a feed-forward network: many frames in, poses, depth and confidence of all of them out.

What the adapters (`pi3`, `vggt`, `mapanything`, `da3`) share: pictures at the network's size, the device, as many
frames at once as the memory holds, and one form of the answer. An adapter is a `Network`: its card, where its class is,
and how its outputs read in the terms of `WindowOutput`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from list3r.frames.base import Camera, Frame
from list3r.memory.errors import DegenerateError, TrackingError
from list3r.models.cache import locate, resolve
from list3r.models.cards import ModelCard, find_card
from list3r.models.device import MemoryBudget, find_gpu
from list3r.models.licences import choose_weights
from list3r.models.pretrained import pick_device
from list3r.models.upstream import load_upstream, quiet, upstream_class
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.networks.output import WindowOutput, to_reconstruction, with_given_poses
from list3r.reconstruction.networks.windows import run_windows
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch

PATCH = 14
"""Side of the patches that all of these networks cut a picture into, px."""


@dataclass(frozen=True)
class PictureSize:
    """How large a picture a network takes; the aspect ratio is kept to the nearest patch."""

    max_pixels: int | None = None
    """Most pixels, or None."""
    longest: int | None = None
    """Longest side, px, or None."""

    def of(self, height: int, width: int) -> tuple[int, int]:
        """Height and width, multiples of `PATCH`, for frames of a size."""
        scale = 1.0 if self.longest is None else self.longest / max(height, width)
        if self.max_pixels is not None:
            scale = math.sqrt(self.max_pixels / (height * width))
        rows, columns = (max(1, round(side * scale / PATCH)) for side in (height, width))
        while self.max_pixels is not None and rows * columns * PATCH * PATCH > self.max_pixels:
            if columns / rows > width / height:
                columns -= 1
            else:
                rows -= 1
        return max(1, rows) * PATCH, max(1, columns) * PATCH


Answer = Callable[[Any, "torch.Tensor", "torch.Tensor | None"], WindowOutput]
"""Poses, depth, confidence and focal lengths that a model tells of pictures (n, 3, h, w) in [0, 1]. The last argument
are known intrinsics of the pictures, px, (3, 3), pixel centres at whole numbers, for models that can be told."""


@dataclass(frozen=True)
class Network:
    """What an adapter is."""

    name: str
    """Of its card."""
    module: str
    class_name: str
    """Where the upstream package has its class."""
    size: PictureSize
    """How large its pictures are."""
    answer: Answer
    load_class: Callable[[Any, Path, torch.device], Any] = load_upstream
    """Makes the class with the weights at a path; an adapter wraps it where the package needs more care."""

    @property
    def card(self) -> ModelCard:
        """What the network is."""
        card = find_card(self.name, "geometry")
        assert card is not None
        return card

    def load(self, path: Path, device: torch.device) -> Any:
        """Return the network with the weights at a path. Raises `OptionError` in one line."""
        return self.load_class(upstream_class(self.card, self.module, self.class_name), path, device)


class FeedforwardReconstructor:
    """A `Reconstructor` around a network, which is loaded when the first chunk comes."""

    def __init__(self, network: Network, options: ModelOptions) -> None:
        self._network, self._options = network, options
        self._device = pick_device(options.device)
        card = network.card
        option = f"--reconstruction {card.name}"
        known = choose_weights(card, options.weights, "any", option)
        self.weights = resolve(options.weights, known, option)
        self._model: Any = None
        self._budget: MemoryBudget | None = None

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """Reconstruct a chunk or a joint window. Raises `TrackingError`, and `OptionError` for the first time."""
        height, width = self._network.size.of(camera.height, camera.width)
        if self._budget is None:
            gpu = find_gpu(str(self._device))
            free = None if gpu is None else gpu.free_mb
            self._budget = MemoryBudget(self._network.card.memory_with(self.weights), free, height * width)
        if self._model is None:
            self._model = self._network.load(locate(self.weights), self._device)
        K = camera.resized(height, width).matrix() if self._options.camera_known else None

        def run(start: int, stop: int) -> WindowOutput:
            return self._pass(shrink([f.color for f in frames[start:stop]], height, width), K)

        try:
            made = to_reconstruction(
                frames, camera, run_windows(len(frames), self._budget, run), settings=self._options.settings.networks
            )
        except DegenerateError as error:
            raise TrackingError(f"frames {frames[0].index} to {frames[-1].index}: {error}") from error
        return with_given_poses(made, frames) if self._options.poses == "given" else made

    def _pass(self, pictures: NDArray[np.uint8], K: NDArray[np.float64] | None) -> WindowOutput:
        """One pass through the network, in half precision on a GPU, with what it took noted."""
        import torch

        device, cuda = self._device, self._device.type == "cuda"
        if cuda:
            torch.cuda.reset_peak_memory_stats(device)
            weights_mb = torch.cuda.memory_allocated(device) / 2**20
        stack = torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2).float() / 255.0
        known = None if K is None else torch.from_numpy(K).float().to(device)
        with (
            quiet(),
            torch.random.fork_rng(devices=[device] if cuda else []),
            torch.inference_mode(),
            torch.autocast(device.type, half_precision(device), enabled=cuda),
        ):
            torch.manual_seed(0)  # some networks draw samples; a chunk's answer depends on nothing but the chunk
            output = self._network.answer(self._model, stack, known)
        if cuda and self._budget is not None:
            self._budget.measured(len(pictures), torch.cuda.max_memory_allocated(device) / 2**20, weights_mb)
        return output


def half_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the GPU computes in it (compute capability 8 and up) and on a CPU, float16 elsewhere."""
    import torch

    old = device.type == "cuda" and torch.cuda.get_device_capability(device)[0] < 8
    return torch.float16 if old else torch.bfloat16


def shrink(pictures: Sequence[NDArray[np.uint8]], height: int, width: int) -> NDArray[np.uint8]:
    """Pictures (H, W, 3) at the network's size, by the filter that the networks were trained with. (n, h, w, 3)."""
    small = [Image.fromarray(p).resize((width, height), Image.Resampling.LANCZOS) for p in pictures]
    return np.stack([np.asarray(p) for p in small])


def numpy(tensor: torch.Tensor) -> NDArray[Any]:
    """Return a tensor as an array; half precision becomes float32."""
    return np.asarray(tensor.detach().float().cpu().numpy())


def inverted(T_cam_world: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """T_world_cam of camera-from-world poses (n, 3, 4) or (n, 4, 4). Shape (n, 4, 4)."""
    R, t = T_cam_world[:, :3, :3].astype(np.float64), T_cam_world[:, :3, 3].astype(np.float64)
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = np.swapaxes(R, 1, 2)
    T[:, :3, 3] = -np.einsum("nji,nj->ni", R, t)
    return T


def sigmoid_of_expp1(confidence: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """In [0, 1], from the confidence 1 + exp(x) of networks after DUSt3R: the sigmoid of x, which is 1 - 1 / c."""
    return np.asarray(1.0 - 1.0 / np.maximum(confidence, 1.0), np.float32)

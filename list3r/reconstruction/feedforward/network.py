"""Reconstruction by a feed-forward network: many frames in, poses, depth and confidence of all of them out.

Shared by all adapters: pictures as the network's own loader makes them, the device, as many frames at once as the
memory holds, and one form of the output. An adapter is a `Network`: its card, its class, and how its outputs become a
`WindowOutput`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import DegenerateError, TrackingError
from list3r.models.cache import locate, resolve
from list3r.models.cards import ModelCard, find_card
from list3r.models.device import MemoryBudget, find_gpu, is_out_of_memory
from list3r.models.licences import choose_weights
from list3r.models.pretrained import pick_device
from list3r.models.upstream import load_upstream, quiet, upstream_class
from list3r.reconstruction.base import Reconstruction, WindowSide
from list3r.reconstruction.feedforward.output import WindowOutput, to_reconstruction, whole_frames, with_given_poses
from list3r.reconstruction.feedforward.pictures import Loader, Placement, fitted, pictures
from list3r.reconstruction.feedforward.windows import LEAST_WINDOW, release, run_windows
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch

Answer = Callable[[Any, "torch.Tensor", "torch.Tensor | None"], WindowOutput]
"""Poses, depth, confidence and focal lengths that a model predicts for pictures (n, 3, h, w) in [0, 1]. The last
argument are known intrinsics, px, (n, 3, 3), pixel centres at whole numbers, for models that take them."""


@dataclass(frozen=True)
class Network:
    """The definition of an adapter."""

    name: str
    """Of its card."""
    module: str
    class_name: str
    """Of its class in the upstream package."""
    loader: Loader
    """How frames become its pictures."""
    answer: Answer
    load_class: Callable[[Any, Path, torch.device], Any] = load_upstream
    """Makes the class with the weights at a path; an adapter wraps it where the package needs more care."""
    half: bool = True
    """Whether it computes in half precision on a GPU, as its authors' own programs do."""

    @property
    def card(self) -> ModelCard:
        """The network's card."""
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
        placement = self._network.loader.place(camera.height, camera.width)
        side = WindowSide(frames, camera, self._options.camera_known)
        budget = self._ready(placement)

        def run(start: int, stop: int) -> WindowOutput:
            return self._pass([replace(side, frames=frames[start:stop])], [placement])[0]

        try:
            made = self._made(side, run_windows(len(frames), budget, run))
        except DegenerateError as error:
            raise TrackingError(f"frames {frames[0].index} to {frames[-1].index}: {error}") from error
        return with_given_poses(made, frames) if self._options.poses == "given" else made

    def joint(self, sides: Sequence[WindowSide]) -> tuple[Reconstruction, ...]:
        """Reconstruct frames of several places, each with a camera of its own, in one pass and one gauge.

        A joint window is never split: where it does not fit into the memory all sides are subsampled alike. Raises
        `TrackingError` when a side cannot be posed, or when too few frames would be left.
        """
        first = self._network.loader.place(sides[0].camera.height, sides[0].camera.width)
        placements = [first, *(self._place_among(first, side.camera) for side in sides[1:])]
        budget = self._ready(first)
        while True:
            count = sum(len(side.frames) for side in sides)
            try:
                if budget.limit(count) >= count:
                    return self._in_one_gauge(sides, self._pass(sides, placements))
            except Exception as error:
                if not is_out_of_memory(error):
                    raise
                budget.failed(count)
                release()
            if min(len(side.frames) for side in sides) < 2 * LEAST_WINDOW:
                raise TrackingError(f"{count} frames of several places do not fit into the memory at once")
            sides = [replace(side, frames=side.frames[::2]) for side in sides]

    def _place_among(self, first: Placement, camera: Camera) -> Placement:
        """Where frames of another camera are in pictures of the size of the first ones."""
        own = self._network.loader.place(camera.height, camera.width)
        return own if own.size == first.size else fitted(camera, first.size)

    def _in_one_gauge(self, sides: Sequence[WindowSide], outputs: Sequence[WindowOutput]) -> tuple[Reconstruction, ...]:
        """Return the sides in the frame of the first posed camera of all."""
        made = [self._made(side, output) for side, output in zip(sides, outputs, strict=True)]
        anchors = [o.T_window_cam[int(np.argmax(m.posed))] for o, m in zip(outputs, made, strict=True)]
        T_first_window = np.linalg.inv(anchors[0])
        return tuple(
            replace(m, T_chunk_cam=T_first_window @ T @ m.T_chunk_cam) for m, T in zip(made, anchors, strict=True)
        )

    def _made(self, side: WindowSide, output: WindowOutput) -> Reconstruction:
        settings = self._options.settings.networks
        return to_reconstruction(side.frames, side.camera, output, None, settings, side.camera_known)

    def _ready(self, placement: Placement) -> MemoryBudget:
        """Load the network, and return how many of its pictures a pass may hold."""
        if self._budget is None:
            gpu = find_gpu(str(self._device))
            free, pixels = None if gpu is None else gpu.free_mb, placement.size[0] * placement.size[1]
            self._budget = MemoryBudget(self._network.card.memory_with(self.weights), free, pixels)
        if self._model is None:
            self._model = self._network.load(locate(self.weights), self._device)
        return self._budget

    def _pass(self, sides: Sequence[WindowSide], placements: Sequence[Placement]) -> list[WindowOutput]:
        """One pass through the network over the frames of all sides; the output for each side's whole frames."""
        both = list(zip(sides, placements, strict=True))
        resample = self._network.loader.resample
        seen = [pictures([f.color for f in side.frames], p, resample) for side, p in both]
        known = all(side.camera_known for side in sides)
        K = [p.camera_matrix(side.camera)[None].repeat(len(side.frames), axis=0) for side, p in both] if known else []
        output = self._answer(np.concatenate(seen), np.concatenate(K) if K else None)
        ends = np.cumsum([0, *(len(s) for s in seen)]).tolist()
        spans = itertools.pairwise(ends)
        return [whole_frames(output.part(slice(*span)), p) for span, p in zip(spans, placements, strict=True)]

    def _answer(self, seen: NDArray[np.uint8], K: NDArray[np.float64] | None) -> WindowOutput:
        """Run the network, in half precision on a GPU, and record its memory use."""
        import torch

        device, cuda = self._device, self._device.type == "cuda"
        if cuda:
            torch.cuda.reset_peak_memory_stats(device)
            weights_mb = torch.cuda.memory_allocated(device) / 2**20
        stack = torch.from_numpy(seen).to(device).permute(0, 3, 1, 2).float() / 255.0
        known = None if K is None else torch.from_numpy(K).float().to(device)
        with (
            quiet(),
            torch.random.fork_rng(devices=[device] if cuda else []),
            torch.inference_mode(),
            torch.autocast(device.type, half_precision(device), enabled=cuda and self._network.half),
        ):
            torch.manual_seed(0)  # some networks draw samples; a chunk's output depends on nothing but the chunk
            output = self._network.answer(self._model, stack, known)
        if cuda and self._budget is not None:
            self._budget.measured(len(seen), torch.cuda.max_memory_allocated(device) / 2**20, weights_mb)
        return output


def half_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the GPU computes in it (compute capability 8 and up) and on a CPU, float16 elsewhere."""
    import torch

    old = device.type == "cuda" and torch.cuda.get_device_capability(device)[0] < 8
    return torch.float16 if old else torch.bfloat16


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

"""Networks of the real sizes on a GPU, random weights: frames/s, peak memory, chunk length, cost of a tracked object.

    python benchmarks/gpu.py [--frames 30 60 120] [--tracker sam2] [--out FILE]

Geometry: pi3 from its own package where that is installed, else a transformer of the same size and plan (an encoder of
24 layers for each frame, 36 layers that attend in turn within a frame and over all frames, three decoders of five). The
published figures are those of the model cards. Without a GPU it says so and does nothing; `--device cpu --tiny` runs
the code at toy size. The plane sweep on a GPU: `benchmarks/mvs.py --device cuda`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import machine
from torch import nn
from torch.nn import functional

from list3r.frames.base import Camera, Frame
from list3r.instances.base import Proposals
from list3r.models.cards import find_card
from list3r.models.device import MemoryBudget, find_gpu, pictures_that_fit
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.feedforward.network import half_precision
from list3r.reconstruction.networks.pi3 import NETWORK as PI3

SIZE = (364, 504)
PUBLISHED = {"pictures": 1024, "peak_mb": 43667, "frames_per_s": 2.4, "on": "A800-80GB, its authors"}


class Block(nn.Module):
    """A transformer layer."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.before, self.after = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Shape (B, N, width)."""
        q, k, v = self.qkv(self.before(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        x = x + self.out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return x + self.mlp(self.after(x))


class OfPi3Size(nn.Module):
    """A transformer with the plan, the size and the outputs of pi3."""

    def __init__(self, width: int = 1024, heads: int = 16, depth: tuple[int, int, int] = (24, 36, 5)) -> None:
        super().__init__()
        encoder, decoder, head = depth
        self.patches = nn.Conv2d(3, width, 14, 14)
        self.encoder = nn.ModuleList(Block(width, heads) for _ in range(encoder))
        self.decoder = nn.ModuleList(Block(width, heads) for _ in range(decoder))
        self.decoders = nn.ModuleList(nn.ModuleList(Block(width, heads) for _ in range(head)) for _ in range(3))
        self.join = nn.ModuleList(nn.Linear(2 * width, width) for _ in range(3))
        self.points, self.conf = nn.Linear(width, 3 * 196), nn.Linear(width, 196)

    def forward(self, imgs: torch.Tensor) -> dict[str, torch.Tensor]:
        """Pictures (1, n, 3, h, w) to the outputs of pi3."""
        _, count, _, height, width = imgs.shape
        x = self.patches(imgs[0]).flatten(2).transpose(1, 2)
        for block in self.encoder:
            x = block(x)
        layers = []
        for number, block in enumerate(self.decoder):
            x = x.reshape(1, -1, x.shape[-1]) if number % 2 else x.reshape(count, -1, x.shape[-1])
            x = block(x)
            layers = [*layers[-1:], x.reshape(count, -1, x.shape[-1])]
        both = torch.cat(layers, dim=-1)
        heads = []
        for join, blocks in zip(self.join, self.decoders, strict=True):
            y = join(both)
            for block in blocks:
                y = block(y)
            heads.append(y)
        rows, columns = height // 14, width // 14

        def picture(tokens: torch.Tensor) -> torch.Tensor:
            return functional.pixel_shuffle(tokens.transpose(1, 2).unflatten(2, (rows, columns)), 14)

        xyz = picture(self.points(heads[0])).float().permute(0, 2, 3, 1)
        z = xyz[..., 2:].exp()
        return {
            "local_points": torch.cat([xyz[..., :2] * z, z], dim=-1)[None],
            "conf": picture(self.conf(heads[1])).float().permute(0, 2, 3, 1)[None],
            "camera_poses": torch.eye(4, device=imgs.device).expand(1, count, 4, 4),
        }


def geometry_network(tiny: bool, device: torch.device) -> tuple[nn.Module, str]:
    """The network to measure and its name."""
    if tiny:
        return OfPi3Size(32, 2, (1, 2, 1)).to(device).eval(), "toy"
    try:
        from pi3.models.pi3 import Pi3 as Upstream  # type: ignore[import-not-found]
    except ImportError:
        return OfPi3Size().to(device).eval(), "a transformer of pi3's size"
    return Upstream().to(device).eval(), "pi3's own code"


def measure_geometry(lengths: list[int], tiny: bool, device: torch.device) -> dict[str, Any]:
    """Speed and memory of passes over several numbers of frames, and the chunk that fits."""
    card = find_card("pi3", "geometry")
    assert card is not None and card.memory is not None
    height, width = (56, 84) if tiny else SIZE
    gpu = find_gpu(str(device))
    free = 0.0 if gpu is None else gpu.free_mb
    network, what = geometry_network(tiny, device)
    cuda = device.type == "cuda"
    budget = MemoryBudget(card.memory, free, height * width)
    planned = pictures_that_fit(free, card.memory, height * width)
    rows = []
    for count in lengths:
        pictures = torch.rand(count, 3, height, width, device=device)
        rows.append(_pass(network, pictures, device))
        if cuda:
            budget.measured(count, rows[-1]["peak_mb"], rows[-1]["weights_mb"])
    parameters = sum(p.numel() for p in network.parameters()) / 1e6
    return {
        "network": what,
        "million_parameters": round(parameters, 1),
        "size": [height, width],
        "passes": rows,
        "free_mb": round(free),
        "chunk_by_published_figures": planned,
        "chunk_by_measuring": budget.limit(10**6) if cuda else None,
        "published": PUBLISHED,
    }


def _pass(network: nn.Module, pictures: torch.Tensor, device: torch.device) -> dict[str, Any]:
    """The best of two passes, by the adapter's own code, its answer on the CPU included."""
    cuda = device.type == "cuda"
    weights_mb, seconds = 0.0, []
    if cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
        weights_mb = torch.cuda.memory_allocated(device) / 2**20
    inside = []
    for _ in range(2):
        started = time.perf_counter()
        with torch.inference_mode(), torch.autocast(device.type, half_precision(device), enabled=cuda):
            network(pictures[None])
            if cuda:
                torch.cuda.synchronize(device)
            inside.append(time.perf_counter() - started)
            PI3.answer(network, pictures, None)
        seconds.append(time.perf_counter() - started - inside[-1])
    peak = torch.cuda.max_memory_allocated(device) / 2**20 if cuda else 0.0
    count = len(pictures)
    return {
        "frames": count,
        "network_frames_per_s": round(count / min(inside), 2),
        "adapter_frames_per_s": round(count / min(seconds), 2),
        "peak_mb": round(peak),
        "weights_mb": round(weights_mb),
        "mb_per_frame": round((peak - weights_mb) / count, 2),
    }


def measure_tracker(name: str, objects: list[int], tiny: bool, device: torch.device) -> dict[str, Any]:
    """Seconds per frame for several numbers of objects, and the cost of one more."""
    from list3r.instances.tracking.video_tracker import VideoTracker

    frames, reconstruction = _still_chunk(6 if tiny else 24)
    with tempfile.TemporaryDirectory() as folder:
        _save_tracker(name, Path(folder), tiny)
        tracker = VideoTracker(name, Path(folder), str(device))
    rows = []
    tracker(frames[:4], _first(reconstruction, 4), [_grid_of_objects(1)], "none")  # the first pass loads kernels
    for count in objects:
        started = time.perf_counter()
        tracker(frames, reconstruction, [_grid_of_objects(count)], "none")
        rows.append({"objects": count, "ms_per_frame": round(1e3 * (time.perf_counter() - started) / len(frames), 2)})
    slope, base = np.polyfit([r["objects"] for r in rows], [r["ms_per_frame"] for r in rows], 1)
    return {
        "tracker": name,
        "rows": rows,
        "ms_per_frame": round(float(base), 2),
        "ms_per_object_and_frame": round(float(slope), 2),
        "published": "SAM2: E + M n for each frame; 16 objects about 2 frames/s (facebookresearch/sam2 #367)",
    }


def _save_tracker(name: str, folder: Path, tiny: bool) -> None:
    """A tracker of its default size with random weights."""
    import transformers
    from transformers.utils import logging

    logging.set_verbosity_error()
    torch.manual_seed(0)
    kinds = {"sam2": "Sam2Video", "sam3": "Sam3TrackerVideo"}
    if tiny:
        import sys

        sys.path.insert(0, str(Path(__file__).parents[1]))
        from tests.neural_models import save

        save(f"tracking/{name}", folder)
        return
    config = getattr(transformers, f"{kinds[name]}Config")()
    getattr(transformers, f"{kinds[name]}Model")(config).save_pretrained(folder)


def _still_chunk(count: int) -> tuple[list[Frame], Reconstruction]:
    """Frames of noise before a wall, from one place."""
    rng = np.random.default_rng(0)
    camera = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
    frames = [Frame(k, k / 30, rng.integers(0, 255, (240, 320, 3), np.uint8), None, None) for k in range(count)]
    shape = (count, 240, 320)
    made = Reconstruction(
        np.arange(count),
        np.ones(count, bool),
        np.tile(np.eye(4), (count, 1, 1)),
        camera,
        np.full(shape, 2.0, np.float32),
        np.full(shape, 0.9, np.float16),
        "relative",
        np.array([0]),
    )
    return frames, made


def _first(made: Reconstruction, count: int) -> Reconstruction:
    """The first frames of a reconstruction."""
    parts = (made.frame_indices, made.posed, made.T_chunk_cam)
    indices, posed, T = (a[:count] for a in parts)
    return Reconstruction(
        indices, posed, T, made.camera, made.depth[:count], made.confidence[:count], "relative", made.keyframes
    )


def _grid_of_objects(count: int) -> Proposals:
    """So many rectangles on the first frame."""
    side = int(np.ceil(np.sqrt(count)))
    rows, columns = np.meshgrid(np.arange(240) * side // 240, np.arange(320) * side // 320, indexing="ij")
    cell = rows * side + columns + 1
    labels = np.where((cell <= count) & (np.arange(320)[None] % (320 // side) > 4), cell, 0).astype(np.int32)
    features = np.tile(np.eye(1, 8, dtype=np.float32), (count, 1))
    return Proposals(0, labels, np.ones(count, np.float32), features, np.full((count, 4), np.nan))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[30, 60, 120])
    parser.add_argument("--objects", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--tracker", choices=["sam2", "sam3", "none"], default="sam2")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--tiny", action="store_true", help="toy networks, to run the code")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    gpu = find_gpu(chosen.device)
    if gpu is None and chosen.device != "cpu":
        print("no GPU here")
        return
    device = torch.device("cpu" if gpu is None else "cuda" if chosen.device == "auto" else chosen.device)
    named = None if gpu is None else {"name": gpu.name, "total_mb": round(gpu.total_mb), "free_mb": round(gpu.free_mb)}
    report: dict[str, Any] = {"machine": machine(), "gpu": named, "torch": torch.__version__}
    report["geometry"] = measure_geometry(chosen.frames, chosen.tiny, device)
    if chosen.tracker != "none":
        report["tracker"] = measure_tracker(chosen.tracker, chosen.objects, chosen.tiny, device)
    text = json.dumps(report, indent=2)
    print(text)
    if chosen.out is not None:
        chosen.out.write_text(text + "\n")


if __name__ == "__main__":
    main()

"""Training of the plane sweep's network: losses, disturbances, a log, a state to go on from."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from list3r.reconstruction.mvs.network import PLANES, SweepNetwork, SweepPrediction
from training.sweep_samples import PARTS

SHARES = (1.0, 0.25, 0.25)
"""Weights of the losses of `sweep_losses`."""


@dataclass(frozen=True)
class SweepFitSettings:
    """How long and how fast."""

    steps: int = 13_000
    batch: int = 40
    crop: tuple[int, int] | None = None
    """Height and width of the part of each keyframe that is learned from, px of its costs; None: all of it."""
    rate: float = 1.5e-3
    """Largest learning rate; it falls along half a cosine."""
    average: float = 0.999
    """What of the mean of its weights so far a step keeps."""
    seed: int = 0
    every: int = 200
    """Steps between states that an interrupted run goes on from."""


@dataclass(frozen=True)
class Batch:
    """B keyframes, or parts of them."""

    likeness: Tensor
    """Shape (B, 64, h, w)."""
    picture: Tensor
    """RGB in [0, 1]. Shape (B, 3, 2h, 2w)."""
    place: Tensor
    """True place among the planes. Shape (B, 2h, 2w)."""
    side: Tensor
    """Shape (B, 3)."""


def fit_sweep(
    network: SweepNetwork, rooms: Sequence[Path], folder: Path, settings: SweepFitSettings
) -> dict[str, Tensor]:
    """Train a network on rooms of `make_keyframes` and return its mean weights. `log.jsonl` tells the losses.

    The first GPU is used where there is one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device).train()
    mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(settings.average))
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=1e-2, betas=(0.9, 0.98))
    state, first = folder / "state.pt", 0
    if state.exists():
        saved = torch.load(state, weights_only=True, map_location=device)
        network.load_state_dict(saved["network"])
        mean.load_state_dict(saved["mean"])
        optimiser.load_state_dict(saved["optimiser"])
        first = int(saved["step"])
    began, losses = time.monotonic(), list[Tensor]()
    for step in range(first, settings.steps):
        for group in optimiser.param_groups:
            group["lr"] = _rate(step, settings)
        torch.manual_seed(settings.seed + step)
        batch = disturbed(draw_batch(rooms, np.random.default_rng([settings.seed, step]), settings, device))
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            said = network(batch.likeness, batch.picture * 2.0 - 1.0, batch.side)
        parts = torch.stack(sweep_losses(said, batch))
        loss = (parts * parts.new_tensor(SHARES)).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if bool(torch.isfinite(norm)):
            optimiser.step()
            mean.update_parameters(network)
        losses.append(parts.detach())
        if (step + 1) % settings.every == 0 or step + 1 == settings.steps:
            told = dict(
                zip(
                    ("planes", "error", "place"),
                    torch.stack(losses).double().mean(0).cpu().numpy().round(4).tolist(),
                    strict=True,
                )
            )
            row = {"step": step + 1, "s": round(time.monotonic() - began), **told}
            with (folder / "log.jsonl").open("a") as log:
                log.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)  # noqa: T201
            losses.clear()
            held = {"network": network.state_dict(), "mean": mean.state_dict(), "optimiser": optimiser.state_dict()}
            torch.save({**held, "step": step + 1}, state.with_suffix(".new"))
            state.with_suffix(".new").rename(state)
    return {name: value.detach().cpu() for name, value in mean.module.state_dict().items()}


def _rate(step: int, settings: SweepFitSettings) -> float:
    """Return the learning rate of a step."""
    rise = min(1.0, (step + 1) / 300)
    return settings.rate * rise * (0.5 + 0.5 * float(np.cos(np.pi * step / settings.steps))) + 1e-6


def draw_batch(
    rooms: Sequence[Path], rng: np.random.Generator, settings: SweepFitSettings, device: torch.device
) -> Batch:
    """Draw keyframes, each from a room of its own, and a part of each."""
    drawn = [_drawn(rooms[int(rng.integers(len(rooms)))], rng, settings.crop) for _ in range(settings.batch)]
    costs, picture, place, side = (torch.from_numpy(np.stack(part)).to(device) for part in zip(*drawn, strict=True))
    likeness = 1.0 - costs.float() / 127.5
    return Batch(likeness, picture.permute(0, 3, 1, 2).float() / 255.0, place.float(), side)


def _drawn(room: Path, rng: np.random.Generator, crop: tuple[int, int] | None) -> list[np.ndarray]:
    costs, picture, place, side = (np.load(room / f"{name}.npy", mmap_mode="r") for name in PARTS)
    k, (height, width) = int(rng.integers(len(side))), costs.shape[2:]
    h, w = (min(crop[0], height), min(crop[1], width)) if crop else (height, width)
    y, x = int(rng.integers(height - h + 1)), int(rng.integers(width - w + 1))
    fine = np.s_[2 * y : 2 * (y + h), 2 * x : 2 * (x + w)]
    return [costs[k, :, y : y + h, x : x + w], picture[k][fine], place[k][fine], side[k]]


def disturbed(batch: Batch) -> Batch:
    """Return a batch mirrored, with weaker and noisier costs, and other brightness, contrast, colours and noise."""
    likeness, picture, place = batch.likeness, batch.picture, batch.place
    device, count = likeness.device, len(likeness)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(count, *shape, device=device)

    if torch.rand(()) < 0.5:
        likeness, picture, place = likeness.flip(3), picture.flip(3), place.flip(2)
    likeness = likeness * (0.6 + 0.6 * drawn(1, 1, 1)) + torch.randn_like(likeness) * (0.06 * drawn(1, 1, 1))
    picture = picture.clamp(0.0, 1.0) ** (0.6 + 0.9 * drawn(1, 1, 1))
    picture = picture * (0.6 + 0.6 * drawn(3, 1, 1)) + 0.15 * (drawn(1, 1, 1) - 0.5)
    gray, share = picture.mean(1, keepdim=True), drawn(1, 1, 1)
    picture = picture * (1.0 - share) + gray * share + torch.randn_like(picture) * (0.03 * drawn(1, 1, 1))
    picture = torch.where(drawn(1, 1, 1) < 0.05, torch.full_like(picture, 0.5), picture)
    return Batch(likeness, picture, place, batch.side)


def sweep_losses(said: SweepPrediction, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cross entropy of planes, the Laplace likelihood of depth, and the error of places in planes."""
    known = (batch.place > -0.5) & (batch.place < PLANES - 0.5)
    true, count = batch.place.clamp(0, PLANES - 1), known.sum().clamp_min(1)
    four = F.pixel_unshuffle(true[:, None], 2)
    low = four.floor().clamp(max=PLANES - 2)
    log_p, part = said.logits.log_softmax(1), four - low
    planes = log_p.gather(1, low.long()) * (1.0 - part) + log_p.gather(1, low.long() + 1) * part
    cross = -(planes * F.pixel_unshuffle(known[:, None].float(), 2)).sum() / count
    likelihood = relative_error(said, batch).clamp(max=1.5) / said.log_error.exp() + said.log_error
    off = (said.place - true).abs().clamp(max=6.0)
    return cross, (likelihood * known).sum() / count, (off * known).sum() / count


def relative_error(said: SweepPrediction, batch: Batch) -> Tensor:
    """Return how far depth is off, as a natural logarithm. Shape (B, 2h, 2w)."""
    ratio = batch.side[:, 1]  # of the least inverse depth to the greatest
    below = (ratio / (1.0 - ratio) * (PLANES - 1))[:, None, None]
    true = batch.place.clamp(0, PLANES - 1) + below
    return (torch.log((said.place + below).clamp_min(0.02)) - torch.log(true)).abs()


def judge_sweep(network: SweepNetwork, rooms: Sequence[Path]) -> dict[str, list[float]]:
    """Return median error of depth and shares off by 5 and by 10 percent, among so many of the surest pixels."""
    if not rooms:
        return {}
    errors, said_errors = [], []
    settings, device = SweepFitSettings(batch=1), next(network.parameters()).device
    network.eval()
    for room in rooms:
        batch = draw_batch([room], np.random.default_rng(0), settings, device)
        with torch.inference_mode():
            said = network(batch.likeness, batch.picture * 2.0 - 1.0, batch.side)
            known = (batch.place > -0.5) & (batch.place < PLANES - 0.5)
            errors.append(relative_error(said, batch)[known].cpu().numpy())
        said_errors.append(said.log_error[known].cpu().numpy())
    error = np.concatenate(errors)[np.argsort(np.concatenate(said_errors), kind="stable")]
    out = {}
    for share in (0.5, 0.8, 0.95, 1.0):
        surest = error[: int(share * len(error))]
        values = float(np.median(surest)), float((surest > 0.05).mean()), float((surest > 0.1).mean())
        out[f"surest {share:g}"] = [round(v, 4) for v in values]
    return out

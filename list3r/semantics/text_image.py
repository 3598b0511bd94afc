"""Models whose vectors of words and of pictures can be compared: CLIP and SigLIP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import MAX_TEXT_BYTES, read_file
from list3r.memory.core.errors import OptionError, first_line
from list3r.memory.core.unpacking import parse_json
from list3r.models.images import HALF, InputShape, network_input
from list3r.models.pretrained import load_pretrained, pick_device, space_name

CLASSES = {"clip": "CLIPModel", "siglip": "SiglipModel"}
"""Network of each `model_type`; SigLIP 2 with a fixed picture size is of type siglip."""
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
CLIP_COSINE = 0.22
"""CLIP's cosines of a picture with a fitting and with an unfitting phrase are about this value."""
PROBABILITY = 0.05
"""SigLIP says itself how likely text and picture belong together; this is enough to be an answer."""
WORDS = 64
"""Tokens that SigLIP's text side was trained with, always filled up."""
BATCH = 16


class TextImageModel:
    """Encodes words and pictures into one space. Meets `queries.free_words.WordEncoder`."""

    def __init__(self, folder: Path, device: str = "auto") -> None:
        """`folder` holds configuration, weights and tokenizer. Raises `OptionError`."""
        self._device = pick_device(device)
        kind = model_type(folder)
        self._network = load_pretrained(CLASSES[kind], folder, self._device)
        self._tokenizer = load_tokenizer(folder)
        self._siglip = kind == "siglip"
        config = self._network.config
        size = int(config.vision_config.image_size)
        mean, std = (HALF, HALF) if self._siglip else (CLIP_MEAN, CLIP_STD)
        self._shape = InputShape(size, size, mean=mean, std=std)
        width = int(config.text_config.hidden_size if self._siglip else config.projection_dim)
        self.space = space_name(kind, folder, width)
        """`model@revision/dim`."""
        self.min_cosine = self._least()
        """From here a picture is said to show what words say."""

    def encode(self, text: str) -> NDArray[np.float32]:
        """Unit vector of words. Shape (D,)."""
        import torch

        filled = {"padding": "max_length", "max_length": WORDS} if self._siglip else {"padding": True}
        words = self._tokenizer([f"a photo of a {text}".lower()], truncation=True, return_tensors="pt", **filled)
        with torch.inference_mode():
            asked = {"input_ids": words["input_ids"].to(self._device)}
            if not self._siglip:
                asked["attention_mask"] = words["attention_mask"].to(self._device)
            out = self._network.get_text_features(**asked)
        return np.asarray(_unit(_vector(out))[0])

    def encode_pictures(self, pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Unit vectors of pictures (H, W, 3) of any sizes. Shape (N, D)."""
        import torch

        parts = []
        for start in range(0, len(pictures), BATCH):
            inputs = [
                network_input(p, self._shape, self._device, self._network.dtype)
                for p in pictures[start : start + BATCH]
            ]
            with torch.inference_mode():
                parts.append(_unit(_vector(self._network.get_image_features(pixel_values=torch.cat(inputs)))))
        return np.concatenate(parts) if parts else np.zeros((0, 0), np.float32)

    def _least(self) -> float:
        if not self._siglip:
            return CLIP_COSINE
        scale = math.exp(float(self._network.logit_scale.detach().float().reshape(-1)[0]))
        bias = float(self._network.logit_bias.detach().float().reshape(-1)[0])
        return min(1.0, (math.log(PROBABILITY / (1.0 - PROBABILITY)) - bias) / scale)


def model_type(folder: Path) -> str:
    """The kind of network that a folder holds. Raises `OptionError` for one that no vectors of words can be had of."""
    try:
        kind = str(parse_json(read_file(folder / "config.json", MAX_TEXT_BYTES))["model_type"])
    except (OSError, ValueError, KeyError, TypeError):
        raise OptionError(f"{folder} has no config.json that says what network it holds") from None
    if kind not in CLASSES:
        raise OptionError(f"{folder} holds a {kind} network; words and pictures need one of {', '.join(CLASSES)}")
    return kind


def square_crop(picture: NDArray[np.uint8], box: Sequence[float], margin: float = 0.15) -> NDArray[np.uint8]:
    """A square around a box (x0, y0, x1, y1), px, with some of what is around it; grey beyond the picture's border."""
    x0, y0, x1, y1 = (float(v) for v in box)
    half = 0.5 * max(x1 - x0, y1 - y0) * (1.0 + 2.0 * margin)
    half = max(half, 4.0)
    cx, cy = (x0 + x1) / 2.0, (y0 + y1) / 2.0
    left, top, side = math.floor(cx - half), math.floor(cy - half), math.ceil(2.0 * half)
    out = np.full((side, side, 3), 127, np.uint8)
    height, width = picture.shape[:2]
    ys, xs = slice(max(0, top), min(height, top + side)), slice(max(0, left), min(width, left + side))
    if ys.start < ys.stop and xs.start < xs.stop:
        out[ys.start - top : ys.stop - top, xs.start - left : xs.stop - left] = picture[ys, xs]
    return out


def load_tokenizer(folder: Path) -> Any:
    """Return the tokenizer of a folder. Raises `OptionError`."""
    from transformers import AutoTokenizer

    try:
        return AutoTokenizer.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ImportError) as error:
        raise OptionError(f"{folder} has no tokenizer that can be read ({first_line(error)}); fetch it again") from None


def _vector(out: Any) -> NDArray[np.float32]:
    found = getattr(out, "pooler_output", out)
    return np.asarray(found.float().cpu().numpy(), np.float32)


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9), np.float32)

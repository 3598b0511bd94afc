"""OWLv2 through `transformers`: a box detector that is asked for our nouns (Minderer et al., Scaling Open-Vocabulary
Object Detection, 2023).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.nouns import all_nouns
from list3r.models.images import InputShape, network_input
from list3r.models.pretrained import load_pretrained, pick_device
from list3r.semantics.detector import Detections
from list3r.semantics.nanodet import suppressed
from list3r.semantics.text_image import CLIP_MEAN, CLIP_STD, load_tokenizer

MIN_SCORE, MAX_OVERLAP = 0.1, 0.5
_WORDS = 16
"""Tokens of a prompt, the length that OWLv2 is trained with."""


class OpenVocabulary:
    """A `Detector` of all nouns that have a usual size; their prompts are encoded once."""

    name = "owlv2"

    def __init__(self, folder: Path, device: str = "auto", names: tuple[str, ...] | None = None) -> None:
        """`folder` holds configuration, weights and tokenizer. Raises `OptionError`."""
        import torch

        self.class_names = names or tuple(n.name for n in all_nouns().values() if n.size_cm)
        self._device = pick_device(device)
        self._network = load_pretrained("Owlv2ForObjectDetection", folder, self._device, exact=True)
        side = int(self._network.config.vision_config.image_size)
        self._shape = InputShape(side, side, keep_aspect=True, mean=CLIP_MEAN, std=CLIP_STD)
        words = load_tokenizer(folder)(
            [f"a photo of a {n}" for n in self.class_names],
            padding="max_length",
            truncation=True,
            max_length=_WORDS,
            return_tensors="pt",
        )
        with torch.inference_mode():
            asked = {k: words[k].to(self._device) for k in ("input_ids", "attention_mask")}
            self._prompts = self._network.owlv2.get_text_features(**asked).pooler_output[None]

    def __call__(self, color: NDArray[np.uint8]) -> Detections:
        """Find things in an RGB picture. Shape (H, W, 3)."""
        import torch

        height, width = color.shape[:2]
        with torch.inference_mode():
            seen = network_input(color, self._shape, self._device, self._network.dtype)
            grid, _ = self._network.image_embedder(pixel_values=seen)
            features = grid.flatten(1, 2)
            score = self._network.class_predictor(features, self._prompts)[0][0].sigmoid().cpu().numpy()
            middle = self._network.box_predictor(features, grid)[0].cpu().numpy() * max(height, width)
        boxes = np.concatenate([middle[:, :2] - middle[:, 2:] / 2, middle[:, :2] + middle[:, 2:] / 2], axis=1)
        boxes = np.clip(boxes, 0, [width, height, width, height]).astype(np.float32)
        sure, classes = score.max(axis=1).astype(np.float32), score.argmax(axis=1).astype(np.int64)
        rows = np.flatnonzero(sure >= MIN_SCORE)
        kept = rows[suppressed(boxes[rows], sure[rows], classes[rows], MAX_OVERLAP)]
        return Detections(boxes[kept], sure[kept], classes[kept])

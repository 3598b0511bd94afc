"""NanoDet through `ncnn`: a box detector that takes 20 ms a picture on one core of a laptop.

Each cell of three grids (strides 8, 16, 32) gives a score for each class and, for each side of a box, a distribution
over 0 to 7 strides whose mean is the distance from the cell's centre (Li et al., Generalized Focal Loss, 2020).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import MAX_TEXT_BYTES, read_file
from list3r.memory.core.description.coco import COCO_80
from list3r.memory.core.errors import OptionError, install_hint
from list3r.semantics.detector import Detections
from list3r.weights import PublishedFile

_MEAN_BGR = (103.53, 116.28, 123.675)
_STD_BGR = (57.375, 57.12, 58.395)
_INPUT_SIDE = 320
"""Side of the square pictures that NanoDet is trained on, unless the file's name says another (nanodet-m-416)."""
_GRID = re.compile(r"cls_pred_stride_(\d+)$")


_ASSETS = (
    "https://raw.githubusercontent.com/nihui/ncnn-android-nanodet/7e1ff26429c07b6a9de31fb9323a866d37597034"
    "/app/src/main/assets/"
)
PUBLISHED = {
    "nanodet-m-416.param": PublishedFile(
        _ASSETS + "nanodet-m.param", "c1e7f51fd49b90b275cb6d585ea93c7d915cbfbe17874054abb57403afb9043b", 13_710
    ),
    "nanodet-m-416.bin": PublishedFile(
        _ASSETS + "nanodet-m-416.bin", "87e4e78c6ecaf94cfffc3f7c8dd73f85beb0b185cd14962fb4d05dd8b1249571", 1_901_612
    ),
}
"""The network for pictures of 416 px, by file; its description is the same for 320 px."""


@dataclass(frozen=True)
class DetectorSettings:
    """What counts as a detection."""

    min_score: float = 0.1
    """Boxes less sure are dropped. Low, because votes are weighed by scores: see `detection.voting`."""
    max_overlap: float = 0.5
    """Of two boxes of one class that overlap by more (IoU) the surer stays."""
    side_px: int | None = None
    """Longer side of the picture that the network sees; None: what it is trained on."""


class NanoDet:
    """A `Detector`; the network is loaded once."""

    def __init__(
        self, param: Path, class_names: tuple[str, ...] = COCO_80, settings: DetectorSettings | None = None
    ) -> None:
        """Loads `param` and the `.bin` beside it. Raises `OptionError` for files that are none of NanoDet."""
        self._settings = settings or DetectorSettings()
        self._names = class_names
        self.name = param.stem
        self._strides = _strides(param)
        self._side = self._settings.side_px or _trained_side(param)
        self._net = _load(param)
        self._check()

    @property
    def class_names(self) -> tuple[str, ...]:
        """What the classes are called."""
        return self._names

    def __call__(self, color: NDArray[np.uint8]) -> Detections:
        """Find things in an RGB picture. Shape (H, W, 3)."""
        height, width = color.shape[:2]
        scale = self._side / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = cv2.resize(color, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        boxes, scores, classes = self._decode(np.asarray(small))
        boxes = boxes * np.array([width / small.shape[1], height / small.shape[0]] * 2, np.float32)
        boxes = np.clip(boxes, 0, [width, height, width, height]).astype(np.float32)
        keep = suppressed(boxes, scores, classes, self._settings.max_overlap)
        return Detections(boxes[keep], scores[keep], classes[keep])

    def _decode(self, small: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
        """Boxes in px of the small picture before suppression, with score and class."""
        found = self._outputs(small)
        boxes, scores, classes = [], [], []
        for stride, (score, sides) in found.items():
            columns = -(-small.shape[1] // 32) * 32 // stride
            best = score.max(axis=1)
            rows = np.flatnonzero(best >= self._settings.min_score)
            bins = sides.shape[1] // 4
            z = sides[rows].reshape(-1, 4, bins)
            p = np.exp(z - z.max(axis=2, keepdims=True))
            distance = (p / p.sum(axis=2, keepdims=True)) @ np.arange(bins, dtype=np.float32) * stride
            center = (np.stack([rows % columns, rows // columns], axis=1) + 0.5) * stride
            boxes.append(np.concatenate([center - distance[:, :2], center + distance[:, 2:]], axis=1))
            scores.append(best[rows])
            classes.append(score[rows].argmax(axis=1))
        return (
            np.concatenate(boxes).astype(np.float32),
            np.concatenate(scores).astype(np.float32),
            np.concatenate(classes).astype(np.int64),
        )

    def _outputs(self, small: NDArray[np.uint8]) -> dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Scores (cells, classes) and distributions (cells, 4 x bins) by stride; the picture is filled up to 32s."""
        import ncnn

        height, width = (-(-n // 32) * 32 for n in small.shape[:2])
        filled = np.zeros((height, width, 3), np.float32)
        filled[: small.shape[0], : small.shape[1]] = (small[..., ::-1] - np.array(_MEAN_BGR)) / np.array(_STD_BGR)
        planes = np.ascontiguousarray(filled.transpose(2, 0, 1))
        out = {}
        with self._net.create_extractor() as extractor:
            # The matrix borrows the array's memory, so the array has to outlive the extraction.
            extractor.input("input.1", ncnn.Mat(planes))
            for stride in self._strides:
                score = np.array(extractor.extract(f"cls_pred_stride_{stride}")[1], dtype=np.float32)
                sides = np.array(extractor.extract(f"dis_pred_stride_{stride}")[1], dtype=np.float32)
                out[stride] = score, sides
        return out

    def _check(self) -> None:
        """Raise `OptionError` where the network's outputs and the names of its classes do not fit together."""
        stride, (score, sides) = next(iter(self._outputs(np.zeros((64, 64, 3), np.uint8)).items()))
        cells = (64 // stride) ** 2
        if score.ndim != 2 or sides.ndim != 2 or len(score) != cells or sides.shape[1] % 4:
            raise OptionError(f"--detector {self.name}: the network's outputs are not those of NanoDet")
        if score.shape[1] != len(self._names):
            raise OptionError(
                f"--detector {self.name} has {score.shape[1]} classes but {len(self._names)} names; give a file "
                "with one name per line by --detector-classes"
            )


def read_class_names(path: Path) -> tuple[str, ...]:
    """One class name a line, in the order of the network's outputs. Raises `OptionError`."""
    try:
        lines = read_file(path, MAX_TEXT_BYTES).decode("utf-8").splitlines()
    except OSError as error:
        raise OptionError(f"--detector-classes {path} cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise OptionError(f"--detector-classes {path} is not a text file; it must hold one name per line") from None
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise OptionError(f"--detector-classes {path} is empty; one name per line is needed")
    return names


def suppressed(
    boxes_xyxy: NDArray[np.float32], scores: NDArray[np.float32], classes: NDArray[np.int64], most: float
) -> NDArray[np.int64]:
    """Boxes that stay, surest first: of two of one class that overlap by more than `most` (IoU) the surer does."""
    corner_size = np.column_stack([boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]]).tolist()
    return np.array(cv2.dnn.NMSBoxesBatched(corner_size, scores.tolist(), classes.tolist(), 0.0, most), np.int64)


def _trained_side(param: Path) -> int:
    found = re.search(r"(?<!\d)(\d{3})(?!\d)", param.stem)
    return int(found[1]) if found and int(found[1]) % 32 == 0 else _INPUT_SIDE


def _strides(param: Path) -> list[int]:
    """Strides of the grids that the network's description names. Raises `OptionError`."""
    try:
        text = read_file(param, MAX_TEXT_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError):
        raise OptionError(f"--detector {param}: a .param file of ncnn is needed, with its .bin beside it") from None
    found = sorted({int(m[1]) for word in text.split() if (m := _GRID.match(word))})
    if not text.startswith("7767517") or not found:
        raise OptionError(f"--detector {param} is not a NanoDet for ncnn (it has no outputs cls_pred_stride_8, ...)")
    return found


def _load(param: Path) -> Any:
    try:
        import ncnn
    except ImportError:
        raise OptionError(f"--detector needs ncnn, which is not installed: {install_hint('detector')}") from None
    weights = param.with_suffix(".bin")
    if not weights.is_file():
        raise OptionError(f"--detector {param}: its weights {weights.name} are not beside it")
    net = ncnn.Net()
    net.opt.num_threads = 1
    net.opt.use_vulkan_compute = False
    net.opt.use_fp16_arithmetic = net.opt.use_fp16_storage = net.opt.use_fp16_packed = net.opt.use_bf16_storage = False
    if net.load_param(str(param)) != 0 or net.load_model(str(weights)) != 0:
        raise OptionError(f"--detector {param}: ncnn cannot load it; is the copy complete?")
    return net

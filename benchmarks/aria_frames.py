"""Discovery in frames of a real flat: the Aria Digital Twin frames in facebookresearch/projectaria_tools.

    pip install --no-deps projectaria-tools
    PYTHONPATH=. python benchmarks/aria_frames.py --recording FOLDER --json benchmarks/results/aria-frames.json

FOLDER is data/gen1/aria_digital_twin_test_data of that repository: two pictures with depth (of the twin, without a
sensor's noise), a thirtieth of a second apart, and with an instance at every pixel. They are one chunk with recorded
poses. A memory lists no object seen in two frames only, so the chunk's instances are compared, by masks. Objects count
from 0.2 % of the pixels with depth, 150 px of 320 x 240. Doors and drawers of cupboards, which are parts, and the flat
itself are ignored, and masks mostly on them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

from list3r.evaluation.instances import match_boxes
from list3r.frames.readers.aria import AriaSource
from list3r.frames.source import SourceOptions
from list3r.memory.core.masks import decode_mask
from list3r.memory.store.store import Store

Ints = NDArray[np.int64]
SEGMENTS = "400-1"
"""Stream of instances in segmentations.vrs."""
SIDE = 640
"""Pictures are compared at this width and height."""
LEAST_SHARE = 150 / (320 * 240)
NO_OBJECTS = ("part of a cabinet/wardrobe", "shelter")
"""Categories that are no objects of their own."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, required=True, help="folder with video.vrs, segmentations.vrs, ...")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    truth, names = true_pictures(args.recording)
    with tempfile.TemporaryDirectory() as scratch:
        memory = Path(scratch) / "memory.l3r"
        run_list3r("build", str(args.recording), "-m", str(memory), "--poses", "given")
        found = found_masks(memory)
    result = compared(truth, names, found)
    print(machine())
    for name, value in result.items():
        print(name, value)
    write_json(args.json, result)


def true_pictures(recording: Path) -> tuple[dict[int, Ints], dict[int, str]]:
    """The instance at every pixel of each picture, 0 for none and where no depth is known, and categories by id."""
    from projectaria_tools.core.data_provider import create_vrs_data_provider
    from projectaria_tools.core.sensor_data import TimeDomain
    from projectaria_tools.core.stream_id import StreamId

    source, stream = AriaSource(recording, SourceOptions()), StreamId(SEGMENTS)
    segments = create_vrs_data_provider(str(recording / "segmentations.vrs"))
    times_s = np.array(segments.get_timestamps_ns(stream, TimeDomain.DEVICE_TIME)) * 1e-9
    categories = {int(k): str(v["category"]) for k, v in json.loads((recording / "instances.json").read_text()).items()}
    known, out = sorted(categories), {}
    for frame in source.read(0, source.info.frame_count):
        number = int(np.argmin(np.abs(times_s - frame.time_s)))
        picture = segments.get_image_data_by_index(stream, number)[0].to_numpy_array().astype(np.int64).squeeze()
        place = np.searchsorted(known, picture) + 1
        place[~np.isin(picture, known)] = 0
        upright = source._view.depth(place.astype(np.float32)) * (frame.depth > 0)  # the nearest pixel's, as depth is
        out[frame.index] = cv2.resize(upright, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST).astype(np.int64)
    return out, {n + 1: categories[k] for n, k in enumerate(known)}


def found_masks(memory: Path) -> dict[int, dict[int, NDArray[np.bool_]]]:
    """Masks of the chunk's instances without structure, by local id and frame."""
    out: dict[int, dict[int, NDArray[np.bool_]]] = {}
    with Store.open(memory) as store:
        for node in store.local_instances.nodes([c.chunk_id for c in store.chunks.all()]):
            track = store.local_instances.mask_track(node.chunk_id, node.local_id)
            for frame, runs in zip(track.frames.tolist(), track.masks, strict=True):
                mask = decode_mask(runs, track.image_size).astype(np.uint8)
                small = cv2.resize(mask, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
                if not node.structure:
                    out.setdefault(node.local_id, {})[frame] = small.astype(bool)
    return out


def compared(
    truth: dict[int, Ints], names: dict[int, str], found: dict[int, dict[int, NDArray[np.bool_]]]
) -> dict[str, Any]:
    """Recall and precision by masks, and the best match of each true object."""
    px = np.sum([np.bincount(t.ravel(), minlength=len(names) + 1) for t in truth.values()], axis=0)
    large = [k for k in names if px[k] >= LEAST_SHARE * SIDE**2]
    wanted = [k for k in large if names[k] not in NO_OBJECTS]
    shared = np.zeros((len(found), len(names) + 1), np.int64)
    own = np.zeros(len(found), np.int64)
    for row, masks in enumerate(found.values()):
        for frame, mask in masks.items():
            shared[row] += np.bincount(truth[frame][mask], minlength=len(names) + 1)
            own[row] += mask.sum()
    below = shared[:, 1:].argmax(axis=1) + 1
    counted = [row for row in range(len(found)) if below[row] in wanted or not shared[row, 1:].any()]
    iou = shared[counted][:, wanted].T / (px[wanted][:, None] + own[counted][None] - shared[counted][:, wanted].T)
    best = {f"{names[k]} {k}": round(float(iou[n].max()), 2) for n, k in enumerate(wanted)}
    out: dict[str, Any] = {"frames": len(truth), "true_things": len(wanted), "found": len(counted)}
    for threshold in (0.25, 0.5):
        right = len(match_boxes(iou, threshold))
        out |= {f"mask_recall_{threshold:g}": round(right / len(wanted), 3)}
        out |= {f"mask_precision_{threshold:g}": round(right / len(counted), 3)}
    return out | {"best_iou": best}


if __name__ == "__main__":
    main()

"""Place recognition by frame descriptors: simulated ones by kind of video, and real ones on a real sequence.

    python benchmarks/frame_likeness.py --json FILE                                   # every kind of video, one seed
    python benchmarks/frame_likeness.py --real .../redkitchen --aliked .../aliked-t16.pth --json FILE

Pairs of frames more than 100 apart; a pair is a revisit where both see 30 % of the other's surface, and none where they
share under 5 %. Figures are the recall of revisits at the thresholds of precision 0.9 and 0.99, and the share of frames
with a revisit whose most similar frame shares 10 % (recall@1). Real: VLAD of SIFT as builds have it, and of ALIKED with
words of the first 30 frames. Simulated masks of the first chunk are scored by pixels over all frames: recall and
precision at IoU 0.5, tracks that hold a second object, further tracks of one object, and tracks of walls and floors, as
shares of the objects or of the tracks.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from machine import write_json
from numpy.typing import NDArray

Array = NDArray[np.float64]
OLD, RETURNS = "calm,loop,kidnap,dynamic,twins,sparse,corridor", "opposite,night,moved,alike,halls,seasons"
APART, REVISIT, NONE, FOUND = 100, 0.30, 0.05, 0.10
"""Frames between the two of a pair; shares of surface of a revisit, of none, and of a correct match."""
LEAST_PX = 300
"""Pixels of an object over a chunk of a hundred frames from which it counts."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default=f"{OLD},{RETURNS}")
    parser.add_argument("--seeds", default="51,101", help="of the older kinds, and of those with a changed appearance")
    parser.add_argument("--real", type=Path, help="a folder as redkitchen's: colour, depth and poses of a frame each")
    parser.add_argument("--aliked", type=Path, help="weights of ALIKED")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    if words.real is not None:
        result = real(words.real, words.aliked)
    else:
        old, returns = map(int, words.seeds.split(","))
        result = {p: simulated(p, returns if p in RETURNS.split(",") else old) for p in words.presets.split(",")}
    for name, report in result.items():
        print(name, report)
    write_json(words.json, {"likeness": result})


def simulated(preset: str, seed: int) -> dict[str, Any]:
    """Figures of the simulated network's descriptors, every fifth frame of one video."""
    from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
    from benchmarks.simulation.covisibility import MOST_DEG, seen_share
    from benchmarks.simulation.presets import make_video
    from benchmarks.simulation.returns import make_return

    later = preset in RETURNS.split(",")
    video = make_return(preset, seed) if later else make_video(preset, seed)
    errors = FeedForwardSettings.unseen_home(preset == "halls") if later else FeedForwardSettings()
    rows = np.arange(0, len(video.time_s), 5)
    model = FeedForwardModel(video, errors, seed=seed)
    report = figures(rows, seen_share(video, rows, rows, MOST_DEG), model.descriptors[rows].astype(np.float64))
    return report | {"seed": seed, "masks": masks(video, model)}


def masks(video: Any, model: Any) -> dict[str, Any]:
    """Scores of the simulated masks of the first chunk, by pixels of all its frames."""
    from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
    from list3r.memory.core.masks import decode_mask

    span = plan_chunks(len(video.time_s), ChunkSettings(), ())[0]
    library = model.chunk(span).library
    objects = {t.id for t in video.world.objects if t.structure is None}
    ids = video.ids[span.start : span.stop]
    size = np.bincount(ids.ravel())
    known = [k for k in sorted(objects) if k < len(size) and size[k] >= LEAST_PX]
    tracks = [i.track for i in library.instances if not i.structure and not i.dynamic]
    held = np.zeros((len(tracks), len(size)))
    for row, track in zip(held, tracks, strict=True):
        for frame, runs in zip(track.frames, track.masks, strict=True):
            row += np.bincount(ids[frame - span.start][decode_mask(runs, track.image_size)], minlength=len(size))
    iou = held / (held.sum(axis=1, keepdims=True) + size - held)
    most = held.argmax(axis=1)
    own = np.isin(most, sorted(objects))
    second = np.sort(np.where(np.isin(np.arange(len(size)), sorted(objects)), held, 0.0), axis=1)[:, -2]
    merged = own & (second >= 0.25 * held.sum(axis=1))
    further = own.sum() - len(np.unique(most[own]))
    return {
        "things": len(known),
        "tracks": len(tracks),
        "recall_0.5": round(float((iou[:, known] >= 0.5).any(axis=0).mean()), 3),
        "precision_0.5": round(float((iou[:, known] >= 0.5).any(axis=1).mean()), 3),
        "merged_of_tracks": round(float(merged.mean()), 3),
        "further_of_things": round(float(further / len(known)), 3),
        "structure_of_tracks": round(float((~own).mean()), 3),
    }


def real(folder: Path, aliked: Path | None) -> dict[str, Any]:
    """Figures of descriptors of every tenth frame of a folder of 7-Scenes' layout with numbered frames."""
    from list3r.evaluation.covisibility import covisibility
    from list3r.frames.base import Camera, Frame
    from list3r.frames.options import SourceOptions
    from list3r.frames.source import open_source
    from list3r.reconstruction.features.detectors import make_detector
    from list3r.reconstruction.features.local import detect
    from list3r.reconstruction.features.settings import FeatureSettings
    from list3r.reconstruction.features.vlad import describe_frame

    source = open_source(str(folder), SourceOptions())
    rows = np.arange(0, source.info.frame_count, 10)
    frames = [f for k in rows for f in source.read(int(k), int(k) + 1) if isinstance(f, Frame)]
    camera = source.info.camera
    assert isinstance(camera, Camera) and len(frames) == len(rows)
    depth = np.stack([f.depth for f in frames if f.depth is not None])
    share = covisibility(depth, np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None]), camera)
    found = [detect(f.color, d, camera, FeatureSettings()).descriptors for f, d in zip(frames, depth, strict=True)]
    out = {"VLAD of SIFT, as builds have it": figures(rows, share, np.stack([describe_frame(d) for d in found]))}
    if aliked is not None:
        detector = make_detector("aliked", aliked)
        out["VLAD of ALIKED"] = figures(rows, share, vlad([detector(f.color, 500).descriptors for f in frames]))
    return out


def vlad(descriptors: Sequence[NDArray[np.float32]], words: int = 64) -> Array:
    """VLAD with words of the first 30 frames. Shape (F, words * D)."""
    import faiss

    known = np.concatenate(descriptors[:30]).astype(np.float32)
    kmeans = faiss.Kmeans(known.shape[1], words, niter=15, seed=1)
    kmeans.train(known)
    centres = kmeans.centroids
    out = []
    for x in descriptors:
        word = np.argmin((centres**2).sum(axis=1) - 2.0 * x @ centres.T, axis=1)
        sums = np.zeros(centres.shape, np.float64)
        np.add.at(sums, word, x - centres[word])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        rooted = np.sign(sums) * np.sqrt(np.abs(sums))
        out.append(rooted.ravel() / np.linalg.norm(rooted))
    return np.stack(out)


def figures(rows: NDArray[np.int64], share: NDArray[Any], descriptors: NDArray[Any]) -> dict[str, Any]:
    """Recall at precision and recall@1 of unit descriptors (F, D) of frames (F,) with shares of surface (F, F)."""
    both = np.minimum(np.nan_to_num(share), np.nan_to_num(share).T)
    cosine = descriptors.astype(np.float64) @ descriptors.astype(np.float64).T
    far = np.abs(rows[:, None] - rows[None]) > APART
    i, j = np.nonzero(np.triu(far))
    revisit, none = both[i, j] >= REVISIT, both[i, j] < NONE
    order = np.argsort(-cosine[i, j][revisit | none], kind="stable")
    right = revisit[revisit | none][order]
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    recall = np.cumsum(right) / max(1, int(right.sum()))
    asked = np.flatnonzero((both * far).max(axis=1, initial=0.0) >= REVISIT)
    best = np.where(far, cosine, -2.0)[asked].argmax(axis=1) if len(asked) else asked
    return {
        "revisits": int(revisit.sum()),
        "recall_at_precision_0.9": round(float(recall[precision >= 0.9].max(initial=0.0)), 3),
        "recall_at_precision_0.99": round(float(recall[precision >= 0.99].max(initial=0.0)), 3),
        "recall_at_1": round(float((both[asked, best] >= FOUND).mean()), 3) if len(asked) else None,
        "frames_with_a_revisit": len(asked),
    }


if __name__ == "__main__":
    main()

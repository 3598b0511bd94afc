"""A map of all keyframes at once, for chunks in which a growing map can lose its scale.

A map that grows keyframe by keyframe passes its scale on from one to the next. Where the camera rotates in place it can
reach a local minimum: two halves that each are right, one of them larger by a tenth up to twice, which more adjustment
does not correct (research/colour-video 0208). Global structure from motion (Pan et al., "Global Structure-from-Motion
Revisited", ECCV 2024, as in pycolmap) averages rotations and places all cameras and points together. It takes several
times as long, so it is used only where rotations lose scale or a map separates keyframes that share matches; the map
that explains more of the pictures is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from list3r.frames.base import Camera
from list3r.reconstruction.scale_loss import lost_scale
from list3r.reconstruction.sfm.colmap import pycolmap
from list3r.reconstruction.sfm.mapping import (
    MapProblem,
    Matches,
    Poses,
    SparseMap,
    adjusted,
    database_of,
    sparse_map,
    without_context,
)
from list3r.reconstruction.sfm.pure_rotation import only_turns
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, SEED, MappingSettings


def with_global_map(
    maps: Sequence[SparseMap], problem: MapProblem, camera: Camera, settings: MappingSettings, verified: Matches | None
) -> list[SparseMap]:
    """Return maps that grew from the keyframes of a problem, the largest first.

    Where rotations may have lost their scale, or they separate keyframes with matches, they are adjusted once more with
    new points, or replaced by a global map that explains as many observations. `verified` is as for `correspondences`.
    """
    turned = any(scale_lost_at_turns(m) >= settings.turned_scale for m in maps)
    if not turned and not _left_apart(maps, problem, problem.pairs if verified is None else verified):
        return list(maps)
    anew = [adjusted(problem, camera, m.T_map_cam, settings, verified) or m for m in maps]
    found = global_map(problem, camera, settings, verified)
    if found is not None:
        alone = adjusted(problem, camera, found.T_map_cam, settings, verified) or found
        apart = [m for m in anew if m.T_map_cam.keys().isdisjoint(found.T_map_cam)]
        if _explained(alone) >= sum(map(_explained, anew)) - sum(map(_explained, apart)):
            anew = [found, *apart]
    return sorted(anew, key=lambda m: -len(m.T_map_cam))


def _left_apart(maps: Sequence[SparseMap], problem: MapProblem, pairs: Matches) -> bool:
    """Return whether a keyframe shares enough matches with one in another map, or in none."""
    of = {key: n for n, m in enumerate(maps) for key in m.T_map_cam}
    return any(
        len(rows) >= LEAST_MATCHES and of.get(a) != of.get(b) and not {a, b} & problem.context
        for (a, b), rows in pairs.items()
    )


def _explained(found: SparseMap) -> int:
    """Return the number of its keyframes' observations that a map explains."""
    return sum(len(view.ids) for view in found.seen.values())


def scale_lost_at_turns(found: SparseMap, steps: int = 10) -> float:
    """Return the deviation of the log scale over the worst that many steps from keyframe to keyframe."""
    keys = sorted(found.T_map_cam)
    T = np.stack([found.T_map_cam[key] for key in keys])
    seen = [np.array([found.points[n] for n in found.seen[key].ids.tolist()]).reshape(-1, 3) for key in keys]
    deep = [np.linalg.norm(p - t[:3, 3], axis=1) for p, t in zip(seen, T, strict=True)]
    usual = float(np.median(np.concatenate(deep)))
    reach = np.array([float(np.median(d)) if len(d) else usual for d in deep])
    variance = lost_scale(T, reach)
    over = np.convolve(variance, np.ones(min(steps, max(len(variance), 1)))) if len(variance) else np.zeros(1)
    return float(np.sqrt(over.max()))


def global_map(
    problem: MapProblem, camera: Camera, settings: MappingSettings, verified: Matches | None
) -> SparseMap | None:
    """Return the largest map of all keyframes at once; None without one, or where the camera only rotates."""
    database = database_of(problem, camera, "", settings, None)
    if database is None:
        return None
    manager = pycolmap.ReconstructionManager()
    pycolmap.GlobalPipeline(_options(), database, manager).run()
    made = [sparse_map(manager.get(k), problem, camera) for k in range(manager.size())]
    largest = max(made, key=lambda m: len(m.T_map_cam), default=None)
    if largest is None:
        return None
    found = adjusted(problem, camera, _held(largest), settings, verified)
    if found is None:
        return None
    poses = _held(found)
    found = without_context(replace(found, T_map_cam=poses, seen={k: found.seen[k] for k in poses}), problem)
    places = {key: view.xy for key, view in problem.views.items()}
    if len(found.T_map_cam) < 2 or only_turns(places, problem.pairs, found.T_map_cam, camera, settings.turning):
        return None
    return found


def _held(found: SparseMap) -> dict[int, Poses]:
    """Poses of the keyframes with enough observed points."""
    return {key: T for key, T in found.T_map_cam.items() if len(found.seen[key].ids) >= LEAST_MATCHES}


def _options() -> Any:
    """Return pycolmap's options: its defaults, but for a known camera, and deterministic."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed, options.min_num_matches = 1, SEED, LEAST_MATCHES
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = 1, SEED
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = SEED
    mapper.global_positioning.use_gpu, mapper.retriangulation.ignore_two_view_tracks = False, False
    adjustment = mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu, adjustment.ceres.solver_options.num_threads = False, 1
    return options

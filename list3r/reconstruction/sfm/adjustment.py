"""Bundle adjustment of keyframes whose poses are known roughly: points are triangulated, all is adjusted, and both
again with narrower gates (IncrementalMapper of pycolmap; Schoenberger, Frahm, "Structure-from-motion revisited", 2016).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.sfm.colmap import pixel_unit, pycolmap
from list3r.reconstruction.sfm.consistency import epipolar_errors
from list3r.reconstruction.sfm.mapping import (
    MapProblem,
    SparseMap,
    correspondences,
    mapper_options,
    mapper_with_poses,
    sparse_map,
)
from list3r.reconstruction.sfm.settings import AdjustmentSettings

Poses = NDArray[np.float64]


def adjust(
    problem: MapProblem, camera: Camera, T_map_cam: Mapping[int, Poses], settings: AdjustmentSettings
) -> SparseMap | None:
    """Views with their poses adjusted, in the frame of reference and scale of the given ones; None for too few
    correspondences.

    All views of the problem must have a pose. Views that see too few points are left out. The lens's residual
    distortion is free, so that it does not deform the map.
    """
    gate = settings.gates_px[0] * pixel_unit(camera)
    cache = correspondences(problem, camera, "k1", settings.mapping, agreeing_rows(problem, camera, T_map_cam, gate))
    if cache is None:
        return None
    mapper, made = mapper_with_poses(cache, T_map_cam)
    options = mapper_options(camera, "k1", settings.mapping)
    for gate, iterations in zip(settings.gates_px, (*settings.early_iterations, settings.iterations), strict=True):
        options.mapper.filter_max_reproj_error = gate * pixel_unit(camera)
        _round(mapper, made, options, iterations, settings.loss_px * pixel_unit(camera))
    found = sparse_map(made, problem, camera)
    kept = {k: T for k, T in found.T_map_cam.items() if len(found.seen[k].ids) >= settings.least_points}
    seen = {k: found.seen[k] for k in kept}
    return SparseMap(kept, found.points, camera, found.k1, found.error_px, seen) if len(kept) > 2 else None


def agreeing_rows(
    problem: MapProblem, camera: Camera, T_map_cam: Mapping[int, Poses], gate_px: float
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return the rows of each pair near the epipolar lines of the poses; none of pairs without poses."""
    out = {}
    for (a, b), rows in problem.pairs.items():
        if a not in T_map_cam or b not in T_map_cam:
            continue
        one, two = problem.views[a].xy[rows[:, 0]], problem.views[b].xy[rows[:, 1]]
        out[a, b] = rows[epipolar_errors(one, two, T_map_cam[a], T_map_cam[b], camera) < gate_px]
    return out


def _round(mapper: Any, made: Any, options: Any, iterations: int, loss_px: float) -> None:
    """Triangulate within the gate of the options, adjust, and leave out points beyond it."""
    gate_px = options.mapper.filter_max_reproj_error
    focal = float(next(iter(made.cameras.values())).params[0])
    triangulation = options.triangulation
    angle = float(np.degrees(np.arctan(gate_px / focal)))
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = angle
    triangulation.complete_max_reproj_error = triangulation.merge_max_reproj_error = gate_px
    for image_id in sorted(made.images):
        mapper.triangulate_image(triangulation, image_id)
    mapper.complete_and_merge_tracks(triangulation)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_focal_length = adjustment.print_summary = False
    ceres = adjustment.ceres
    ceres.loss_function_type, ceres.loss_function_scale = pycolmap.LossFunctionType.SOFT_L1, loss_px
    ceres.solver_options.num_threads = 1
    ceres.solver_options.max_num_iterations = iterations
    ceres.solver_options.function_tolerance = 1e-6
    mapper.adjust_global_bundle(options.mapper, adjustment)
    mapper.filter_points(options.mapper)

"""Structure from motion of keyframes by pycolmap: two-view geometry, incremental mapping, bundle adjustment.

Nothing is written to the disk: the correspondences are in a database in memory. pycolmap's pixels have their origin at
the corner of the upper left pixel, half a pixel from ours. Everything is seeded and uses one thread, so that the same
correspondences give the same structure. Growing a map is a local search, so maps are grown from pairs in up to three
places of a chunk (research/colour-video 0064), roughly, and the kept one is adjusted once it is complete
(research/colour-video 0181).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.sfm.colmap import inverse, make_lens, matrix_of, pixel_unit, pycolmap, rigid_of
from list3r.reconstruction.sfm.consistency import contradicted
from list3r.reconstruction.sfm.pure_rotation import only_turns
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, SEED, MappingSettings

Poses = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class KeyframeView:
    """Correspondences seen in a keyframe."""

    ids: Ints
    """Track numbers. Shape (N,)."""
    xy: Floats
    """px. Shape (N, 2)."""

    def where(self, rows: Sequence[int]) -> KeyframeView:
        """Return some of the correspondences."""
        chosen = np.array(rows, np.int64)
        return KeyframeView(self.ids[chosen], self.xy[chosen])


@dataclass(frozen=True)
class SparseMap:
    """Poses of some keyframes and points, in one frame of reference and scale of their own."""

    T_map_cam: dict[int, Poses]
    """By key of the view. Shape (4, 4)."""
    points: dict[int, NDArray[np.float64]]
    """Map coordinates, by track number. Shape (3,)."""
    camera: Camera
    k1: float = 0.0
    """Radial distortion left in the pictures, where it was free."""
    error_px: float = 0.0
    """Mean reprojection error."""
    seen: dict[int, KeyframeView] = field(default_factory=dict)
    """The points that each view sees, by key of the view."""


Matches = Mapping[tuple[int, int], NDArray[np.int64]]
"""Matching rows of two views, by the two views' keys. Shape (M, 2)."""


@dataclass(frozen=True)
class MapProblem:
    """Keyframes and their correspondences."""

    views: dict[int, KeyframeView]
    pairs: dict[tuple[int, int], NDArray[np.int64]] = field(default_factory=dict)
    """Matching rows of the views, by keys, the smaller first. Shape (M, 2)."""
    matched: frozenset[tuple[int, int]] = frozenset()
    """Pairs whose rows were not tracked but matched by descriptors."""
    context: frozenset[int] = frozenset()
    """Views that help to make the map and are left out of it afterwards."""


def shared_rows(a: KeyframeView, b: KeyframeView) -> NDArray[np.int64]:
    """Rows of the tracks that two views share. Shape (M, 2)."""
    _, at_a, at_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return np.stack([at_a, at_b], axis=1).astype(np.int64)


def build_maps(
    problem: MapProblem,
    camera: Camera,
    *,
    free_camera: str = "",
    settings: MappingSettings | None = None,
    verified: Matches | None = None,
) -> list[SparseMap]:
    """Maps of the keyframes, the largest first; several where they cannot be joined, none without depth or where the
    camera only rotates.

    `free_camera` names the parts of the camera that are estimated as well: "" none, "k1" the distortion, "focal" the
    focal length and the distortion. `verified` is as for `correspondences`.
    """
    chosen = settings or MappingSettings()
    cache = correspondences(problem, camera, free_camera, chosen, verified)
    if cache is None:
        return []
    work = _Work(cache, problem, camera, free_camera, chosen)
    grown: list[list[SparseMap]] = []
    models: dict[int, Any] = {}
    for pair in (None, *(() if free_camera == "focal" else first_pairs(problem, chosen)[: chosen.given_pairs])):
        made = _grown(work, pair)
        maps = [found for found, _ in made]
        own = [(without_context(found, problem), model) for found, model in made]
        own = sorted((m for m in own if len(m[0].T_map_cam) >= 2), key=lambda m: _largest_first(m[0]))
        grown.append([found for found, _ in own])
        models |= {id(found): model for found, model in own}
        if agreed(grown, chosen) or (maps and all(steady(m, chosen.steady) for m in maps)):
            break
        if not maps and pair is None and work.only_turns(problem.views):
            break
    best = best_of(grown, chosen.alike)
    held = {key for found in best for key in found.T_map_cam}
    kept = [*best, *(found for found in grown[0] if not held & found.T_map_cam.keys())]
    return [_finished(work, found, models[id(found)]) for found in kept]


def first_pairs(problem: MapProblem, settings: MappingSettings) -> list[tuple[int, int]]:
    """Further initial pairs of keyframes: those that share most in the second and the last third."""
    own = sorted(problem.views.keys() - problem.context)
    place = {key: n for n, key in enumerate(own)}
    least, most = settings.given_steps
    out = []
    for third in (1, 2):
        part = own[third * len(own) // 3 : (third + 1) * len(own) // 3]
        steps = {p: place[p[1]] - place[p[0]] for p in problem.pairs if p[0] in part and p[1] in place}
        near = [(len(problem.pairs[p]), p) for p, step in sorted(steps.items()) if least <= step <= most]
        out += [max(near)[1]] if near else []
    return out


@dataclass(frozen=True)
class _Work:
    """Inputs of growing maps."""

    cache: Any
    problem: MapProblem
    camera: Camera
    free_camera: str
    settings: MappingSettings
    turns: dict[frozenset[int], bool] = field(default_factory=dict)
    """Whether the camera only rotates in some of the views, as far as it was tested."""

    def only_turns(self, keys: Collection[int]) -> bool:
        """Return whether the camera only rotates in some of the views."""
        some = frozenset(keys)
        if some not in self.turns:
            places = {key: view.xy for key, view in self.problem.views.items()}
            self.turns[some] = only_turns(places, self.problem.pairs, keys, self.camera, self.settings.turning)
        return self.turns[some]


def _grown(work: _Work, pair: tuple[int, int] | None) -> list[tuple[SparseMap, Any]]:
    """Maps that grow from two keyframes, one from a given pair, each with pycolmap's own; none of a camera that only
    rotates."""
    settings = work.settings
    options = mapper_options(work.camera, work.free_camera, settings)
    if settings.rough_iterations:
        options.ba_global_max_num_iterations = settings.rough_iterations
        options.ba_global_max_refinements = 1
    given = pair is not None or work.free_camera == "focal"
    options.mapper.init_min_tri_angle = settings.given_angle_deg if given else settings.first_angle_deg
    if pair is not None:
        options.init_image_id1, options.init_image_id2 = pair[0] + 1, pair[1] + 1
        options.max_num_models = 1
    manager = pycolmap.ReconstructionManager()
    pycolmap.IncrementalPipeline(options, work.cache, manager).run()
    models = [manager.get(k) for k in range(manager.size())]
    maps = [(m, model) for m, model in ((_map_of(work, model), model) for model in models) if _enough(m, settings)]
    return [(m, model) for m, model in maps if not work.only_turns(m.T_map_cam)]


def _finished(work: _Work, found: SparseMap, model: Any) -> SparseMap:
    """Return a roughly grown map adjusted as a whole; unchanged where too little of it would remain."""
    if not work.settings.rough_iterations:
        return found
    whole = _adjust(work, model)
    own = without_context(whole, work.problem)
    return own if _enough(whole, work.settings) and len(own.T_map_cam) >= 2 else found


def _adjust(work: _Work, model: Any) -> SparseMap:
    """Return a map adjusted as a whole."""
    settings = work.settings
    options = mapper_options(work.camera, work.free_camera, settings)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_focal_length = options.ba_refine_focal_length
    adjustment.refine_extra_params = options.ba_refine_extra_params
    adjustment.print_summary = False
    solver = adjustment.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, settings.whole_iterations
    solver.function_tolerance = settings.tolerance
    mapper = pycolmap.IncrementalMapper(work.cache)
    mapper.begin_reconstruction(model)
    change = options.ba_global_max_refinement_change
    mapper.iterative_global_refinement(settings.whole_rounds, change, options.mapper, adjustment, options.triangulation)
    mapper.end_reconstruction(False)
    return _map_of(work, model)


def _map_of(work: _Work, model: Any) -> SparseMap:
    """Return pycolmap's map of a problem, without keyframes that their matches contradict."""
    found = sparse_map(model, work.problem, work.camera)
    return _borne_out(found, work) if work.problem.matched else found


def _enough(found: SparseMap, settings: MappingSettings) -> bool:
    """Return whether a map is large enough."""
    return len(found.points) >= settings.least_points and len(found.T_map_cam) >= 2


def _largest_first(found: SparseMap) -> tuple[int, int]:
    """Key that sorts maps."""
    return -len(found.T_map_cam), min(found.T_map_cam)


def without_context(found: SparseMap, problem: MapProblem) -> SparseMap:
    """Return the map without the context views."""
    poses = {k: T for k, T in found.T_map_cam.items() if k not in problem.context}
    seen = {k: view for k, view in found.seen.items() if k not in problem.context}
    return replace(found, T_map_cam=poses, seen=seen)


def steady(found: SparseMap, most: float) -> bool:
    """Return whether the depth of keyframes' points changes by less than a factor from one to the next.

    A map that lost its scale where the camera rotated explains the pictures as well, but there depth jumps (decision
    0128).
    """
    if most <= 1.0:
        return False
    deep = []
    for key, T in sorted(found.T_map_cam.items()):
        points = np.array([found.points[n] for n in found.seen[key].ids.tolist()]).reshape(-1, 3)
        deep += [float(np.median(np.linalg.norm(points - T[:3, 3], axis=1)))] if len(points) else []
    return bool(np.abs(np.diff(np.log(deep))).max(initial=0.0) <= np.log(most))


def agreed(grown: Sequence[list[SparseMap]], settings: MappingSettings) -> bool:
    """Return whether two unbroken maps hold as many keyframes and explain the pictures equally well.

    Deformed maps may agree too, but where a map is deformed some part of it often does not fit.
    """
    largest = [(len(maps[0].T_map_cam), maps[0].error_px) for maps in grown if len(maps) == 1]
    return any(a == b and max(e, f) <= settings.same_error * min(e, f) for (a, e), (b, f) in combinations(largest, 2))


def best_of(grown: Sequence[list[SparseMap]], alike: float) -> list[SparseMap]:
    """Return the maps whose largest one has the least error among those about as large as any."""
    most = max((len(maps[0].T_map_cam) for maps in grown if maps), default=0)
    large = [maps for maps in grown if maps and len(maps[0].T_map_cam) >= alike * most]
    return min(large, key=lambda maps: maps[0].error_px, default=[])


def _borne_out(found: SparseMap, work: _Work) -> SparseMap:
    """Return the map without keyframes that their matches contradict."""
    problem, camera, seen = work.problem, work.camera, {}
    for a, b in sorted(problem.pairs):
        if a in found.T_map_cam and b in found.T_map_cam:
            rows = work.cache.correspondence_graph.extract_matches_between_images(a + 1, b + 1)
            rows = np.asarray(rows, np.int64).reshape(-1, 2)
            seen[a, b] = problem.views[a].xy[rows[:, 0]], problem.views[b].xy[rows[:, 1]]
    out = contradicted(found.T_map_cam, seen, camera, work.settings.consistency)
    if not out:
        return found
    poses = {k: T for k, T in found.T_map_cam.items() if k not in out}
    views = {k: view for k, view in found.seen.items() if k not in out}
    numbers = set(np.concatenate([np.zeros(0, np.int64), *(view.ids for view in views.values())]).tolist())
    points = {n: xyz for n, xyz in found.points.items() if n in numbers}
    return replace(found, T_map_cam=poses, seen=views, points=points)


def mapper_with_poses(cache: Any, T_map_cam: Mapping[int, Poses]) -> tuple[Any, Any]:
    """Return a mapper, and its map, in which all pictures have given poses and there are no points yet."""
    mapper = pycolmap.IncrementalMapper(cache)
    made = pycolmap.Reconstruction()
    mapper.begin_reconstruction(made)
    for image_id, image in sorted(made.images.items()):
        image.frame.set_cam_from_world(image.camera_id, rigid_of(inverse(T_map_cam[image_id - 1])))
        made.register_frame(image.frame_id)
    return mapper, made


def triangulate(
    problem: MapProblem,
    camera: Camera,
    T_map_cam: Mapping[int, Poses],
    settings: MappingSettings | None = None,
    verified: Matches | None = None,
) -> SparseMap | None:
    """Points of views whose poses are known; None when there are too few. `verified` is as for `correspondences`."""
    chosen = settings or MappingSettings()
    made = _triangulated(problem, camera, T_map_cam, chosen, verified)
    if made is None:
        return None
    found = sparse_map(made[1], problem, camera)
    return found if len(found.points) >= chosen.least_points else None


def adjusted(
    problem: MapProblem,
    camera: Camera,
    T_map_cam: Mapping[int, Poses],
    settings: MappingSettings,
    verified: Matches | None = None,
) -> SparseMap | None:
    """A map of views with approximate poses: its points are triangulated anew, and all is adjusted; None for too few of
    them. `verified` is as for `correspondences`."""
    made = _triangulated(problem, camera, T_map_cam, settings, verified)
    if made is None:
        return None
    cache, model = made
    found = _adjust(_Work(cache, problem, camera, "", settings), model)
    return found if _enough(found, settings) else None


def _triangulated(
    problem: MapProblem,
    camera: Camera,
    T_map_cam: Mapping[int, Poses],
    settings: MappingSettings,
    verified: Matches | None,
) -> tuple[Any, Any] | None:
    """pycolmap's correspondences and map of views whose poses are known, with points; None without correspondences."""
    known = {key: view for key, view in problem.views.items() if key in T_map_cam}
    pairs = {pair: rows for pair, rows in problem.pairs.items() if pair[0] in known and pair[1] in known}
    cache = correspondences(replace(problem, views=known, pairs=pairs), camera, "", settings, verified)
    if cache is None:
        return None
    mapper, made = mapper_with_poses(cache, T_map_cam)
    options = mapper_options(camera, "", settings)
    for image_id in sorted(made.images):
        mapper.triangulate_image(options.triangulation, image_id)
    mapper.complete_and_merge_tracks(options.triangulation)
    mapper.filter_points(options.mapper)
    mapper.end_reconstruction(False)
    return cache, made


def correspondences(
    problem: MapProblem,
    camera: Camera,
    free_camera: str,
    settings: MappingSettings,
    verified: Matches | None = None,
) -> Any:
    """pycolmap's correspondence graph; None when no two views match.

    `verified` are the rows of pairs that agree on a geometry, where that is known already.
    """
    database = database_of(problem, camera, free_camera, settings, verified)
    if database is None:
        return None
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = LEAST_MATCHES
    return pycolmap.DatabaseCache.create(database, options)


def database_of(
    problem: MapProblem, camera: Camera, free_camera: str, settings: MappingSettings, verified: Matches | None
) -> Any:
    """pycolmap's database, in memory; None when no two views match. `verified` is as above."""
    database = pycolmap.Database.open(":memory:")
    lens = make_lens(camera, free_camera)
    lens.camera_id = 1
    database.write_camera(lens, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=1)
    sensor = pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=1)
    rig.add_ref_sensor(sensor)
    database.write_rig(rig, use_rig_id=True)
    for key, view in sorted(problem.views.items()):
        frame = pycolmap.Frame(frame_id=key + 1, rig_id=1)
        frame.add_data_id(pycolmap.data_t(sensor_id=sensor, id=key + 1))
        database.write_frame(frame, use_frame_id=True)
        image = pycolmap.Image(name=f"{key:06d}", camera_id=1, image_id=key + 1)
        image.frame_id = key + 1
        database.write_image(image, use_image_id=True)
        database.write_keypoints(key + 1, (view.xy + np.float32(0.5)).astype(np.float32))
    count = 0
    for (a, b), rows in sorted(problem.pairs.items()):
        matched = (a, b) in problem.matched
        if verified is not None:
            found = pycolmap.TwoViewGeometry()
            found.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            found.inlier_matches = verified.get((a, b), rows[:0]).astype(np.uint32)
        else:
            found = _two_view(problem, (a, b), lens, camera, free_camera, settings)
        wanted = max(LEAST_MATCHES, settings.matched_share * len(rows) if matched else 0.0)
        if found is not None and len(found.inlier_matches) >= wanted:
            database.write_matches(a + 1, b + 1, rows.astype(np.uint32))
            database.write_two_view_geometry(a + 1, b + 1, found)
            count += 1
    return database if count else None


def _two_view(
    problem: MapProblem, pair: tuple[int, int], lens: Any, camera: Camera, free_camera: str, settings: MappingSettings
) -> Any:
    rows = problem.pairs[pair]
    if len(rows) < LEAST_MATCHES:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers, options.detect_watermark = LEAST_MATCHES, False
    options.ransac.max_error = settings.pair_error_px * pixel_unit(camera) * (2.0 if free_camera else 1.0)
    options.ransac.random_seed, options.ransac.num_threads = SEED, 1
    if pair in problem.matched:
        options.min_E_F_inlier_ratio, options.ransac.min_inlier_ratio = 0.0, settings.matched_share
    calibrated, free = pycolmap.estimate_calibrated_two_view_geometry, pycolmap.estimate_two_view_geometry
    estimate = free if free_camera == "focal" else calibrated
    one, two = (view.xy.astype(np.float64) + 0.5 for view in (problem.views[pair[0]], problem.views[pair[1]]))
    return estimate(lens, one, lens, two, rows.astype(np.uint32), options)


def mapper_options(camera: Camera, free_camera: str, settings: MappingSettings) -> Any:
    """Return pycolmap's options for growing and filtering a map."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = 1, SEED, False
    options.min_num_matches, options.min_model_size = LEAST_MATCHES, 2
    options.init_num_trials, options.max_num_models = 50, 10
    options.ba_refine_focal_length = free_camera == "focal"
    options.ba_refine_extra_params = bool(free_camera)
    options.ba_refine_principal_point = False
    options.ba_local_max_num_iterations = settings.part_iterations
    options.ba_local_max_refinements = settings.part_rounds
    options.ba_global_max_num_iterations = settings.whole_iterations
    options.ba_global_max_refinements = settings.whole_rounds
    options.ba_local_function_tolerance = options.ba_global_function_tolerance = settings.tolerance
    options.ba_global_frames_ratio = options.ba_global_points_ratio = settings.growth
    mapper, unit = options.mapper, pixel_unit(camera)
    mapper.num_threads, mapper.random_seed = 1, SEED
    mapper.init_min_num_inliers = 2 * LEAST_MATCHES
    mapper.init_max_error = settings.pair_error_px * unit * (2.0 if free_camera else 1.0)
    mapper.abs_pose_min_num_inliers = LEAST_MATCHES
    mapper.abs_pose_max_error = settings.pose_error_px * unit
    mapper.abs_pose_refine_focal_length = free_camera == "focal"
    mapper.abs_pose_refine_extra_params = bool(free_camera)
    mapper.filter_max_reproj_error = settings.point_error_px * unit
    mapper.filter_min_tri_angle = settings.point_angle_deg
    mapper.ba_local_min_tri_angle, mapper.ba_local_num_images = 2.0, settings.part_views
    options.triangulation.min_angle = settings.point_angle_deg
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.random_seed = SEED
    return options


def sparse_map(made: Any, problem: MapProblem, camera: Camera) -> SparseMap:
    """Return pycolmap's map of a problem."""
    poses: dict[int, Poses] = {}
    for image_id in sorted(made.reg_image_ids()):
        poses[image_id - 1] = inverse(matrix_of(made.images[image_id].cam_from_world()))
    points: dict[int, NDArray[np.float64]] = {}
    best: dict[int, int] = {}
    rows: dict[int, list[int]] = {key: [] for key in poses}
    for _, point in sorted(made.points3D.items()):
        elements = point.track.elements
        for element in elements:
            key = element.image_id - 1
            track = int(problem.views[key].ids[element.point2D_idx])
            rows[key].append(element.point2D_idx)
            if best.get(track, 0) < len(elements):
                best[track], points[track] = len(elements), np.asarray(point.xyz, np.float64)
    seen = {key: problem.views[key].where(sorted(found)) for key, found in rows.items()}
    params = next(iter(made.cameras.values())).params
    if len(params) == 4 and camera.fx == camera.fy and next(iter(made.cameras.values())).model_name == "SIMPLE_RADIAL":
        camera = Camera(camera.width, camera.height, params[0], params[0], params[1] - 0.5, params[2] - 0.5)
        k1 = float(params[3])
    else:
        k1 = 0.0
    error = float(made.compute_mean_reprojection_error()) if made.num_points3D() else 0.0
    return SparseMap(poses, points, camera, k1, error, seen)

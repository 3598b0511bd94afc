"""Point clouds as they come: read from files, thinned to a grid, and given normals."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from list3r.evaluation.cloud import Array, near_order
from list3r.frames.files import check_ordinary
from list3r.memory.core.errors import OptionError, SourceError, first_line
from list3r.memory.core.geometry import Sim3

MESHES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
TABLES = (".xyz", ".txt", ".csv", ".pts")
ENDINGS = (*MESHES, *TABLES, ".npy", ".pcd")
_MESH_SPACING_M = 0.01
_MOST_SAMPLES = 2_000_000


@dataclass(frozen=True)
class PointCloud:
    """Points of surfaces."""

    points: Array
    """Finite. Shape (N, 3)."""
    normals: Array | None
    """Unit length. Shape (N, 3); None where they are not known."""
    text: str = ""
    """Where they come from, for people."""

    def moved(self, S_a_b: Sim3) -> PointCloud:
        """Return the cloud of frame b in frame a."""
        normals = None if self.normals is None else self.normals @ S_a_b.rotation.T
        return PointCloud(S_a_b.apply(self.points), normals, self.text)


def read_cloud(path: str | Path) -> PointCloud:
    """Return points of a PLY, PCD or mesh file, of a table of x y z ... lines, or of an array (N, 3 or more) in `.npy`.

    The faces of a mesh become points about 1 cm apart. Points that are not finite are left out. Raises `SourceError`
    for another kind of file or one without points.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if not path.is_file():
        raise SourceError(f"{path} does not exist or is not a file; give a cloud ({', '.join(ENDINGS)}) or a memory")
    if ending not in ENDINGS:
        raise SourceError(f"{path} ends in {ending or 'nothing'}; give a cloud ({', '.join(ENDINGS)}) or a memory")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            points, normals, words = _read(path, ending)
    except SourceError:
        raise
    except Exception as error:  # the readers of five formats raise whatever they like
        raise SourceError(f"{path} cannot be read as {ending}: {first_line(error)}") from error
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SourceError(f"{path} holds an array of shape {points.shape}; expected points (N, 3)")
    good = np.isfinite(points).all(axis=1)
    if not good.any():
        raise SourceError(f"{path} holds no finite point")
    if normals is not None:
        normals = _unit(np.asarray(normals, dtype=np.float64)[good])
    dropped = f", {(~good).sum()} that are not finite left out" if not good.all() else ""
    return PointCloud(points[good], normals, f"{good.sum():,} points of {words}{dropped}")


_MAX_BYTES = 16 * 2**30


def _read(path: Path, ending: str) -> tuple[Any, Any, str]:
    check_ordinary(path.stat(), path, _MAX_BYTES)
    if ending == ".npy":
        table = np.load(path, allow_pickle=False)
        return *_columns(table, path), "an array"
    if ending in TABLES:
        table = np.loadtxt(path, delimiter="," if ending == ".csv" else None, comments="#", ndmin=2)
        return *_columns(table, path), "a table"
    if ending == ".pcd":
        import open3d

        cloud: Any = open3d.io.read_point_cloud(str(path))  # type: ignore[arg-type]
        return np.asarray(cloud.points), np.asarray(cloud.normals) if cloud.has_normals() else None, "a cloud"
    return _read_mesh(path)


def _columns(table: NDArray[Any], path: Path) -> tuple[Any, None]:
    if table.ndim != 2 or table.shape[1] < 3:
        raise SourceError(f"{path} holds an array of shape {table.shape}; expected points (N, 3), one a row")
    return table[:, :3], None


def _read_mesh(path: Path) -> tuple[Any, Any, str]:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    if isinstance(loaded, trimesh.Scene):
        parts = [g for g in loaded.dump() if hasattr(g, "vertices")]
        meshes = [g for g in parts if isinstance(g, trimesh.Trimesh)]
        if not meshes:
            return np.concatenate([g.vertices for g in parts] or [np.zeros((0, 3))]), None, "a cloud"
        loaded = trimesh.util.concatenate(meshes)
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces):
        count = int(np.clip(loaded.area / _MESH_SPACING_M**2, 1000, _MOST_SAMPLES))
        points, face = trimesh.sample.sample_surface(loaded, count, seed=0)
        return points, loaded.face_normals[face], "the faces of a mesh"
    if not hasattr(loaded, "vertices"):
        raise SourceError(f"{path} holds no points")
    data = (loaded.metadata.get("_ply_raw") or {}).get("vertex", {}).get("data")
    names = getattr(getattr(data, "dtype", None), "names", None) or (data if isinstance(data, dict) else ())
    normals = None
    if data is not None and all(n in names for n in ("nx", "ny", "nz")):
        normals = np.stack([np.ravel(data[n]) for n in ("nx", "ny", "nz")], axis=1)
    return loaded.vertices, normals, "a cloud"


def thinned(cloud: PointCloud, voxel_m: float, most: int | None = None) -> PointCloud:
    """Return one point for each occupied cell of a grid, the mean of its points and normals, and at most `most`.

    The mean hides no error larger than the cell, and makes two clouds of different density comparable.
    """
    if not voxel_m >= 0 or not np.isfinite(voxel_m):
        raise OptionError(f"voxel {voxel_m} m: give 0 for none, or a length")
    if most is not None and most < 1:
        raise OptionError(f"points {most}: at least 1 is needed")
    points, normals = cloud.points, cloud.normals
    if voxel_m > 0:
        cell = _cells(points, voxel_m)
        _, owner, count = np.unique(cell, return_inverse=True, return_counts=True)
        points = _means(points, owner, count)
        normals = None if normals is None else _unit(_means(normals, owner, count))
    if most is not None and len(points) > most:
        rows = np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))
        points, normals = points[rows], None if normals is None else normals[rows]
    return PointCloud(points, normals, cloud.text)


def _cells(points: Array, voxel_m: float) -> NDArray[np.int64]:
    """Return number of cell of each point. Shape (N,). Raises `OptionError` when the grid would be beyond counting."""
    grid = np.floor(points / voxel_m)
    grid -= grid.min(axis=0)
    size = grid.max(axis=0) + 1
    if np.prod(size) > 2**62:
        raise OptionError(f"voxel {voxel_m} m is too small for a cloud of {np.ptp(points, axis=0).max():.3g} m")
    whole = grid.astype(np.int64)
    return np.asarray((whole[:, 0] * int(size[1]) + whole[:, 1]) * int(size[2]) + whole[:, 2])


def _means(values: Array, owner: NDArray[np.int64], count: NDArray[np.int64]) -> Array:
    return (
        np.stack([np.bincount(owner, weights=values[:, k], minlength=len(count)) for k in range(3)], axis=1)
        / (count[:, None])
    )


def estimate_normals(points: ArrayLike, neighbours: int = 24) -> Array:
    """Return the unit normals, either way round, of the planes through each point's nearest neighbours. Shape (N, 3) ->
    (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    k = min(neighbours, len(p))
    if k < 3:
        return np.tile([0.0, 0.0, 1.0], (len(p), 1))
    order = near_order(p)
    sorted_points = p[order]
    tree = cKDTree(sorted_points, balanced_tree=False)
    out = np.empty_like(p)
    for start in range(0, len(p), 50_000):
        rows = slice(start, start + 50_000)
        near = sorted_points[np.asarray(tree.query(sorted_points[rows], k, workers=-1)[1])]
        near -= near.mean(axis=1, keepdims=True)
        out[order[rows]] = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]
    return out


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), [0.0, 0.0, 1.0]))

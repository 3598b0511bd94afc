"""Ways through a building: free space, path and targets of the camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from benchmarks.simulation.buildings import Building, PlacedRoom
from list3r.simulation.walk import PathSettings, walk_duration
from list3r.simulation.worlds.objects import SimulatedObject, stack_solids
from list3r.simulation.worlds.world import Stop

Array = NDArray[np.float64]

_CELL_M = 0.1
_BODY_M = (0.3, 1.9)
"""Objects between these heights are obstacles."""
_THROUGH_FURNITURE = 60.0
"""Cost of a metre through furniture, against 1 in the open: taken only where nothing else is left."""
_COMFORT_M = 0.3
_STEP_M = 0.45
_AHEAD_M = 1.8


class FreeMap:
    """The floor of a building as a grid of places to walk."""

    def __init__(self, building: Building) -> None:
        rooms = building.rooms()
        low = np.array([min(r.x0 for r in rooms), min(r.y0 for r in rooms)]) - 0.5
        high = np.array([max(r.x1 for r in rooms), max(r.y1 for r in rooms)]) + 0.5
        self._origin = low
        shape = tuple(np.ceil((high - low) / _CELL_M).astype(int)[::-1])
        walls = [t for t in building.world.objects if t.structure == "wall"]
        others = [t for t in building.world.objects if t.structure is None]
        floor = np.zeros(shape, np.uint8)
        for room in rooms:
            self._fill(
                floor, np.array([[room.x0, room.y0], [room.x1, room.y0], [room.x1, room.y1], [room.x0, room.y1]])
            )
        passage = cv2.dilate(floor, np.ones((3, 3), np.uint8)).astype(bool)
        solid = self._occupied(walls, shape) | ~passage
        self.clearance_m = distance_transform_edt(~(solid | self._occupied(others, shape))) * _CELL_M
        """Distance from each cell to the nearest obstacle, metres. Shape (rows along y, columns along x)."""
        cost = 1 + 6 * np.exp(-((self.clearance_m / _COMFORT_M) ** 2)) + (self.clearance_m <= 0) * _THROUGH_FURNITURE
        self._graph, self._passable = _grid_graph(np.where(solid, np.inf, cost)), ~solid
        self._near_wall = cv2.dilate(solid.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)

    def _fill(self, image: NDArray[np.uint8], corners: Array) -> None:
        hull = cv2.convexHull(((corners - self._origin) / _CELL_M - 0.5).astype(np.float32))
        cv2.fillConvexPoly(image, np.rint(hull * 16).astype(np.int32), 1, shift=4)

    def _occupied(self, objects: list[SimulatedObject], shape: tuple[int, ...]) -> NDArray[np.bool_]:
        image = np.zeros(shape, np.uint8)
        for box in stack_solids(objects).corners() if objects else ():
            if box[:, 2].max() > _BODY_M[0] and box[:, 2].min() < _BODY_M[1]:
                self._fill(image, box[::2, :2])
        return image.astype(bool)

    def cells(self, xy: Array) -> NDArray[np.int64]:
        """Rows and columns of places (N, 2), clipped to the grid. Shape (N, 2)."""
        cell = np.floor((xy - self._origin) / _CELL_M).astype(np.int64)[..., ::-1]
        return np.clip(cell, 0, np.array(self.clearance_m.shape) - 1)

    def clearance(self, xy: Array) -> Array:
        """Distance from places (N, 2) to the nearest obstacle, metres. Shape (N,)."""
        cell = self.cells(xy)
        return np.asarray(self.clearance_m[cell[..., 0], cell[..., 1]])

    def crosses_wall(self, a: Array, b: Array) -> NDArray[np.bool_]:
        """Whether the straight way between places up to 3 m apart is barred. Shapes (..., 2), broadcast -> (...)."""
        start, step = (a - self._origin) / _CELL_M, (b - a) / _CELL_M
        rows, columns = self._near_wall.shape
        barred = np.zeros(np.broadcast_shapes(a.shape, b.shape)[:-1], dtype=bool)
        for share in np.linspace(0, 1, 11):
            x = np.clip((start[..., 0] + share * step[..., 0]).astype(np.int32), 0, columns - 1)
            y = np.clip((start[..., 1] + share * step[..., 1]).astype(np.int32), 0, rows - 1)
            barred |= self._near_wall[y, x]
        return barred

    def open_places(self, room: PlacedRoom, least_m: float) -> Array:
        """Middles of a room's cells with that clearance, or the roomiest hundred. Shape (N, 2)."""
        rows, columns = np.indices(self.clearance_m.shape)
        x, y = (columns + 0.5) * _CELL_M + self._origin[0], (rows + 0.5) * _CELL_M + self._origin[1]
        inside = (x > room.x0) & (x < room.x1) & (y > room.y0) & (y < room.y1)
        places, clear = np.stack([x[inside], y[inside]], axis=1), self.clearance_m[inside]
        enough = clear >= least_m
        return places[enough] if enough.sum() >= 20 else places[np.argsort(-clear, kind="stable")[:100]]

    def path(self, start: Array, goal: Array) -> Array:
        """A smooth way from one place to another, points 0.1 m apart. Shape (N, 2)."""
        columns = self.clearance_m.shape[1]
        a, b = (int(r * columns + c) for r, c in self.cells(np.stack([start, goal])))
        _, before = dijkstra(self._graph, return_predecessors=True, indices=[a])
        trail = [b]
        while trail[-1] != a:
            step = int(before[0, trail[-1]])
            assert step >= 0, "rooms of a building are joined"
            trail.append(step)
        row, column = np.divmod(np.array(trail[::-1]), columns)
        way = np.stack([column + 0.5, row + 0.5], axis=1) * _CELL_M + self._origin
        way[0], way[-1] = start, goal
        if len(way) < 3:
            return np.stack([start, goal])
        smooth = gaussian_filter1d(np.concatenate([way[:1]] * 12 + [way] + [way[-1:]] * 12), 3.5, axis=0)
        return np.asarray(smooth[6:-6])


def _grid_graph(cost: Array) -> csr_array:
    """Edges between neighbouring cells of finite cost."""
    rows, columns = cost.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    heads, tails, weights = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: rows - dy, max(-dx, 0) : columns - max(dx, 0)]
        b = np.s_[dy:, max(dx, 0) : columns + min(dx, 0)]
        weight = (cost[a] + cost[b]) / 2 * np.hypot(dx, dy) * _CELL_M
        ok = np.isfinite(weight)
        heads.append(number[a][ok])
        tails.append(number[b][ok])
        weights.append(weight[ok])
    i, j, w = np.concatenate(heads), np.concatenate(tails), np.concatenate(weights)
    both = (np.concatenate([w, w]), (np.concatenate([i, j]), np.concatenate([j, i])))
    return coo_array(both, shape=(cost.size, cost.size)).tocsr()


@dataclass(frozen=True)
class View:
    """A place and the targets of the camera there, world, metres."""

    xy: tuple[float, float]
    targets: tuple[tuple[float, float, float], ...]


@dataclass
class Director:
    """Plans the camera's path and targets, as stops."""

    building: Building
    free: FreeMap
    rng: np.random.Generator
    path: PathSettings
    eye_m: float = 1.5
    stops: list[Stop] = field(default_factory=list)

    def seconds(self) -> float:
        """How long the stops so far take."""
        return walk_duration(tuple(self.stops), self.path) if len(self.stops) > 1 else 0.0

    def at(self) -> Array:
        """Where the camera is. Shape (2,)."""
        return np.array(self.stops[-1].eye[:2])

    def plan_views(self, room: PlacedRoom, count: int, sweep_deg: float = 170.0, apart_m: float = 1.2) -> list[View]:
        """Separate places in a room, with sweeps over its objects."""
        places = self.free.open_places(room, 0.45)
        chosen: list[Array] = []
        views = []
        for _ in range(count):
            drawn = places[self.rng.integers(len(places), size=24)]
            if chosen:
                gap = np.linalg.norm(drawn[:, None] - np.array(chosen)[None], axis=2).min(axis=1)
                drawn = drawn[np.argsort(np.abs(gap - apart_m), kind="stable")]
            chosen.append(drawn[0])
            views.append(self._view(room, drawn[0], sweep_deg))
        return views

    def _view(self, room: PlacedRoom, xy: Array, sweep_deg: float) -> View:
        """A sweep from a place: the one with the longest view of several drawn ones."""
        points = self._targets(room)
        away = np.linalg.norm(points[:, :2] - xy, axis=1)
        points = points[away > min(1.0, float(np.sort(away)[-2]) - 1e-9)]
        offset = points[:, :2] - xy
        bearing, away = np.arctan2(offset[:, 1], offset[:, 0]), np.linalg.norm(offset, axis=1)
        best: list[int] = []
        score = -np.inf
        for start in self.rng.uniform(-np.pi, np.pi, 6):
            turn = (bearing - start) % (2 * np.pi)
            picked = _spread(turn, np.deg2rad(sweep_deg))
            depth = float(np.minimum(away[picked], 2.5).mean() + 0.5 * away[picked].min())
            if depth > score:
                best, score = picked, depth
        if self.rng.uniform() < 0.5:
            best.reverse()
        return View(_pair(xy), tuple(_triple(points[k]) for k in best))

    def _targets(self, room: PlacedRoom) -> Array:
        """Targets in a room: its objects, and its corners. Shape (N, 3)."""
        wanted = set(room.objects)
        objects = [t.box() for t in self.building.world.objects if t.id in wanted and t.structure is None]
        points = [box.center for box in objects if box.center[2] < 1.7 and box.size.max() > 0.3]
        corners = [np.array([x, y, 0.8]) for x in (room.x0, room.x1) for y in (room.y0, room.y1)]
        return np.array([np.array([p[0], p[1], 0.35 + 0.55 * p[2]]) for p in points] + corners)

    def begin(self, xy: tuple[float, float], target: tuple[float, float, float]) -> None:
        """Put the camera somewhere."""
        self.stops.append(Stop((*xy, self.eye_m), target))

    def walk_to(self, xy: tuple[float, float], *, look_round: float = 0.35) -> None:
        """Walk along a free way, facing ahead and now and then sideways by up to 50 degrees."""
        way = self.free.path(self.at(), np.array(xy))
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        count = max(2, round(along[-1] / _STEP_M) + 1)
        aside = 0.0
        for s in np.linspace(0, along[-1], count)[1:]:
            here = _along(way, along, s)
            there = _along(way, along, min(s + _AHEAD_M, along[-1]))
            heading = there - here if np.linalg.norm(there - here) > 0.3 else here - _along(way, along, max(s - 0.6, 0))
            if np.linalg.norm(heading) < 1e-6:
                continue
            if self.rng.uniform() < look_round:
                aside = float(np.deg2rad(self.rng.uniform(-50, 50)))
            else:
                aside *= 0.5
            yaw = float(np.arctan2(heading[1], heading[0])) + aside
            ahead = here + 2.5 * np.array([np.cos(yaw), np.sin(yaw)])
            self.stops.append(Stop((*_pair(here), self.eye_m), (*_pair(ahead), self.eye_m - 0.45)))

    def look(self, view: View) -> None:
        """Turn to a view's targets one after another, with a small step between them."""
        here = np.array(view.xy)
        for target in view.targets:
            step = here + self.rng.uniform(-0.15, 0.15, 2)
            if self.free.clearance(step[None])[0] > 0.25:
                here = step
            self.stops.append(Stop((*_pair(here), self.eye_m), target))

    def film(self, views: list[View], *, look_round: float = 0.35) -> None:
        """Walk from view to view."""
        for view in views:
            if self.stops:
                self.walk_to(view.xy, look_round=look_round)
            self.look(view)


def _spread(turn: Array, sweep: float) -> list[int]:
    """Which of the directions `turn` (N,), radians, are within a sweep and at least 18 degrees apart; two or more."""
    picked: list[int] = []
    order = [int(k) for k in np.argsort(turn, kind="stable")]
    for k in order:
        if turn[k] <= sweep and (not picked or turn[k] - turn[picked[-1]] > np.deg2rad(18)):
            picked.append(k)
    return picked if len(picked) > 1 else order[:2]


def mapped_view(view: View, source: PlacedRoom, target: PlacedRoom) -> View:
    """The same view in the twin of a room."""
    turn = target.turn - source.turn
    c, s = float(np.cos(turn)), float(np.sin(turn))
    (ax, ay), (bx, by) = source.center(), target.center()

    def place(x: float, y: float) -> tuple[float, float]:
        return bx + c * (x - ax) - s * (y - ay), by + s * (x - ax) + c * (y - ay)

    return View(place(*view.xy), tuple((*place(x, y), z) for x, y, z in view.targets))


def _along(way: Array, along: Array, s: float) -> Array:
    return np.array([np.interp(s, along, way[:, 0]), np.interp(s, along, way[:, 1])])


def _pair(xy: Array) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _triple(xyz: Array) -> tuple[float, float, float]:
    return float(xyz[0]), float(xyz[1]), float(xyz[2])

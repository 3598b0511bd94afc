"""The surfaces that one page draws: as much at rest as it draws in half a second, less while its camera moves."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from list3r.exporters.glb import surface_glb
from list3r.queries.views.fused import Surface, fewer
from list3r.viewer.names import PageNames
from list3r.viewer.world import ShownCloud, ShownWorld, close_by, colors, overview, point_size, sheet_colors

FINE = "/fine"
"""Nodes below this one are hidden while the camera of a slow page moves."""
_MOVED_SHARE = 0.1
"""The camera must move by this share of its distance to its target before detail is drawn again."""


@dataclass(frozen=True)
class CloudSettings:
    """How many points are drawn."""

    overview_points: int = 1_500_000
    """Points that are always there, at most."""
    detail_points: int = 1_500_000
    """Further points near the camera, at most."""
    rest_s: float = 0.5
    """All that is drawn while the camera rests takes a page no longer than this."""
    moving_s: float = 0.04
    """The points that are drawn while it moves take no longer than this; the page itself comes on top."""
    probe_points: tuple[int, ...] = (30_000, 300_000)
    """Points whose drawing is timed; a graphics card takes a millisecond or two for the most of them."""
    probe_s: float = 0.05
    """Slower drawing is not timed with more points."""
    never_slow_points: int = 20_000
    """Memories with fewer points, or triangles, are drawn in full without timing."""
    most_faces: int = 1_000_000
    """Triangles that a page is given, at most."""
    pause_s: float = 1.0
    """A slow page's camera rests when it has not moved for this long; its fine pictures take up to `rest_s`."""


@dataclass(frozen=True)
class Drawing:
    """Drawn layers of a world."""

    world: ShownWorld = field(compare=False)
    mode: str
    structure: bool
    points: bool

    def same(self, other: Drawing | None) -> bool:
        """Whether another shows the same of the same world."""
        return other is not None and other.world is self.world and other == self

    def allowed(self) -> NDArray[np.int64]:
        """Return how many points of each instance may be met by a click. Shape (K,)."""
        ids = self.world.cloud.ids.tolist()
        drawn = np.array([self._draws(n) for n in ids], bool)
        return np.where(drawn, self.world.cloud.counts, 0)

    @property
    def faces(self) -> int:
        """How many triangles there are."""
        return sum(len(s.faces) for s in self.world.sheets.values())

    def dots(self) -> NDArray[np.int64]:
        """Return how many points of each instance may be drawn: of those without triangles. Shape (K,)."""
        return np.where([n in self.world.sheets for n in self.world.cloud.ids.tolist()], 0, self.allowed())

    def sheets(self, share: float = 1.0) -> bytes | None:
        """Return the triangles, or about a share of them, as binary glTF; None where there are none to draw."""
        chosen = {n: s for n, s in self.world.sheets.items() if self._draws(n)}
        if not chosen:
            return None
        inked = [Surface(s.vertices, s.faces, sheet_colors(self.world, n, self.mode)) for n, s in chosen.items()]
        parts = [fewer(s, share) if share < 1 else s for s in inked]
        starts = np.cumsum([0, *(len(s.vertices) for s in parts)])
        faces = np.concatenate([s.faces + n for s, n in zip(parts, starts, strict=False)]).astype(np.int32)
        return surface_glb(np.concatenate([s.vertices for s in parts]), faces, np.concatenate([s.rgb for s in parts]))

    def _draws(self, instance_id: int) -> bool:
        return self.points and (self.structure or self.world.solid(instance_id))


class PageClouds:
    """The points of one page, drawn in its own part of the scene, so that each page gets as many as it can draw."""

    def __init__(self, client: viser.ClientHandle, settings: CloudSettings, names: PageNames) -> None:
        self._client, self._settings, self.names = client, settings, names
        self._lock = threading.RLock()
        self._nodes: dict[str, Any] = {}
        self._shown: Drawing | None = None
        self._detail_at: NDArray[np.float64] | None = None
        self._last_move = 0.0
        self._moving = False
        self.seconds_a_point: float | None = None
        """As measured on the page; None where it was not, and then all is drawn."""
        self.seconds_of_sheets = 0.0
        """What drawing all triangles takes, as measured on the page; 0 where it was not."""

    @property
    def at_rest(self) -> bool:
        """Whether the page shows its picture at rest."""
        with self._lock:
            return FINE in self._nodes and not self._moving

    @property
    def most_points(self) -> float:
        """How many points the page can show at rest."""
        return np.inf if self.seconds_a_point is None else self._settings.rest_s / max(self.seconds_a_point, 1e-12)

    def draw(self, shown: Drawing) -> None:
        """Draw a world; the first time, the page's drawing speed is measured."""
        with self._lock:
            before, self._shown = self._shown, shown
            if before is None:
                if shown.dots().sum() > self._settings.never_slow_points:
                    self.seconds_a_point = self._measured(shown.world.cloud)
                if shown.faces > self._settings.never_slow_points:
                    self.seconds_of_sheets = self._measured_sheets()
            at_rest = self._settings.rest_s / max(self.seconds_of_sheets, 1e-12)
            self._sheet("/fine/sheets/all", min(1.0, at_rest, self._settings.most_faces / max(shown.faces, 1)))
            self._clear("/fine/detail")
            self._cloud("/fine/points", self._part(self._overview()), "circle")
            self._detail_at = None
            self._draw_detail()
            self._draw_coarse()
            self._switch(fine=not self._moving)

    def moved(self, _: object) -> None:
        """Draw coarsely until the camera, which has moved, rests; then in detail near it."""
        self._last_move = time.monotonic()
        if not self._moving and self._lock.acquire(blocking=False):
            try:
                self._moving = True
                self._switch(fine=False)
                threading.Thread(target=self._until_rest, daemon=True).start()
            finally:
                self._lock.release()

    # ------------------------------------------------------------------ levels

    @property
    def slow(self) -> bool:
        """Whether all surfaces take the page longer than a moving picture may."""
        if self._shown is None:
            return False
        most = min(int(self._shown.dots().sum()), self._settings.overview_points)
        return most * (self.seconds_a_point or 0.0) + self.seconds_of_sheets > self._settings.moving_s

    def _overview(self) -> NDArray[np.int64]:
        """How many points of each instance are there at rest. Shape (K,)."""
        assert self._shown is not None
        counts = self._shown.dots()
        most = min(self._settings.overview_points, self.most_points)
        return counts if counts.sum() <= most else overview(counts, int(min(most, max(self.most_points / 2, 1))))

    def _part(self, high: NDArray[np.int64]) -> ShownCloud:
        assert self._shown is not None
        return self._shown.world.cloud.part(np.zeros_like(high), high)

    def _draw_coarse(self) -> None:
        self._clear("/coarse/points")
        self._clear("/coarse/sheets")
        if not self.slow or self._shown is None:
            return
        dots = self._shown.dots()
        most = self._settings.moving_s / max(self.seconds_a_point or 0.0, 1e-12)
        self._cloud("/coarse/points", self._part(overview(dots, int(min(most, dots.sum())))), "square")
        self._sheet("/coarse/sheets/all", min(1.0, self._settings.moving_s / max(self.seconds_of_sheets, 1e-12)))

    def _draw_detail(self) -> None:
        """Draw points that the overview leaves out, of the instances near the camera; structure is not among them."""
        if self._shown is None or not self._shown.points:
            return
        camera, low = self._client.camera, self._overview()
        place = np.asarray(camera.position, np.float64)
        reach = float(np.linalg.norm(place - np.asarray(camera.look_at)))
        if self._detail_at is not None and np.linalg.norm(place - self._detail_at) <= _MOVED_SHARE * reach:
            return
        self._detail_at, world = place, self._shown.world
        objects = np.array([world.solid(n) for n in world.cloud.ids.tolist()], bool)
        hidden = np.where(objects, self._shown.dots() - low, 0)
        most = min(self._settings.detail_points, self.most_points - low.sum())
        self._clear("/fine/detail")
        if hidden.any() and most > 0:
            cloud = world.cloud.part(low, low + close_by(world, hidden, place, int(most)))
            self._cloud("/fine/detail", cloud, "circle")

    # ------------------------------------------------------------------ the page

    def _until_rest(self) -> None:
        pause = self._settings.pause_s if self.slow else 0.1
        while time.monotonic() - self._last_move < pause:
            time.sleep(0.05)
        with self._lock:
            self._moving = False
            self._draw_detail()
            self._switch(fine=True)
        self.names.arrange()

    def _switch(self, *, fine: bool) -> None:
        """Show one of the two levels; a page that is not slow has the fine one only."""
        with self._client.atomic():
            if FINE not in self._nodes:
                self._nodes[FINE] = self._client.scene.add_frame(FINE, show_axes=False)
                self._nodes["/coarse"] = self._client.scene.add_frame("/coarse", show_axes=False)
            self._nodes[FINE].visible = fine or not self.slow
            self._nodes["/coarse"].visible = not fine and self.slow

    def _measured(self, cloud: ShownCloud) -> float | None:
        """Seconds that the page takes to draw a point: that of a picture with many, less that of one without. Few are
        timed first, so that a slow page is not asked for more.
        """
        without = self._fastest()
        seconds = None
        for most in self._settings.probe_points:
            part = self._part(overview(cloud.counts, most))
            probe = replace(part, spacing=cloud.spacing)  # larger ones take longer: as when all are drawn
            self._cloud("/fine/points", probe, "circle")
            taken = self._fastest()
            if without is None or taken is None:
                return None
            seconds = max(taken - without, 0.0) / max(len(probe.points), 1)
            if taken - without > self._settings.probe_s:
                break
        return seconds

    def _measured_sheets(self) -> float:
        """Seconds that the page takes to draw all triangles; 0 where it does not tell."""
        without = self._fastest()
        self._sheet("/fine/sheets/all", 1.0)
        taken = self._fastest()
        return 0.0 if without is None or taken is None else max(taken - without, 0.0)

    def _sheet(self, name: str, share: float) -> None:
        """Draw about a share of the triangles."""
        self._clear(name.rsplit("/", 1)[0])
        content = None if self._shown is None else self._shown.sheets(share)
        if content is not None:
            self._nodes[name] = self._client.scene.add_glb(name, content, cast_shadow=False, receive_shadow=False)

    def _fastest(self) -> float | None:
        """The shortest time of a few small pictures, in seconds; None where the page gives none."""
        times = []
        for _ in range(3):
            began = time.perf_counter()
            try:
                self._client.get_render(200, 320, timeout=60.0)
            except (TimeoutError, RuntimeError):
                return None
            times.append(time.perf_counter() - began)
        return min(times[1:])

    def _cloud(self, name: str, cloud: ShownCloud, shape: Any) -> None:
        """Draw points as large as they are apart, so that they close surfaces: a node for each step of size."""
        self._clear(name)
        if self._shown is None or not len(cloud.points):
            return
        ink, middle = colors(self._shown.world, cloud, self._shown.mode, None), cloud.points.mean(axis=0)
        size = point_size(cloud.spacing, self._shown.world.unit)
        of_point = np.repeat(size, cloud.counts)
        for k, s in enumerate(np.unique(size[cloud.counts > 0]).tolist()):
            mine = of_point == s
            self._nodes[f"{name}/{k}"] = self._client.scene.add_point_cloud(
                f"{name}/{k}", cloud.points[mine] - middle, colors=ink[mine], point_size=s, point_shape=shape,
                point_shading="flat", position=middle.astype(np.float64),
            )  # fmt: skip

    def _clear(self, name: str) -> None:
        for part in [n for n in self._nodes if n.startswith(f"{name}/")]:
            self._nodes.pop(part).remove()

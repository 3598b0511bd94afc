"""The viewer of a memory in a browser."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from list3r.api import SceneMemory
from list3r.api import open as open_scene
from list3r.memory.core.errors import List3rError
from list3r.viewer.clouds import CloudSettings, Drawing, PageClouds
from list3r.viewer.instance_text import described
from list3r.viewer.layers import Layers, LayerSettings
from list3r.viewer.link import ViewState
from list3r.viewer.names import NameSettings, PageNames
from list3r.viewer.panel import NOTHING_SELECTED, Panel
from list3r.viewer.serving import HOST, quiet, start_server
from list3r.viewer.world import ShownCloud, ShownWorld, overview, pick, read_path, read_world

_PICTURE_PX = 200
"""Small crops are enlarged to about this width."""
_PICKED_POINTS = 1_500_000
"""A click meets these, whatever the page draws."""


@dataclass(frozen=True)
class ViewerSettings:
    """How a memory is shown."""

    port: int = 8741
    """The next free one where it is taken."""
    layers: LayerSettings = field(default_factory=LayerSettings)
    clouds: CloudSettings = field(default_factory=CloudSettings)
    names: NameSettings = field(default_factory=NameSettings)


class Viewer:
    """One memory in the browsers of this machine; all pages show the same."""

    def __init__(self, memory: SceneMemory, settings: ViewerSettings | None = None) -> None:
        self.memory, self.settings = memory, settings or ViewerSettings()
        self._lock = threading.RLock()
        self._asked: deque[ViewState] = deque(maxlen=1)
        """Of the link that was opened last, until its page connects: all pages show the same."""
        self._dropped = False
        """Whether another link was opened before that one's page connected."""
        self._measuring: list[tuple[int, NDArray[np.float64]]] | None = None
        self._pages: dict[int, PageClouds] = {}
        self._drawn: Drawing | None = None
        self._listed: ShownWorld | None = None
        self.state = ViewState()
        self.path = read_path(memory)
        self.world = self._read(None)
        self.picked: ShownCloud = self.world.cloud
        """The points that a click can meet."""
        self.server = start_server(self.settings.port, f"list3r {memory.path.name}", self._page_opened)
        self._layers = Layers(self.server, self.settings.layers)
        self.server.scene.set_up_direction("+z")
        self._usual_view()
        self.panel = Panel(self.server, self)
        self.server.scene.on_click()(self._clicked)
        self.server.on_client_connect(self._connected)
        self.draw()

    @property
    def address(self) -> str:
        """Where the viewer is."""
        return f"http://{HOST}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        with quiet():
            self.server.stop()

    # ------------------------------------------------------------------ what is shown

    def _read(self, session: int | None) -> ShownWorld:
        sessions = [s.session_id for s in self.memory.sessions()]
        if session is None or session in sessions[-1:]:
            return read_world(self.memory, self.memory.changes())
        with open_scene(self.memory.path, at=session) as before:
            changes = [c for c in self.memory.changes() if c.event.session_id == session]
            return read_world(before, changes)

    def show(self, **changed: Any) -> None:
        """Change what is shown: fields of `ViewState`. Raises `List3rError`, and nothing changes, where a past state of
        the memory cannot be read.
        """
        with self._lock:
            before, wanted = self.state, replace(self.state, **changed)
            world = self.world if wanted.session == before.session else self._read(wanted.session)
            self.world = world
            self.state = wanted if wanted.selected in world.instances else replace(wanted, selected=None)
            if before != self.state:
                self.draw()
                self.panel.follow(self.state)

    def reload(self) -> None:
        """Read the memory again, after an edit."""
        with self._lock:
            self.world = self._read(self.state.session)
            if self.state.selected not in self.world.instances:
                self.state = replace(self.state, selected=None)
            self.draw()

    def draw(self) -> None:
        """Draw everything and describe the selection."""
        with self._lock, self.server.atomic():
            s, world, unit = self.state, self.world, self.world.unit
            self._layers.highlight(world, s.colors, s.selected, visible=s.points)
            self._layers.path(self.path, s.session, visible=s.path, unit=unit)
            self._layers.changes(world, visible=s.colors == "changes")
            self._layers.clear("relations")
            if s.selected is not None:
                self._describe(s.selected)
            else:
                self.panel.describe(NOTHING_SELECTED, None)
            self.panel.mark(s.selected)
            if self._listed is not world:
                self._listed = world
                self.panel.list()
        self._draw_points()
        for page in self._open_pages():
            page.names.draw(self.world, self.state.selected, visible=self.state.labels)
        self.server.gui.configure_theme(dark_mode=self.state.dark, show_share_button=False, show_logo=False)

    def _draw_points(self) -> None:
        s = self.state
        shown = Drawing(self.world, s.colors, s.structure, s.points)
        if not shown.same(self._drawn):
            self._drawn = shown
            counts = shown.allowed()
            self.picked = self.world.cloud.part(np.zeros_like(counts), overview(counts, _PICKED_POINTS))
            for page in self._open_pages():
                page.draw(shown)

    def _open_pages(self) -> list[PageClouds]:
        there = self.server.get_clients()
        self._pages = {n: page for n, page in self._pages.items() if n in there}
        return list(self._pages.values())

    def _describe(self, instance_id: int) -> None:
        relations = list(self.memory.relations(subject=instance_id))
        self._layers.relations(self.world, instance_id, relations)
        try:
            picture = _enlarged(self.memory.picture(instance_id).crop())
        except List3rError:
            picture = None
        self.panel.describe(described(self.memory, self.world, instance_id, relations), picture)

    # ------------------------------------------------------------------ what a user does

    def find(self, text: str) -> list[int]:
        """Search, select the best answer and look at it; nothing where there is none. Returns the ids. The panel says
        what was not understood.
        """
        try:
            found = self.memory.find(text, 10)
        except List3rError as error:
            ids, said = [], str(error)
        else:
            ids = [m.instance.id for m in found if m.instance.id in self.world.instances]
            said = "; ".join([*(str(x) for x in (found.counted, found.answer) if x is not None), *found.notes])
        self.panel.found(text, ids, said)
        self.select(ids[0] if ids else None, turn=True)
        return ids

    def select(self, instance_id: int | None, *, turn: bool = False) -> None:
        """Select an instance; with `turn` all pages look at it from where it was seen best."""
        self.show(selected=instance_id)
        if turn and instance_id in self.world.instances and instance_id is not None:
            i = self.world.instances[instance_id]
            seen = self.path.of(i.best_view)
            reach = max(2.5 * float(np.linalg.norm(i.box.size)), 0.5 * self.world.unit)
            for client in self.server.get_clients().values():
                away = (client.camera.position if seen is None else seen) - i.center
                far = max(float(np.linalg.norm(away)), 1e-9)
                client.camera.position = i.center + away * min(reach / far, 1.0)  # moves the target along
                client.camera.look_at = i.center

    def measure(self) -> None:
        """Measure between the next two clicks."""
        with self._lock:
            self._measuring = []
            self._layers.measured([], "")
            self.panel.say("Click two places.")

    def at_time(self, k: int) -> None:
        """Show the camera of the k-th posed frame, with its picture where the memory keeps one."""
        with self._lock:
            near = [p for p in self.panel.pictures if p.session_id == self.path.session[k]]
            picture = min(near, key=lambda p: abs(p.frame_index - self.path.frame[k]), default=None)
            rgb = None if picture is None else self.memory.pixels(picture)[::2, ::2]
            camera = self.memory.camera(frame=int(self.path.frame[k]), session=int(self.path.session[k]))
            height, width = camera.image_size
            self._layers.camera(self.path, k, rgb, (camera.intrinsics[1], width, height), self.world.unit)

    def edit(self, change: Callable[[], Any]) -> None:
        """Run one edit and show its result, or why it was refused."""
        try:
            report = change()
        except List3rError as error:
            self.panel.say(f"Refused: {error}")
            return
        self.reload()
        self.panel.say(report.text)
        if report.ids and report.ids[0] in self.world.instances:
            self.select(report.ids[0])

    def link(self, client: viser.ClientHandle | None) -> str:
        """Return the address that restores the view of a page."""
        parts = [f"view={self.state.encode()}"]
        if client is not None:
            for name, place in (("Position", client.camera.position), ("LookAt", client.camera.look_at)):
                parts.append(f"initialCamera{name}={','.join(f'{v:.3f}' for v in place)}")
        return f"{self.address}/?{'&'.join(parts)}"

    # ------------------------------------------------------------------ events

    def _page_opened(self, code: str) -> None:
        view = ViewState.decode(code)
        self._dropped |= bool(self._asked) and self._asked[-1] != view
        self._asked.append(view)

    def _connected(self, client: viser.ClientHandle) -> None:
        with contextlib.suppress(IndexError):
            self._follow(self._asked.pop())
        names = PageNames(client, self.settings.names)
        page = self._pages[client.client_id] = PageClouds(client, self.settings.clouds, names)
        client.camera.on_update(page.moved)
        if self._drawn is not None:
            page.draw(self._drawn)
        names.draw(self.world, self.state.selected, visible=self.state.labels)

    def _follow(self, view: ViewState) -> None:
        """Show the view of a link, as far as this memory has it, and name what is missing."""
        left_out = []
        if self._dropped:
            self._dropped = False
            left_out.append("Several links were opened at once; the last one is shown.")
        if view.session is not None and view.session not in [s.session_id for s in self.memory.sessions()]:
            left_out.append(f"This memory has no session {view.session}, which the link names.")
            view = replace(view, session=None)
        try:
            self.show(**vars(view))
        except List3rError as error:
            left_out.append(f"The link cannot be followed: {error}.")
        else:
            if view.selected != self.state.selected:
                left_out.append(f"There is no instance {view.selected}, which the link names.")
        self.panel.say(" ".join(left_out))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.asarray(event.ray_origin, np.float64), np.asarray(event.ray_direction, np.float64)
        with self._lock:
            met = pick(self.world, self.picked, origin, direction / np.linalg.norm(direction))
        if self._measuring is None:
            self.select(None if met is None else met[0])
        elif met is not None:
            self._measuring.append(met)
            self._measured(self._measuring)

    def _measured(self, picked: list[tuple[int, NDArray[np.float64]]]) -> None:
        if len(picked) < 2:
            self._layers.measured([picked[0][1]], "from here")
            return
        (a, start), (b, end) = picked
        units, away = self.memory.units, float(np.linalg.norm(end - start))
        text = f"{away:.3f} {units}"
        self._layers.measured([start, end], text)
        self._measuring = None
        if a != b:
            try:
                gap = self.memory.measure(a, b).gap
                text += f" between the places, {gap:.3f} {units} between the surfaces of {a} and {b}"
            except List3rError as error:
                text += f"; {error}"
        self.panel.say(text)

    def _usual_view(self) -> None:
        corners = np.array([i.aabb for i in self.world.instances.values()]).reshape(-1, 3)
        low, high = (corners.min(axis=0), corners.max(axis=0)) if len(corners) else (-np.ones(3), np.ones(3))
        middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
        self.server.initial_camera.look_at = middle
        self.server.initial_camera.position = middle + reach * np.array([-0.2, -0.4, 0.5])
        self.server.initial_camera.up = (0.0, 0.0, 1.0)


def _enlarged(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture at least as wide as the panel, for small crops."""
    from PIL import Image

    zoom = max(1, round(_PICTURE_PX / rgb.shape[1]))
    image = Image.fromarray(np.ascontiguousarray(rgb))
    return np.asarray(image.resize((image.width * zoom, image.height * zoom), Image.Resampling.BICUBIC))


def serve(*viewers: Viewer) -> None:
    """Keep viewers running until they are interrupted."""
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
    finally:
        for viewer in viewers:
            viewer.stop()

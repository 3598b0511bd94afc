"""The panel next to the scene: search, selection, layers, sessions and time, measuring, edits, keys."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from list3r.exporters.pages import thumbnail
from list3r.memory.core.errors import List3rError
from list3r.viewer.instance_text import plain
from list3r.viewer.link import ViewState
from list3r.viewer.listing import CROP_PX, MOST, filtered, legend, listed, marked
from list3r.viewer.world import COLOR_MODES

if TYPE_CHECKING:
    from list3r.viewer.app import Viewer

NOTHING_SELECTED = "Click a thing in the list or in the scene, or type what you look for and press Enter."
_LAYERS = ("points", "labels", "structure", "path")
_KEYS: dict[str, Literal["P", "L", "S", "C", "D", "M", "X", "U"]] = {
    "points": "P", "labels": "L", "structure": "S", "path": "C", "dark": "D", "measure": "M",
    "deselect": "X", "undo": "U",
}  # fmt: skip
_AUTHOR = "viewer"
_CLICKED = re.compile(r"#([0-9]{1,18})")
"""What a click on a row of the list puts into the field."""
_BLANK = np.full((8, 8, 3), 245, np.uint8)


class Panel:
    """Controls of one viewer."""

    def __init__(self, server: viser.ViserServer, viewer: Viewer) -> None:
        self._gui, self._viewer = server.gui, viewer
        self._following = False
        self._answers: tuple[str, list[int]] | None = None
        """What was asked last, and the ids, until something else is typed."""
        self._typed = ""
        self._crops: dict[int, str | None] = {}
        self.pictures = viewer.memory.pictures()
        self._gui.set_panel_label(viewer.memory.path.name)
        self._search()
        self._picture = self._gui.add_image(_BLANK, visible=False)
        self._text = self._gui.add_markdown("")
        self._layers()
        self._times()
        if viewer.memory.writable:
            self._edits()
        self._view()

    # ------------------------------------------------------------------ messages

    def describe(self, text: str, picture: NDArray[np.uint8] | None) -> None:
        """Describe the selection."""
        self._text.content = text
        self._picture.visible = picture is not None
        if picture is not None:
            self._picture.image = picture

    def say(self, text: str) -> None:
        """Report an action, or why it failed."""
        self._message.content, self._message.visible = text, bool(text)

    def found(self, asked: str, ids: list[int], notes: str) -> None:
        """List the answers of a search, in place of the last ones, or say that there are none."""
        self._answers = (asked, ids)
        self.say(notes if ids else f"Nothing found for \u201c{plain(asked)}\u201d: {notes}".removesuffix(": "))
        self.list()

    def list(self) -> None:
        """List the answers, or else what the field's words leave of all things."""
        world = self._viewer.world
        if self._answers is None:
            ids, heading = filtered(world, self._typed), f"of {len(world.instances)}; type to narrow down"
        else:
            ids, heading = self._answers[1], f"found for \u201c{self._answers[0]}\u201d; empty the field for all"
        ids = [n for n in ids if n in world.instances]
        more = f"; the first {MOST} are shown" if len(ids) > MOST else ""
        for n in ids[:MOST]:
            if n not in self._crops:
                self._crops[n] = thumbnail(self._viewer.memory, n, CROP_PX) if world.solid(n) else None
        self._things.content = listed(world, ids[:MOST], self._crops, f"{len(ids)} {heading}{more}")

    def mark(self, selected: int | None) -> None:
        """Mark the row of the selection, and explain the colours."""
        self._mark.content = marked(selected)
        self._legend.visible = self._viewer.state.colors == "changes"
        self._legend.content = legend(self._viewer.world) if self._legend.visible else ""

    def follow(self, state: ViewState) -> None:
        """Set the controls to the view."""
        self._following = True
        try:
            for name, box in self._boxes.items():
                box.value = getattr(state, name)
            self._colors.value = state.colors
            if self._session is not None and state.session is not None:
                self._session.value = state.session
        finally:
            self._following = False

    # ------------------------------------------------------------------ controls

    def _search(self) -> None:
        with self._gui.add_form(None) as form:
            text: Any = self._gui.add_text("Find", "", hint="white mug on table; how many chairs?; 12")
            button = self._gui.add_button("Search")
            self._message = self._gui.add_markdown("", visible=False)
            self._things = self._gui.add_html("")
            self._mark = self._gui.add_html("")

        def narrow(_: object) -> None:
            if not _CLICKED.fullmatch(text.value) and text.value != self._typed:
                self._typed, self._answers = text.value, None
                self.say("")
                self.list()

        def search(_: object) -> None:
            clicked = _CLICKED.fullmatch(text.value)
            if clicked:
                text.value = self._typed
                self._viewer.select(int(clicked[1]), turn=True)
            elif text.value.strip():
                self._viewer.find(text.value.strip())

        text.on_update(narrow)
        form.on_submit(search)
        button.on_click(search)

    def _layers(self) -> None:
        self._boxes: dict[str, Any] = {}
        usual = self._viewer.state
        with self._gui.add_folder("Show"):
            self._colors: Any = self._gui.add_dropdown("Colours", COLOR_MODES, initial_value=usual.colors)
            self._legend = self._gui.add_html("", visible=False)
            for name in (*_LAYERS, "dark"):
                self._boxes[name] = self._gui.add_checkbox(name.capitalize(), getattr(usual, name))

        self._colors.on_update(lambda _: self._show(colors=self._colors.value))

        for name, box in self._boxes.items():
            self._toggle(name, box)

    def _toggle(self, name: str, box: Any) -> None:
        box.on_update(lambda _: self._show(**{name: bool(box.value)}))
        command = self._gui.add_command(f"Show or hide: {name}", hotkey=_KEYS[name])

        @command.on_trigger
        def _(_: object) -> None:
            self._viewer.show(**{name: not getattr(self._viewer.state, name)})

    def _show(self, **changed: Any) -> None:
        if not self._following:
            try:
                self._viewer.show(**changed)
            except List3rError as error:
                self.say(str(error))

    def _times(self) -> None:
        sessions = [s.session_id for s in self._viewer.memory.sessions()]
        self._session: Any = None
        with self._gui.add_folder("Time"):
            if len(sessions) > 1:
                self._session = self._gui.add_slider("After session", sessions[0], sessions[-1], 1, sessions[-1])
                self._session.on_update(lambda _: self._show(session=int(self._session.value)))

            count = len(self._viewer.path.frame)
            if count > 1:
                time = self._gui.add_slider("Frame", 0, count - 1, 1, 0)

                @time.on_update
                def _(_: object) -> None:
                    self._viewer.at_time(int(time.value))

    def _edits(self) -> None:
        memory, viewer = self._viewer.memory, self._viewer
        with self._gui.add_folder("Edit"):
            text = self._gui.add_text("Name", "")
            name = self._gui.add_button("Name it")
            other = self._gui.add_number("Other id", 0, min=0, step=1)
            merge = self._gui.add_button("Merge with the other")
            split = self._gui.add_button("Split")
            delete = self._gui.add_button("Delete", color="red")
            undo = self._gui.add_button("Undo the last edit")

        @name.on_click
        def _(_: object) -> None:
            self._edit(lambda n: memory.label(n, text.value or None, author=_AUTHOR))

        @merge.on_click
        def _(_: object) -> None:
            self._edit(lambda n: memory.merge(n, int(other.value), author=_AUTHOR))

        @split.on_click
        def _(_: object) -> None:
            self._edit(lambda n: memory.split(n, author=_AUTHOR))

        @delete.on_click
        def _(_: object) -> None:
            self._edit(lambda n: memory.delete(n, author=_AUTHOR))

        def take_back(_: object) -> None:
            viewer.edit(lambda: memory.undo(author=_AUTHOR))

        undo.on_click(take_back)
        self._gui.add_command("Undo the last edit", hotkey=_KEYS["undo"]).on_trigger(take_back)

    def _edit(self, change: Any) -> None:
        selected = self._viewer.state.selected
        if selected is None:
            self.say("Select an instance first.")
        else:
            self._viewer.edit(lambda: change(selected))

    def _view(self) -> None:
        with self._gui.add_folder("View"):
            measure = self._gui.add_button("Measure between two clicks")
            link = self._gui.add_button("Link to this view")
            address: Any = self._gui.add_text("Link", "", visible=False)
        measure.on_click(lambda _: self._viewer.measure())
        self._gui.add_command("Measure between two clicks", hotkey=_KEYS["measure"]).on_trigger(
            lambda _: self._viewer.measure()
        )
        self._gui.add_command("Select nothing", hotkey=_KEYS["deselect"]).on_trigger(
            lambda _: self._viewer.select(None)
        )

        @link.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            address.value, address.visible = self._viewer.link(event.client), True

"""What a room is furnished with and where it is put."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from training.worlds.catalogue import KINDS, Kind, kinds_at
from training.worlds.draft import Draft
from training.worlds.fitted import (
    built_in_wardrobe,
    folding_door,
    large_window,
    plain_door,
    shelf_wall,
    sliding_door,
)
from training.worlds.materials import Material, Palette
from training.worlds.mesh import box
from training.worlds.placing import Placer
from training.worlds.room import Placed, Room, flat_pose, room_shell
from training.worlds.settle import fill_zone
from training.worlds.structural import (
    FIRST_WALL,
    Niche,
    Opening,
    build_structure,
    free_opening,
    open_walls,
    wall_behind,
)


@dataclass(frozen=True)
class World:
    """A furnished room."""

    size: tuple[float, float, float]
    things: tuple[Placed, ...]
    room: Room


def make_world(
    seed: int, *, held_out: bool = False, fitted: bool = False, odd: float = 0.0, recessed: bool = False
) -> World:
    """Return the furnished room of a seed; with `held_out` families and textures appear that training never shows.

    `fitted` rooms have structure that looks like things, and things that are built in. `odd` is the share of oddments;
    rooms with them may be larger, and things stand on their tops in rows, too. In `recessed` rooms windows, doors and
    niches lie behind the face of the walls.
    """
    rng = np.random.default_rng([seed, 1 if held_out else 0])
    most = 7.5 if odd else 6.5 if fitted else 5.5
    size = (float(rng.uniform(2.8, most)), float(rng.uniform(2.8, most)), float(rng.uniform(2.35, 2.9)))
    palette = Palette(rng, held_out=held_out)
    room = Room(size, rng)
    painter = _Furnisher(room, palette, held_out, odd)
    painter.shell()
    if recessed:
        painter.recesses()
    if fitted:
        painter.built_in()
    painter.openings()
    painter.groups()
    painter.along_walls()
    painter.loose_furniture()
    painter.hangings()
    painter.floor_things()
    painter.clutter()
    return World(size, tuple(room.things), room)


_CLOSED_BY = ("large window", "large window", "large window", "wide", "door", "shelf", "bare")
"""What openings of walls are closed by; "wide" is a window as wide as the wall, "bare" a niche."""
_LEAVES = {"sliding door": sliding_door, "folding door": folding_door, "door": plain_door}


class _Furnisher(Placer):
    """Fills one room, step by step."""

    def shell(self) -> None:
        """Put up floor, ceiling, walls, and at times a pillar or a step in a wall."""
        wall, floor = self.palette.wall(), self.palette.floor()
        ceiling = self.palette.paint() if self.rng.random() < 0.2 else self.palette.wall()
        for name, mesh, material in room_shell(self.room.size, wall, floor, ceiling):
            things = self.room.things
            things.append(Placed(len(things) + 1, name, name, "structure", ((mesh, material),), np.eye(4), True))
        if self.rng.random() < 0.25:
            w, deep, h = self.room.size
            sx, sy = self.rng.uniform(0.3, 1.2, 2)
            x, y = (
                (sx / 2 if self.rng.random() < 0.5 else w - sx / 2),
                (sy / 2 if self.rng.random() < 0.5 else deep - sy / 2),
            )
            draft = Draft(self.rng, self.palette)
            draft.add(box((sx - 0.01, sy - 0.01, h - 0.01)), wall)
            self.room.place("pillar", "wall", "structure", draft, flat_pose(x, y, 0.0))
            last = self.room.things.pop()
            self.room.things.append(Placed(last.id, "wall", "wall", "structure", last.parts, last.T_world_thing, True))
            for number in range(4):
                along, across = (x, sx) if number % 2 == 0 else (y, sy)
                self.room.wall_free(number, (along - across / 2, along + across / 2), (0, h), take=True)

    def recesses(self) -> None:
        """Cut openings into the walls, and close them with windows, doors, shelves, wardrobes or bare wall."""
        wall, cut = self.room.things[FIRST_WALL].parts[0][1], []
        for _ in range(int(self.rng.integers(2, 6))):
            name = str(self.rng.choice(_CLOSED_BY))
            opening = free_opening(self.room, name)
            if opening is not None:
                cut.append(opening)
                self._close(name, opening, wall)
        open_walls(self.room, cut)

    def _close(self, name: str, o: Opening, wall: Material) -> None:
        """Put what closes an opening behind the face of its wall."""
        w, h = o.width, o.top - o.low
        draft, kind = Draft(self.rng, self.palette), None
        if name == "shelf":
            kind = "built-in wardrobe" if o.low == 0.0 and self.rng.random() < 0.5 else "shelf wall"
            {"built-in wardrobe": built_in_wardrobe, "shelf wall": shelf_wall}[kind](draft, w, h, o.depth)
        elif name != "bare":
            kind = str(self.rng.choice(list(_LEAVES))) if name == "door" else "large window"
            {**_LEAVES, "large window": large_window}[kind](draft, w, h)
        if name in ("bare", "shelf"):
            wall_behind(self.room, o, wall)
        if kind is not None:
            away = -o.depth / 2 if name == "shelf" else -o.depth
            self._place(KINDS[kind], draft, self.room.wall_pose(o.wall, o.along, away, o.low), mark=False)
        if name in ("large window", "wide") and self.rng.random() < 0.4:
            self._hang(KINDS["radiator"], 0.0, o.wall, o.along)
        for side in (-1, 1) if name == "large window" else ():
            if self.rng.random() < 0.3:
                self._hang(KINDS["curtain"], 0.03, o.wall, o.along + side * (w / 2 + 0.3))

    def built_in(self) -> None:
        """Build structure into the room, and what is made for its niches and walls."""
        wall = next(t.parts[0][1] for t in self.room.things if t.label == "wall")
        for niche in build_structure(self.room, self.palette, wall):
            if self.rng.random() < 0.7:
                self._fill_niche(niche)
        for _ in range(int(self.rng.integers(2, 6))):
            place = str(self.rng.choice(["glazing", "glazing", "panel", "fitted", "fitted"]))
            kind = self._draw(place)
            if place == "fitted":
                self._against(kind, 4)
            else:
                floor = kind.name in ("folding door", "sliding door", "long curtain")
                low = 0.01 if floor else self.rng.uniform(0.1, 1.1 if place == "panel" else 0.9)
                self._hang(kind, low)
        if self.rng.random() < 0.25:
            self._free(self._draw("fitted free"))

    def _fill_niche(self, niche: Niche) -> None:
        """Put something into a niche that is as wide as the niche."""
        w, h, back = niche.width - 0.02, niche.height - 0.02, 0.004
        draft, pick = Draft(self.rng, self.palette), int(self.rng.integers(4))
        if pick == 0:
            depth = niche.depth - self.rng.uniform(0.0, 0.03)
            name, back = "built-in wardrobe", depth / 2 + 0.002
            built_in_wardrobe(draft, w, h, depth - 0.03)
        elif pick == 1 and niche.depth > 0.2:
            name, back = "shelf wall", niche.depth / 2
            shelf_wall(draft, w, h, niche.depth - 0.02)
        else:
            name = str(self.rng.choice(["large window", "sliding door", "folding door"]))
            {"large window": large_window, "sliding door": sliding_door, "folding door": folding_door}[name](
                draft, w - 0.16, h - 0.12
            )
            back = 0.004 if niche.depth < 0.2 or self.rng.random() < 0.5 else niche.depth - 0.15
        pose = self.room.wall_pose(niche.wall, niche.along, back, 0.01)
        if self.room.fits(draft, pose):
            half = niche.width / 2
            self.room.wall_free(niche.wall, (niche.along - half, niche.along + half), (0.0, niche.height), take=True)
            self._place(KINDS[name], draft, pose)

    def openings(self) -> None:
        """Make doors and windows, with radiators below and curtains beside them."""
        self._hang(KINDS["door"], 0.0)
        for _ in range(int(self.rng.integers(0, 3))):
            found = self._hang(KINDS["window"], self.rng.uniform(0.8, 1.0))
            if found is None:
                continue
            wall, x, window = found
            if self.rng.random() < 0.6:
                self._hang(KINDS["radiator"], 0.0, wall, x)
            half = window.bounds()[1][0]
            for side in (-1, 1):
                if self.rng.random() < 0.6:
                    self._hang(KINDS["curtain"], 0.03, wall, x + side * (half + 0.3))

    def _allowed(self, name: str) -> bool:
        kind = KINDS[name]
        return kind in kinds_at(kind.place, held_out=self.held_out)

    def groups(self) -> None:
        """Put up table and chairs, desk and chair, sofa and low table, bed and nightstands."""
        names = self.rng.permutation(["sofa", "desk", "bed", "table"])[: int(self.rng.integers(1, 4))]
        for name in names:
            {"sofa": self._sofa_group, "desk": self._desk_group, "bed": self._bed_group, "table": self._table_group}[
                str(name)
            ]()

    def _sofa_group(self) -> None:
        found = self._against(KINDS["sofa"])
        if found is None:
            return
        pose, depth = found[3], found[2].bounds()[1][1]
        if self.rng.random() < 0.6:
            self._lay_rug(pose @ flat_pose(0.0, depth + 0.4, 0.0))
        if self.rng.random() < 0.75:
            kind = KINDS["coffee table"]
            draft = self._draft(kind)
            spot = pose @ flat_pose(
                self.rng.uniform(-0.2, 0.2),
                depth + draft.bounds()[1][1] + self.rng.uniform(0.03, 0.4),
                self.rng.normal(0, 0.1),
            )
            if self.room.fits(draft, spot):
                self._place(kind, draft, spot)

    def _desk_group(self) -> None:
        found = self._against(KINDS["desk"])
        if found is None:
            return
        _, _, table, pose = found
        top = table.zones[-1]
        self.zones.pop()
        pieces = [
            ("monitor", (self.rng.uniform(-0.25, 0.25), top.low[1] + 0.14)),
            ("keyboard", (self.rng.uniform(-0.15, 0.15), top.high[1] - 0.16)),
        ]
        if self.rng.random() < 0.3:
            pieces = [("laptop", (self.rng.uniform(-0.2, 0.2), 0.0))]
        used: list[tuple[Kind, Draft, NDArray[np.float64]]] = []
        for name, (x, y) in pieces:
            if self._allowed(name) or name in ("monitor", "keyboard"):
                used.append(
                    (
                        KINDS[name],
                        self._draft(KINDS[name]),
                        pose @ flat_pose(x, y, self.rng.normal(0, 0.06), top.z + 0.001),
                    )
                )
        for kind, draft, at in used:
            self._place(kind, draft, at, mark=False)
        half = top.high[0] * 0.42
        for low, high in ((top.low[0], -half), (half, top.high[0])):
            if high - low > 0.12:
                side = Draft(self.rng, self.palette)
                side.zones.append(type(top)((low, top.low[1]), (high, top.high[1]), top.z, top.clearance, "desk"))
                self.zones.append((side, pose, KINDS["desk"]))
        name = "office chair" if self.rng.random() < 0.6 else "padded chair"
        self._chair_at(
            name,
            pose
            @ flat_pose(
                self.rng.uniform(-0.2, 0.2),
                table.bounds()[1][1] + self.rng.uniform(-0.05, 0.4),
                np.pi + self.rng.normal(0, 0.5),
            ),
        )

    def _bed_group(self) -> None:
        found = self._against(KINDS["bed"], 12)
        if found is None or self.rng.random() < 0.3:
            return
        wall, x, draft, _ = found
        for side in (-1, 1):
            self._against(KINDS["nightstand"], 3, wall, x + side * (draft.bounds()[1][0] + 0.32))

    def _table_group(self) -> None:
        kind = KINDS["dining table"] if self.rng.random() < 0.7 else KINDS["round table"]
        for _ in range(8):
            draft = self._draft(kind)
            w, deep, _ = self.room.size
            pose = flat_pose(
                self.rng.uniform(0.8, w - 0.8),
                self.rng.uniform(0.8, deep - 0.8),
                self.rng.choice([0, np.pi / 2]) + self.rng.normal(0, 0.1),
            )
            if self.room.fits(draft, pose):
                break
        else:
            return
        self._place(kind, draft, pose)
        name = str(self.rng.choice(["slatted chair", "padded chair", "shell chair"]))
        state = self.rng.bit_generator.state
        half_x, half_y = draft.bounds()[1][:2]
        spots = [
            (x, side * half_y, np.pi if side > 0 else 0.0)
            for side in (-1, 1)
            for x in ((-half_x / 2, half_x / 2) if half_x > 0.6 else (0.0,))
        ]
        spots += [(side * half_x, 0.0, np.pi / 2 if side > 0 else -np.pi / 2) for side in (-1, 1)]
        for x, y, yaw in spots:
            if self.rng.random() < 0.65:
                out = self.rng.uniform(-0.22, 0.3)
                away = np.array([x, y]) + out * np.array([np.sin(yaw), -np.cos(yaw)]) * 1.0
                self._chair_at(name, pose @ flat_pose(away[0], away[1], yaw + self.rng.normal(0, 0.2)), state)

    def along_walls(self) -> None:
        """Stand furniture along the walls."""
        for _ in range(int(self.rng.integers(2, 9))):
            self._against(self._draw("wall"), 4)

    def loose_furniture(self) -> None:
        """Stand furniture in corners and about the room."""
        w, deep, _ = self.room.size
        for _ in range(int(self.rng.integers(1, 6))):
            corner = self.rng.random() < 0.6
            kind = self._draw("corner" if corner else "free")
            for _ in range(4):
                draft = self._draft(kind)
                x, y = self.rng.uniform(0.2, w - 0.2), self.rng.uniform(0.2, deep - 0.2)
                yaw = self.rng.uniform(0, 2 * np.pi)
                if corner:
                    x, y = (
                        self.rng.choice([v, s - v])
                        for v, s in zip(self.rng.uniform(0.15, 0.6, 2), (w, deep), strict=True)
                    )
                pose = flat_pose(float(x), float(y), float(yaw))
                if self.room.fits(draft, pose):
                    self._place(kind, draft, pose)
                    break
        if self.rng.random() < 0.35:
            self._lay_rug(
                flat_pose(self.rng.uniform(0.8, w - 0.8), self.rng.uniform(0.8, deep - 0.8), self.rng.uniform(0, 3))
            )

    def hangings(self) -> None:
        """Hang things on walls and from the ceiling, and lean some against walls."""
        ranges = {"radiator": 0.0, "door": 0.0, "window": 0.9, "curtain": 0.03, "hanging coat": 1.7, "switch": 1.05}
        for _ in range(int(self.rng.integers(2, 10))):
            kind = self._draw("hang")
            if kind.name in ("door", "window") and self.rng.random() < 0.7:
                continue
            self._hang(kind, ranges.get(kind.name, self.rng.uniform(1.0, 1.6)))
        if self.rng.random() < 0.4:
            kind = self._draw("ceiling")
            w, deep, h = self.room.size
            draft, pose = (
                self._draft(kind),
                flat_pose(w * self.rng.uniform(0.3, 0.7), deep * self.rng.uniform(0.3, 0.7), 0.0, h),
            )
            if self.room.fits(draft, pose):
                self._place(kind, draft, pose)
        for _ in range(int(self.rng.integers(0, 3))):
            kind = self._draw("lean") if self.rng.random() < 0.4 else KINDS["picture"]
            draft = self._draft(kind)
            if kind.name == "picture":
                tilt = float(self.rng.uniform(0.08, 0.3))
                draft.parts = [(m.moved((0, 0, 0), roll=tilt), c) for m, c in draft.parts]
            low, high = draft.bounds()
            wall = int(self.rng.integers(4))
            x = self.rng.uniform(0.3, self.room.wall_length(wall) - 0.3)
            pose = self.room.wall_pose(wall, x, 0.005 - low[1], -low[2])
            if self.room.wall_free(wall, (x + low[0], x + high[0]), (0, high[2])) and self.room.fits(draft, pose):
                self.room.wall_free(wall, (x + low[0], x + high[0]), (0, high[2]), take=True)
                self._place(kind, draft, pose)

    def floor_things(self) -> None:
        """Put small things on the floor: beside furniture and walls more than in the middle, some in heaps."""
        w, deep, _ = self.room.size
        for _ in range(int(self.rng.poisson(2 + 3 * self.messy))):
            kind = self._draw("floor" if self.rng.random() < 0.85 else "shoes")
            x, y = self.rng.uniform(0.1, w - 0.1), self.rng.uniform(0.1, deep - 0.1)
            if self.rng.random() < 0.5:
                side = self.rng.integers(4)
                x, y = [(x, 0.25), (0.25, y), (x, deep - 0.25), (w - 0.25, y)][int(side)]
            for _ in range(3 if self.rng.random() < 0.25 else 1):
                draft = self._draft(kind)
                pose = flat_pose(float(x), float(y), float(self.rng.uniform(0, 6.3)), 0.002)
                if self.room.fits(draft, pose):
                    self._place(kind, draft, pose)
                x, y = x + self.rng.normal(0, 0.2), y + self.rng.normal(0, 0.2)

    def clutter(self) -> None:
        """Fill tops, boards, seats and beds."""
        usual = {"top": 9.0, "shelf": 16.0, "desk": 12.0, "seat": 2.0, "bed": 1.0, "media": 7.0, "shoes": 24.0}
        for draft, pose, _ in self.zones:
            for zone in draft.zones:
                if zone.z < 2.0 and self.rng.random() < 0.85:
                    density = usual[zone.use] * self.messy * self.rng.uniform(0.3, 1.5)
                    fill_zone(
                        self.room, self.palette, zone, pose, density=density, held_out=self.held_out, odd=self.odd
                    )

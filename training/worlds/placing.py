"""How things are put into a room: drawn until one fits, against walls, on walls, or free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from training.worlds.catalogue import KINDS, ODD, Kind, kinds_at
from training.worlds.draft import Draft
from training.worlds.materials import Palette
from training.worlds.room import Room, flat_pose


class Placer:
    """Puts things into one room."""

    def __init__(self, room: Room, palette: Palette, held_out: bool, odd: float) -> None:
        self.odd = odd
        self.room, self.palette, self.held_out, self.rng = room, palette, held_out, room.rng
        self.zones: list[tuple[Draft, NDArray[np.float64], Kind]] = []
        self.messy = float(room.rng.choice([0.3, 1.0, 2.0]))

    def _draft(self, kind: Kind) -> Draft:
        draft = Draft(self.rng, self.palette)
        kind.build(draft)
        return draft

    def _draw(self, place: str) -> Kind:
        if self.odd and place in ODD and self.rng.random() < self.odd:
            return ODD[place]
        kinds = kinds_at(place, held_out=self.held_out)
        weight = np.array([k.weight for k in kinds])
        return kinds[int(self.rng.choice(len(kinds), p=weight / weight.sum()))]

    def _place(self, kind: Kind, draft: Draft, pose: NDArray[np.float64], *, mark: bool = True) -> None:
        self.room.place(kind.name, kind.label, kind.family, draft, pose, mark=mark)
        if draft.zones:
            self.zones.append((draft, pose, kind))

    def _free(self, kind: Kind) -> None:
        """Stand a thing somewhere in the room, square to it."""
        w, deep, _ = self.room.size
        for _ in range(6):
            draft = self._draft(kind)
            at = self.rng.uniform(0.7, np.array([w, deep]) - 0.7)
            pose = flat_pose(float(at[0]), float(at[1]), float(self.rng.integers(4)) * np.pi / 2)
            if self.room.fits(draft, pose):
                self._place(kind, draft, pose)
                return

    def _hang(
        self, kind: Kind, z: float, wall: int | None = None, along: float | None = None
    ) -> tuple[int, float, Draft] | None:
        for _ in range(6):
            draft = self._draft(kind)
            low, high = draft.bounds()
            number = int(self.rng.integers(4)) if wall is None else wall
            half = max(-low[0], high[0])
            length = self.room.wall_length(number)
            if length < 2 * half + 0.1 or z + high[2] > self.room.size[2] - 0.02:
                continue
            x = self.rng.uniform(half + 0.03, length - half - 0.03) if along is None else along
            span, height = (x - half, x + half), (max(z + low[2], 0.0), z + high[2])
            pose = self.room.wall_pose(number, x, 0.0, z)
            if self.room.wall_free(number, span, height) and self.room.fits(draft, pose):
                self.room.wall_free(number, span, height, take=True)
                self._place(kind, draft, pose)
                return number, x, draft
        return None

    def _against(
        self, kind: Kind, tries: int = 8, wall: int | None = None, near: float | None = None
    ) -> tuple[int, float, Draft, NDArray[np.float64]] | None:
        """Stand a thing with its back to a wall, touching it or a little off."""
        for _ in range(tries):
            draft = self._draft(kind)
            low, high = draft.bounds()
            number = int(self.rng.integers(4)) if wall is None else wall
            length, half = self.room.wall_length(number), max(-low[0], high[0])
            if length < 2 * half + 0.05:
                continue
            x = (
                self.rng.uniform(half + 0.01, length - half - 0.01)
                if near is None
                else near + self.rng.uniform(-0.05, 0.05)
            )
            gap = float(self.rng.choice([0.003, 0.003, 0.02, 0.08]))
            pose = self.room.wall_pose(number, x, gap - low[1])
            span = (x - half, x + half)
            if self.room.wall_free(number, span, (0.05, high[2])) and self.room.fits(draft, pose):
                self.room.wall_free(number, span, (0.0, high[2]), take=True)
                self._place(kind, draft, pose)
                return number, x, draft, pose
        return None

    def _lay_rug(self, pose: NDArray[np.float64]) -> None:
        draft = self._draft(KINDS["rug"])
        corners = np.array(
            [
                [x, y, 0.0, 1.0]
                for x in draft.bounds()[0][[0]].tolist() + draft.bounds()[1][[0]].tolist()
                for y in (draft.bounds()[0][1], draft.bounds()[1][1])
            ]
        )
        flat = (corners @ pose.T)[:, :2]
        if (flat > 0.02).all() and (flat < np.array(self.room.size[:2]) - 0.02).all():
            self._place(KINDS["rug"], draft, pose, mark=False)

    def _chair_at(self, name: str, pose: NDArray[np.float64], state: dict[str, object] | None = None) -> None:
        before = self.rng.bit_generator.state
        if state is not None:
            self.rng.bit_generator.state = state
        draft = self._draft(KINDS[name])
        if state is not None:
            self.rng.bit_generator.state = before
        if self.room.fits(draft, pose):
            self._place(KINDS[name], draft, pose)

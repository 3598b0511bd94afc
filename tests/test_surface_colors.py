"""What colour tells of two sessions: facts on rooms of boxes, laws of the distances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from list3r.memory.library.change.moves import difference
from list3r.memory.library.change.places import GroupLooks
from list3r.memory.library.change.records import ChangeSettings
from list3r.memory.library.change.surface_colors import LightBetween, hue_distance, lab, palette_distance
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from tests.session_scenes import ROOM, Box, add_session, cameras, place_together

S = ChangeSettings()
TABLE = (0.0, 0.0, 0.75)
OLIVE = (110, 120, 40)


def _told(path: Path, second: dict[str, Box]) -> list[tuple[str, bool]]:
    """Kinds of what is told to have changed, and whether it is where the green box is."""
    with Store.create(path) as store:
        for room, start in ((dict(ROOM), 0.4), (second, 1.0)):
            with store.transaction():
                add_session(store, room, np.concatenate([cameras(TABLE, start), cameras(TABLE, start + 0.1)]))
                place_together(store)
                consolidate(store)
        events = [e for e in store.events.all(2) if e.kind != "seen_again"]
        boxes = [e.to_box or e.from_box for e in events]
        off = [1.0 if b is None else float(np.abs(b.center - ROOM["green"].center).max()) for b in boxes]
        return sorted((e.kind, d < 0.05) for e, d in zip(events, off, strict=True))


def test_a_thing_in_the_place_of_another_of_its_size_is_told_by_its_colour(tmp_path: Path) -> None:
    """Depth cannot tell them apart."""
    green = ROOM["green"]
    room = {**ROOM, "green": Box(green.center, green.size, OLIVE)}
    assert _told(tmp_path / "a.l3r", room) == [("added", True), ("removed", True)]


def test_another_light_changes_nothing(tmp_path: Path) -> None:
    warm = {
        name: Box(b.center, b.size, (min(b.rgb[0] * 11 // 10, 255), b.rgb[1] * 9 // 10, b.rgb[2] * 6 // 10))
        for name, b in ROOM.items()
    }
    assert _told(tmp_path / "a.l3r", warm) == []


def test_light_is_what_all_surfaces_have_in_common() -> None:
    rng = np.random.default_rng(0)
    before = rng.integers(20, 200, (500, 3)).astype(np.uint8)
    after = np.clip(before * np.array([1.2, 1.0, 0.6]) + rng.normal(0, 1, before.shape), 0, 255).astype(np.uint8)
    light = LightBetween.of(before, after)
    assert light is not None
    np.testing.assert_allclose(light.gain, [1.2, 1.0, 0.6], atol=0.02)
    assert light.noise < 1.0
    assert light.limit(S) == S.other_surface
    assert LightBetween.of(before[:100], after[:100]) is None
    other = LightBetween.of(before, rng.permutation(after))
    assert other is not None
    assert other.limit(S) > S.other_surface


def test_a_part_has_the_colours_of_the_whole_and_hues_stay_in_less_light() -> None:
    rng = np.random.default_rng(1)
    whole = np.array([[180, 140, 90], [170, 40, 40]])[rng.integers(0, 2, 400)] + rng.integers(-5, 6, (400, 3))
    part, dim = whole[whole[:, 1] > 90], 255 * ((whole / 255 + 0.055) * 0.5 ** (1 / 2.4) - 0.055)
    assert palette_distance(lab(whole), lab(whole)) == 0.0
    assert hue_distance(lab(whole), lab(whole)) < 1e-9
    assert palette_distance(lab(part), lab(whole)) == palette_distance(lab(whole), lab(part))
    assert palette_distance(lab(np.array([[40, 60, 200]])), lab(whole)) > S.other_palette
    assert hue_distance(lab(whole), lab(dim)) < S.hues
    assert hue_distance(lab(whole), lab(part)) > S.hues
    assert hue_distance(lab(whole), np.zeros((0, 3))) == 1.0


@pytest.mark.parametrize(
    ("extent", "one"), [((0.2, 0.1, 0.1), True), ((0.2, 0.02, 0.1), True), ((0.4, 0.02, 0.1), False)]
)
def test_a_part_is_shorter_nowhere_longer(extent: tuple[float, float, float], one: bool) -> None:
    palette = lab(np.full((20, 3), 120))
    whole, seen = (GroupLooks(np.array(x), palette) for x in ((0.2, 0.1, 0.1), extent))
    assert (difference(whole, seen, S) < S.most_deviations) is one
    assert difference(whole, seen, S) == difference(seen, whole, S)

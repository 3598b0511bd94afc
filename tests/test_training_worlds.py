"""The worlds that discovery learns from: whole meshes, things at rest, left-out families, truth of every pixel."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("open3d")

from training.worlds.catalogue import BUILT_IN, FAMILIES, HELD_OUT, KINDS, kinds_at
from training.worlds.draft import Draft, Zone
from training.worlds.film import FilmSettings, make_film
from training.worlds.furnish import make_world
from training.worlds.materials import Palette
from training.worlds.settle import drop, new_bed
from training.worlds.tabletop import book, mug


@pytest.mark.parametrize("name", sorted(KINDS))
def test_every_kind_is_a_whole_mesh_of_a_likely_size(name: str) -> None:
    rng = np.random.default_rng(len(name))
    draft = Draft(rng, Palette(rng, held_out=True))
    KINDS[name].build(draft)
    mesh = draft.mesh()
    low, high = draft.bounds()
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.triangles.min() and mesh.triangles.max() < len(mesh.vertices)
    assert 0.005 < np.max(high - low) < 3.5


def test_left_out_families_are_never_trained_on() -> None:
    assert set(HELD_OUT) <= set(FAMILIES) and len(FAMILIES) >= 40
    places = {k.place for k in KINDS.values()}
    shown = {k.family for place in places for k in kinds_at(place, held_out=False)}
    assert not shown & set(HELD_OUT)
    families = {t.family for seed in (3, 4) for t in make_world(seed).things}
    assert not families & set(HELD_OUT)


def test_what_is_dropped_rests_on_what_is_below() -> None:
    rng = np.random.default_rng(2)
    palette = Palette(rng, held_out=False)
    bed = new_bed(Zone((-0.5, -0.5), (0.5, 0.5), 0.7, 0.5))
    below, above, beside = Draft(rng, palette), Draft(rng, palette), Draft(rng, palette)
    book(below)
    book(above)
    mug(beside)
    first = drop(bed, below, np.eye(3), (0.0, 0.0), stacks=True)
    assert first is not None and first[2, 3] == pytest.approx(0.701, abs=0.002)
    thick = below.bounds()[1][2]
    second = drop(bed, above, np.eye(3), (0.0, 0.0), stacks=True)
    assert second is not None and second[2, 3] == pytest.approx(first[2, 3] + thick, abs=0.003)
    assert drop(bed, beside, np.eye(3), (0.02, 0.02), stacks=False) is None
    assert drop(bed, beside, np.eye(3), (0.6, 0.0), stacks=False) is None


def test_a_film_is_a_function_of_its_seed_and_its_truth_fits() -> None:
    settings = FilmSettings(seed=7, frames=3, sensor="structured")
    film, again = make_film(settings), make_film(settings)
    assert np.array_equal(film.color, again.color) and np.array_equal(film.depth, again.depth)
    assert np.array_equal(film.ids, again.ids)
    known = {t.id for t in film.things}
    assert set(np.unique(film.ids).tolist()) - {0} <= known
    assert (film.depth > 0).mean() > 0.3 and any(t.structure for t in film.things if t.id in film.ids)


def test_what_is_built_in_stands_in_the_room_and_structure_is_none_of_it() -> None:
    worlds = [make_world(seed, fitted=True) for seed in (2, 5)]
    built_in = {k.name for k in KINDS.values() if k.place in BUILT_IN}
    assert all({t.kind for t in world.things} & built_in for world in worlds)
    for world in worlds:
        assert sum(t.structure for t in world.things) > 6
        for thing in world.things:
            points = thing.vertices()
            assert thing.structure == (thing.family == "structure")
            if not thing.structure:
                assert points[:, :2].min() > -0.05 and (points[:, :2] < np.array(world.size[:2]) + 0.05).all()
    assert make_world(2).things[6:] != worlds[0].things[6:]

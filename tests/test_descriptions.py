"""Descriptions: colours that a person would name so, in dim and in warm light, and shapes that can be told."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.memory.core.description.colors import (
    Reference,
    color_name,
    color_names,
    color_words,
    dominant_colors,
    lab_from_rgb,
    main_color,
    scene_reference,
)
from list3r.memory.core.description.describe import describe, shape_word

NAMED = {
    (245, 245, 245): "white",
    (200, 203, 200): "white",
    (170, 170, 172): "light grey",
    (128, 128, 128): "grey",
    (70, 70, 72): "dark grey",
    (25, 25, 25): "black",
    (196, 52, 44): "red",
    (110, 25, 35): "dark red",
    (255, 192, 203): "pink",
    (226, 110, 60): "orange",
    (255, 165, 0): "orange",
    (103, 63, 45): "brown",
    (165, 145, 120): "tan",
    (228, 204, 168): "beige",
    (236, 178, 48): "yellow",
    (46, 134, 84): "green",
    (20, 60, 30): "dark green",
    (28, 140, 150): "teal",
    (135, 206, 235): "light blue",
    (40, 92, 168): "blue",
    (0, 0, 128): "dark blue",
    (110, 95, 130): "purple",
    (132, 72, 150): "purple",
}


def points_of(*parts: tuple[tuple[int, int, int], int], noise: float = 4.0) -> np.ndarray:
    rng = np.random.default_rng(5)
    rgb = np.concatenate([np.tile(np.array(color, float), (count, 1)) for color, count in parts])
    rgb = np.clip(rgb + rng.normal(0, noise, rgb.shape), 0, 255).astype(np.uint8)
    return rgb[rng.permutation(len(rgb))]


@pytest.mark.parametrize(("rgb", "name"), NAMED.items())
def test_everyday_colours_have_their_names(rgb: tuple[int, int, int], name: str) -> None:
    assert color_name(lab_from_rgb(np.array(rgb, np.uint8))) == name


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.72, 0.72, 0.72), (0.98, 0.95, 0.88)])
def test_a_white_mug_is_white_and_a_grey_one_grey_in_dim_and_warm_light(light: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(1)
    room = np.concatenate([rng.uniform(40, 245, (2000, 1)) * np.ones(3), rng.uniform(0, 255, (400, 3))])
    reference = scene_reference(lab_from_rgb((room * light).astype(np.uint8)))
    for rgb, name in (((225, 225, 225), "white"), ((130, 130, 130), "grey"), ((140, 60, 150), "purple")):
        seen = (np.array(rgb) * light).astype(np.uint8)
        assert color_name(lab_from_rgb(seen), reference) == name


def test_a_room_without_anything_neutral_corrects_nothing() -> None:
    lab = lab_from_rgb(np.tile(np.uint8([200, 40, 40]), (500, 1)))
    assert scene_reference(lab) == Reference()
    assert scene_reference(np.zeros((0, 3))) == Reference()


def test_the_commonest_colour_counts_not_the_mixture_of_all() -> None:
    swatches = dominant_colors(points_of(((196, 52, 44), 300), ((40, 92, 168), 180), ((30, 30, 30), 60)))
    assert main_color(swatches, color_names(swatches))[0] == "red"
    assert sum(s.share for s in swatches) <= 1.0 + 1e-9
    assert [s.share for s in swatches] == sorted((s.share for s in swatches), reverse=True)


def test_shadow_gives_way_to_what_is_lit() -> None:
    lit, dark = (
        dominant_colors(points_of(((20, 18, 18), 220), ((150, 95, 55), 180))),
        dominant_colors(points_of(((20, 18, 18), 400))),
    )
    assert main_color(lit, color_names(lit))[0] == "brown"
    assert main_color(dark, color_names(dark))[0] == "black"


def test_two_colours_are_named_only_where_both_are_clear() -> None:
    red, white = (196, 40, 40), (240, 240, 240)
    seen = {
        "red and white": points_of((red, 220), (white, 180)),
        "red": points_of((red, 360), (white, 60)),
        "grey": points_of(((120, 120, 120), 220), ((190, 190, 190), 180)),
    }
    for words, points in (*seen.items(), ("grey", np.zeros((0, 3), np.uint8))):
        swatches = dominant_colors(points)
        assert color_words(swatches, color_names(swatches)) == words


def cylinder(radius: float, height: float, arc: float, noise: float = 0.002) -> np.ndarray:
    rng = np.random.default_rng(3)
    angle = rng.uniform(-arc / 2, arc / 2, 500)
    side = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.5, 0.5, 500) * height])
    return side + rng.normal(0, noise, side.shape)


def block(size: tuple[float, float, float], faces: str = "xyz", noise: float = 0.003) -> np.ndarray:
    rng = np.random.default_rng(4)
    parts = []
    for axis in ("xyz".index(c) for c in faces):
        p = rng.uniform(-0.5, 0.5, (400, 3))
        p[:, axis] = 0.5
        parts.append(p * size)
    return np.concatenate(parts) + rng.normal(0, noise, (400 * len(parts), 3))


@pytest.mark.parametrize("arc", [2 * np.pi, 1.2 * np.pi])
def test_round_things_are_told_from_boxes(arc: float) -> None:
    p = cylinder(0.05, 0.11, arc)
    p -= (p.min(axis=0) + p.max(axis=0)) / 2
    assert shape_word(p, np.ptp(p, axis=0)) == "cylinder"
    assert shape_word(block((0.2, 0.15, 0.14)), np.array([0.2, 0.15, 0.14])) == "box"
    assert shape_word(block((0.1, 0.1, 0.1)), np.array([0.1, 0.1, 0.1])) == "box"


def test_what_is_neither_is_an_object() -> None:
    p = np.random.default_rng(0).uniform(-0.5, 0.5, (600, 3)) * (0.4, 0.4, 0.8)
    assert shape_word(p, np.array([0.4, 0.4, 0.8])) == "object"


def test_flat_long_and_table() -> None:
    assert shape_word(block((0.3, 0.2, 0.004), "z"), np.array([0.3, 0.2, 0.004])) == "sheet"
    assert shape_word(block((1.6, 0.03, 0.8), "y"), np.array([1.6, 0.03, 0.8])) == "panel"
    assert shape_word(block((0.3, 0.2, 0.04)), np.array([0.3, 0.2, 0.04])) == "slab"
    assert shape_word(block((1.2, 0.05, 0.06)), np.array([1.2, 0.05, 0.06])) == "bar"
    leg = block((0.05, 0.05, 0.7))[::16]
    legs = np.concatenate([leg + np.array([x, y, -0.02]) for x in (-0.6, 0.6) for y in (-0.4, 0.4)])
    table = np.concatenate([block((1.3, 0.9, 0.74), "z"), legs])
    assert shape_word(table, np.array([1.3, 0.9, 0.74])) == "table"
    assert shape_word(block((1.3, 0.9, 0.74)), np.array([1.3, 0.9, 0.74])) == "box"


def test_descriptions_tell_centimetres_only_where_there_are_metres() -> None:
    size = np.array([0.2, 0.15, 0.14])
    assert describe("box", "red", size, 1.0, metric=True, structure=None) == "small red box, 20 cm"
    assert describe("box", "red", size * 3, 3.0, metric=False, structure=None) == "small red box"
    assert describe("bar", "red", size, 1.0, metric=True, structure=None) == "long red bar, 20 cm"
    assert (
        describe("box", "grey", np.array([3.0, 2.0, 0.01]), 1.0, metric=True, structure="floor") == "grey floor, 3.0 m"
    )
    assert (
        describe("box", "grey", np.array([0.996, 0.3, 0.2]), 1.0, metric=True, structure="wall") == "grey wall, 1.0 m"
    )

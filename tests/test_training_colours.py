"""Rooms that discovery learns from, in few colours."""

from __future__ import annotations

import numpy as np

from list3r.frames.base import Camera
from list3r.instances.geometric.fusion import View
from training.colours import MOST_PAINTS, in_few_colours
from training.samples import Sample

H, W = 48, 64
SEEDS = range(40)


def room(seed: int) -> Sample:
    """Two views of eight strips, each a thing of its own colour, under a light that falls off."""
    rng = np.random.default_rng([seed, 5])
    ids = np.repeat(np.arange(8, dtype=np.int32), W // 8)[None].repeat(H, axis=0)
    paint = rng.uniform(60, 200, (8, 3))
    light = np.linspace(-15, 15, H)[:, None, None]
    rgb = np.clip(paint[ids] + light, 0, 255).astype(np.uint8)
    camera, flat = Camera(50.0, 50.0, 32.0, 24.0, W, H), np.ones((H, W), np.float32)
    seen = np.ones((H, W), bool)
    points = np.zeros((H, W, 3), np.float32)
    views = tuple(View(p, np.eye(4), camera, flat, flat, flat, seen, points, points, rgb) for p in range(2))
    return Sample(
        seed, "structured", views, (ids, ids), np.stack([np.eye(4)] * 2), (), np.array([0.0, 0.0, 1.0]), False
    )


def test_only_colours_change_and_the_seed_says_how() -> None:
    for seed in SEEDS:
        before = room(seed)
        after, again = in_few_colours(before), in_few_colours(before)
        assert after.ids is before.ids and after.things is before.things
        for old, new, same in zip(before.views, after.views, again.views, strict=True):
            assert new.depth is old.depth and new.points is old.points
            assert np.array_equal(new.rgb, same.rgb)
            assert new.rgb.dtype == np.uint8


def test_a_room_is_grey_or_dull_or_in_few_paints() -> None:
    seen = set()
    for seed in SEEDS:
        before, after = room(seed), in_few_colours(room(seed))
        old, new = (np.asarray(s.views[0].rgb, float) for s in (before, after))
        thing = before.ids[0]
        mean = np.stack([new[thing == k].mean(axis=0) for k in range(8)])
        hue = mean - mean.mean(axis=1, keepdims=True)
        paints = []
        for row in hue:
            if not any(np.abs(row - p).max() < 4.0 for p in paints):
                paints.append(row)
        grey, dull = bool((np.ptp(new, axis=2) == 0).all()), bool(new.std() < 0.7 * old.std())
        assert grey or dull or len(paints) <= MOST_PAINTS
        seen.add("grey" if grey else "dull" if dull else "paints")
    assert seen == {"grey", "dull", "paints"}

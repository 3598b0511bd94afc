"""The plane sweep's network: it adds depth where matches tell none, and is about as right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from list3r.frames.source import SourceInfo
from list3r.memory.core.errors import OptionError
from list3r.pipeline.choice import BuildRequest, settings_asked
from list3r.reconstruction.mvs.network import (
    PLANES,
    SweepNetwork,
    load_network,
    network_costs,
    predict_depth,
    side_features,
)
from list3r.reconstruction.mvs.stereo import MvsSettings, PosedFrames, dense_depth, keyframe_costs
from list3r.reconstruction.mvs.weights import SHIPPED
from tests.test_mvs import COUNT, SMALL, errors, small_scene


@pytest.mark.slow
def test_it_adds_depth_to_matches_and_is_as_right() -> None:
    frames, T, truth = small_scene()
    given = PosedFrames(frames, np.ones(COUNT, bool), T, SMALL)
    alone, _ = dense_depth(given, replace(MvsSettings(), network=None))
    both, _ = dense_depth(given)
    assert (both > 0).mean() > (alone > 0).mean()
    assert (errors(both, truth) > 0.1).mean() < (errors(alone, truth) > 0.1).mean() + 0.01
    assert np.median(errors(both, truth)) < 1.3 * np.median(errors(alone, truth))


def test_costs_of_any_number_of_planes_become_those_of_its_own() -> None:
    ramp = torch.linspace(0.0, 1.0, 24)[:, None, None].expand(24, 3, 5)
    seen = network_costs(ramp)
    assert seen.shape == (PLANES, 3, 5)
    assert torch.allclose(seen[:, 1, 2], torch.linspace(0.0, 1.0, PLANES), atol=1e-6)
    assert torch.equal(network_costs(seen), seen)


@pytest.mark.parametrize("size", [(30, 40), (17, 23)])
def test_depth_is_of_any_size_and_scales_with_the_unit(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    cost = torch.from_numpy(rng.random((40, *size), dtype=np.float32))
    color = rng.integers(0, 255, (2 * size[0], 2 * size[1], 3)).astype(np.uint8)
    side = side_features((0.2, 2.0), 30.0, 4)
    once = predict_depth(load_network(), cost, color, (0.2, 2.0), side)
    far = predict_depth(load_network(), cost, color, (0.02, 0.2), side_features((0.02, 0.2), 300.0, 4))
    assert once[0].shape == once[1].shape == (2 * size[0], 2 * size[1])
    assert torch.allclose(far[0] * 10.0, once[0], rtol=1e-3) and torch.allclose(far[1], once[1], rtol=1e-3)
    assert (once[0] > 0).all() and (once[1] > 0).all()


def test_what_learns_sees_the_costs_that_depth_is_read_from() -> None:
    frames, T, _ = small_scene()
    found = keyframe_costs(PosedFrames(frames, np.ones(COUNT, bool), T, SMALL))
    assert found
    for swept in found:
        assert swept.key not in swept.sources and swept.cost.shape[0] == len(swept.planes)
        assert 0.0 <= float(swept.cost.min()) and float(swept.cost.max()) <= 1.0
        assert np.isfinite(swept.side_features()).all() and swept.span[0] < swept.span[1]


def test_shipped_weights_are_small_and_damage_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert SHIPPED.stat().st_size < 2_800_000
    torch.manual_seed(0)
    fresh, shipped = SweepNetwork().state_dict(), load_network().state_dict()
    assert {k: v.shape for k, v in fresh.items()} == {k: v.shape for k, v in shipped.items()}
    (tmp_path / "weights.npz").write_bytes(SHIPPED.read_bytes()[:-2000])
    load_network.cache_clear()
    monkeypatch.setattr("list3r.reconstruction.mvs.weights.SHIPPED", tmp_path / "weights.npz")
    colour = SourceInfo("folder", "walk", 9, 30.0, None, False, False, "x")
    with pytest.raises(OptionError, match=r"network in weights\.npz .*install list3r again") as said:
        settings_asked(BuildRequest(), colour, "any")
    assert "\n" not in str(said.value)
    settings_asked(BuildRequest(), replace(colour, has_depth=True), "any")
    load_network.cache_clear()

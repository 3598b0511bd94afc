"""Training of the plane sweep's network: rooms to learn from, losses, and a run that is gone on with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("open3d")

from list3r.reconstruction.mvs.network import PLANES, SweepNetwork, SweepPrediction
from training.samples import Kind
from training.sweep_fit import Batch, SweepFitSettings, draw_batch, fit_sweep, relative_error, sweep_losses
from training.sweep_samples import PARTS, make_keyframes
from training.worlds.film import FilmSettings, make_film


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = make_keyframes(20_001, tmp_path_factory.mktemp("rooms"), **Kind(odd=0.5))
    assert found is not None
    return found


@pytest.mark.slow
def test_keyframes_are_made_once_and_their_likeliest_planes_are_mostly_true(room: Path) -> None:
    costs, picture, place, side = (np.load(room / f"{name}.npy") for name in PARTS)
    count, planes, height, width = costs.shape
    assert planes == PLANES and picture.shape == (count, 2 * height, 2 * width, 3) and side.shape == (count, 3)
    true = place.astype(np.float32).reshape(count, height, 2, width, 2).mean(axis=(2, 4))
    known = (true > 2) & (true < PLANES - 3) & (costs.min(axis=1) < 40)
    off = np.abs(costs.argmin(axis=1) - true)[known]
    assert known.any() and (off < 3).mean() > 0.6
    before = {p.name: p.stat().st_mtime_ns for p in room.iterdir()}
    assert make_keyframes(20_001, room.parent, **Kind(odd=0.5)) == room
    assert before == {p.name: p.stat().st_mtime_ns for p in room.iterdir()}


def test_an_interrupted_run_goes_on_to_the_same_weights(room: Path, tmp_path: Path) -> None:
    def run(folder: Path, steps: int) -> dict[str, torch.Tensor]:
        torch.manual_seed(3)
        network = SweepNetwork(top=16, widths=(16, 16))
        settings = SweepFitSettings(4, batch=2, crop=(32, 48), every=1)
        if steps < 4:
            with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
                calls = iter(range(steps))
                patch.setattr("training.sweep_fit._rate", lambda *_: 1e-3 if next(calls, None) is not None else stop())
                fit_sweep(network, [room], folder, settings)
            return {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("training.sweep_fit._rate", lambda *_: 1e-3)
            return fit_sweep(network, [room], folder, settings)

    def stop() -> float:
        raise KeyboardInterrupt

    whole = run(tmp_path / "whole", 4)
    run(tmp_path / "cut", 2)
    again = run(tmp_path / "cut", 4)
    assert all(torch.equal(whole[name], again[name]) for name in whole)
    assert (tmp_path / "cut" / "log.jsonl").read_text().count("\n") == 4


def test_errors_are_those_of_depth_and_a_perfect_answer_has_none(room: Path) -> None:
    batch = draw_batch([room], np.random.default_rng(0), SweepFitSettings(batch=2), torch.device("cpu"))
    true = batch.place.clamp(0, PLANES - 1)
    low, high = 0.25, 2.0
    side = batch.side.clone()
    side[:, 1] = low / high
    batch = Batch(batch.likeness, batch.picture, batch.place, side)
    logits = torch.zeros(2, PLANES, *batch.likeness.shape[2:])
    told = SweepPrediction(logits, true + 2.0, torch.full_like(true, -3.0))

    def depth(place: torch.Tensor) -> torch.Tensor:
        return 1.0 / (low + place * (high - low) / (PLANES - 1))

    assert torch.allclose(relative_error(told, batch), torch.log(depth(true) / depth(true + 2.0)), atol=1e-5)
    perfect = SweepPrediction(logits, true, told.log_error)
    cross, likelihood, off = sweep_losses(perfect, batch)
    assert float(off) == 0.0 and float(likelihood) == pytest.approx(-3.0, abs=1e-4)
    assert float(cross) == pytest.approx(float(np.log(PLANES)), abs=0.1)


def test_looks_change_colours_and_nothing_else() -> None:
    plain, worn = (make_film(FilmSettings(20_001, frames=2, looks=looks)) for looks in (False, True))
    assert np.array_equal(plain.true_depth, worn.true_depth) and np.array_equal(plain.ids, worn.ids)
    change = np.abs(plain.color.astype(int) - worn.color).mean()
    assert 3 < change < 100

"""How sure it is that a thing is one, and where: the position is as uncertain as the chunks that saw it."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.memory.core.geometry import Sim3, stack
from list3r.memory.core.records import ChunkRow
from list3r.memory.library.overlap.voxels import chunk_shapes
from list3r.memory.library.uncertainty import point_covariances, position_sigmas, signs_of
from tests.memory_scenes import IMAGE, MUG, TABLE, node, surface


def chunk(S: Sim3, covariance: np.ndarray | None, chunk_id: int = 0) -> ChunkRow:
    return ChunkRow(chunk_id, 0, 0, 0, 9, 0, S, (50.0, 50.0, 32.0, 24.0), (48, 64), "relative", covariance)


def position_sigma(center: np.ndarray, chunks: list[ChunkRow]) -> float | None:
    every = np.arange(len(chunks))
    return position_sigmas(center[None], np.zeros_like(every), every, chunks)[0]


def test_it_is_what_sampling_says() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(7, 7)) * 0.003
    S = Sim3.exp([1, 2, 3, 0.3, -0.2, 0.5, 0.7])
    center = np.array([2.0, 1.0, -1.0])
    errors = Sim3.exp(rng.normal(size=(20000, 7)) @ half.T)
    moved = (S @ errors).apply(np.tile(S.inverse().apply(center[None]), (20000, 1, 1)))[:, 0]
    expected = point_covariances(stack([S]), half @ half.T, center[None])[0]
    assert np.allclose(np.cov(moved.T), expected, atol=0.05 * np.trace(expected))
    sigma = position_sigma(center, [chunk(S, half @ half.T)])
    assert sigma == pytest.approx(np.sqrt(np.linalg.eigvalsh(expected)[-1]))


def test_turns_count_with_distance_and_scale_with_the_chunk() -> None:
    turn = np.diag([0, 0, 0, 0, 0, 1e-4, 0.0])
    near, far = (position_sigma(np.array([x, 0.0, 0.0]), [chunk(Sim3.identity(), turn)]) for x in (1.0, 5.0))
    assert near == pytest.approx(0.01)
    assert far == pytest.approx(0.05)
    shift = np.diag([1e-4, 1e-4, 1e-4, 0, 0, 0, 0.0])
    grown = chunk(Sim3.exp([0, 0, 0, 0, 0, 0, np.log(3.0)]), shift)
    assert position_sigma(np.zeros(3), [grown]) == pytest.approx(0.03)


def test_the_worst_chunk_counts_and_silence_stays_silence() -> None:
    sure, unsure = (chunk(Sim3.identity(), np.eye(7) * s**2) for s in (0.01, 0.1))
    assert position_sigma(np.zeros(3), [sure, unsure]) == pytest.approx(0.1)
    silent = chunk(Sim3.identity(), None)
    assert position_sigma(np.zeros(3), [silent]) is None
    assert position_sigma(np.zeros(3), []) is None
    assert position_sigma(np.zeros(3), [silent, sure]) == pytest.approx(0.01)
    assert position_sigma(np.ones(3), [chunk(Sim3.identity(), np.zeros((7, 7)))]) == 0.0


def test_how_many_frames_a_second_were_filmed_says_nothing_of_a_thing() -> None:
    def mug(every: int, there: slice = slice(0, 60)) -> float:
        frames = np.arange(120)
        seen = [frames[there][::every], frames[::every], frames[40:100][::every]]
        nodes = [
            node(0, k, surface(p, k), frames=f) for k, (p, f) in enumerate(zip((MUG, TABLE, MUG), seen, strict=True))
        ]
        shapes = chunk_shapes(nodes, IMAGE, chunk_id=0)
        without = shapes.only(np.array([True, True, False]))  # whatever is left out later
        found, later = (signs_of([(0, 0)], {0: c}, len(seen[0]), 1.0).frames for c in (shapes, without))
        assert found == later
        return found

    assert mug(1) == mug(4) == 1.0 and mug(1, slice(0, 30)) == 0.5

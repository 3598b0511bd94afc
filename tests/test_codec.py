"""Round trips of what goes into blobs, and refusal of what is damaged or lies."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import decode_mask, encode_mask
from list3r.memory.store.rows.codec import dequantise, pack, pack_sim3, quantise, raw_array, unpack, unpack_sim3


@given(arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=20)))
def test_masks_round_trip(mask: np.ndarray) -> None:
    runs = encode_mask(mask)
    assert np.array_equal(decode_mask(runs, mask.shape), mask)
    assert runs[1:].all()


def test_a_mask_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        decode_mask(np.array([2**31, 2**31], np.uint32), (4, 4))


@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=st.floats(-50, 50, width=32)))
def test_points_come_back_to_half_a_step(points: np.ndarray) -> None:
    grid, steps = quantise(points)
    back = dequantise(grid, steps, len(points), "points")
    extent = np.ptp(points, axis=0).max() if len(points) else 0.0
    assert back.shape == points.shape
    assert np.allclose(back, points, atol=extent / 131070 + 1e-5)
    assert quantise(points) == (grid, steps)


def test_transforms_come_back_to_the_bit() -> None:
    transform = Sim3.exp(np.random.default_rng(0).normal(size=7))
    back = unpack_sim3(pack_sim3(transform))
    assert np.array_equal(back.as_matrix(), transform.as_matrix())


def test_the_same_arrays_give_the_same_bytes() -> None:
    arrays_in = {"a": np.arange(7), "b": np.ones((2, 3), np.float32)}
    blob = pack(arrays_in)
    assert blob == pack(arrays_in)
    assert all(np.array_equal(unpack(blob, "row")[k], v) for k, v in arrays_in.items())


@pytest.mark.parametrize("cut", [0, 1, 10, 100])
def test_damaged_bytes_name_their_row(cut: int) -> None:
    blob = pack({"a": np.arange(100)})
    with pytest.raises(MemoryFileError, match="row 7"):
        unpack(blob[:cut], "row 7")


def packed(line: bytes, data: bytes = b"") -> bytes:
    return zlib.compress(line + b"\n" + data)


@pytest.mark.parametrize(
    "blob",
    [
        packed(b'[["a","|O",[1]]]', bytes(8)),
        packed(b'[["a","<f8",[1000000000000]]]'),
        packed(b'[["a","<f8",[-1]]]'),
        packed(b'[["a","<f8",[1]]]', bytes(16)),
        packed(b'{"a":1}'),
        packed(b"[" * 4000),
        zlib.compress(bytes(300 * 2**20)),
    ],
)
def test_what_lies_about_itself_is_refused(blob: bytes) -> None:
    with pytest.raises(MemoryFileError, match="row 7"):
        unpack(blob, "row 7")


def test_raw_blobs_must_fit_their_shape() -> None:
    with pytest.raises(MemoryFileError, match="holds 8 bytes instead of 16"):
        raw_array(bytes(8), "<f8", (2,), "row 7")

"""Laws of transforms, alignment and boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import (
    Sim3,
    quat_wxyz_from_rotation,
    rotation_exp,
    rotation_from_quat_wxyz,
    rotation_log,
    skew,
    umeyama,
    upright_box,
)

numbers = st.floats(-1.5, 1.5, allow_nan=False, width=32)
tangents = arrays(np.float64, (7,), elements=numbers)
points = arrays(np.float64, (12, 3), elements=st.floats(-5, 5, allow_nan=False, width=32))


def close(a: Sim3, b: Sim3) -> bool:
    return np.allclose(a.as_matrix(), b.as_matrix(), atol=1e-9)


@given(tangents, tangents, tangents)
def test_similarities_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    x, y, z = Sim3.exp(a), Sim3.exp(b), Sim3.exp(c)
    assert close((x @ y) @ z, x @ (y @ z))
    assert close(x @ x.inverse(), Sim3.identity())
    assert close(x @ Sim3.identity(), x)
    assert close((x @ y).inverse(), y.inverse() @ x.inverse())


@given(tangents)
def test_exp_is_the_matrix_exponential_and_log_its_inverse(tangent: np.ndarray) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3] = skew(tangent[3:6]) + tangent[6] * np.eye(3)
    generator[:3, 3] = tangent[:3]
    transform = Sim3.exp(tangent)
    assert np.allclose(transform.as_matrix(), expm(generator), atol=1e-9)
    assert np.allclose(transform.log(), tangent, atol=1e-8)


@given(tangents, points)
def test_apply_is_the_homogeneous_product(tangent: np.ndarray, p: np.ndarray) -> None:
    transform = Sim3.exp(tangent)
    homogeneous = np.concatenate([p, np.ones((12, 1))], axis=1) @ transform.as_matrix().T
    assert np.allclose(transform.apply(p), homogeneous[:, :3], atol=1e-9)
    assert close(Sim3.from_matrix(transform.as_matrix()), transform)


def test_batches_are_rows_of_single_ones() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4, 5, 7)), rng.normal(size=(4, 5, 7))
    many = Sim3.exp(a) @ Sim3.exp(b).inverse()
    one = Sim3.exp(a[2, 3]) @ Sim3.exp(b[2, 3]).inverse()
    assert np.allclose(many.as_matrix()[2, 3], one.as_matrix())
    assert many.apply(rng.normal(size=(4, 5, 9, 3))).shape == (4, 5, 9, 3)


@given(arrays(np.float64, (3,), elements=numbers))
def test_rotations_round_trip_through_vectors_and_quaternions(rotvec: np.ndarray) -> None:
    rotation = rotation_exp(rotvec)
    assert np.allclose(rotation_log(rotation), rotvec, atol=1e-9)
    quat_wxyz = quat_wxyz_from_rotation(rotation)
    assert quat_wxyz[0] >= 0
    assert np.allclose(rotation_from_quat_wxyz(quat_wxyz), rotation)


@settings(max_examples=50)
@given(tangents, st.integers(0, 2**32 - 1))
def test_umeyama_recovers_what_was_applied(tangent: np.ndarray, seed: int) -> None:
    source = np.random.default_rng(seed).normal(size=(20, 3))
    truth = Sim3.exp(tangent)
    assert close(umeyama(source, truth.apply(source), with_scale=True), truth)
    rigid = Sim3.exp(np.append(tangent[:6], 0.0))
    assert close(umeyama(source, rigid.apply(source), with_scale=False), rigid)


def test_umeyama_ignores_what_has_no_weight_and_keeps_handedness() -> None:
    rng = np.random.default_rng(1)
    source, truth = rng.normal(size=(30, 3)), Sim3.exp([1, 2, 3, 0.3, 0.2, 0.1, 0.0])
    target = truth.apply(source)
    target[:10] += 5.0
    weights = np.r_[np.zeros(10), np.ones(20)]
    assert close(umeyama(source, target, weights, with_scale=False), truth)
    mirrored = source * [1, 1, -1]
    assert np.linalg.det(umeyama(source, mirrored, with_scale=True).rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("source", [np.zeros((2, 3)), np.outer(np.arange(9.0), [1, 2, 3]), np.ones((9, 3))])
def test_umeyama_names_degenerate_support(source: np.ndarray) -> None:
    with pytest.raises(DegenerateError):
        umeyama(source, source, with_scale=True)


@settings(max_examples=50)
@given(st.floats(0, 6.3), st.integers(0, 1000))
def test_the_upright_box_of_a_turned_box_is_that_box(yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-0.4, 0.4) for z in (-0.2, 0.2)])
    inside = rng.uniform(-1, 1, (60, 3)) * [1.0, 0.4, 0.2]
    turn = rotation_exp(np.array([0.0, 0.0, yaw]))
    box = upright_box(np.concatenate([corners, inside]) @ turn.T + [3, 4, 5])
    assert np.allclose(box.center, [3, 4, 5], atol=1e-6)
    assert np.allclose(box.size, [2.0, 0.8, 0.4], atol=1e-6)
    assert np.allclose(box.rotation[:, 2], [0, 0, 1])
    assert np.linalg.det(box.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("p", [np.zeros((1, 3)), np.zeros((5, 3)), np.outer(np.arange(4.0), [1, 1, 0])])
def test_boxes_of_degenerate_points_hold_them(p: np.ndarray) -> None:
    box = upright_box(p)
    local = (p - box.center) @ box.rotation
    assert np.isfinite(box.size).all()
    assert (np.abs(local) <= box.size / 2 + 1e-9).all()

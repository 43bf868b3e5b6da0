import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from recognition.quadric.eigen import Reading, smallest_eigenvalue

GRADED = np.array([-1e2, -3.0, 1e-3, 40.0])
symmetric = arrays(np.float64, (4, 4), elements=st.floats(-10, 10)).map(lambda a: a + a.T)


def _rotated(values, rng):
    n = len(values)
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    Q = basis @ np.diag(values) @ basis.T
    return 0.5 * (Q + Q.T)


def test_the_two_readings_of_smallest():
    Q = np.diag(GRADED)
    assert smallest_eigenvalue(Q).value == pytest.approx(1e-3, rel=1e-12)
    assert smallest_eigenvalue(Q, Reading.ALGEBRAIC_MINIMUM).value == pytest.approx(-1e2)


def test_graded_spectrum_keeps_ten_digits():
    rng = np.random.default_rng(2)
    batch = np.stack([_rotated(GRADED, rng) for _ in range(500)]).reshape(2, 250, 4, 4)
    found = smallest_eigenvalue(batch)
    assert found.value.shape == (2, 250)
    # eps * |lambda|max / |lambda|min is 2.2e-11; forming the matrices costs as much again
    assert np.abs(found.value / 1e-3 - 1.0).max() < 3e-10
    assert not found.degenerate.any()


def test_a_singular_matrix_is_flagged_and_stands_at_the_floor():
    cylinder = np.diag([1.0 / 9.0, 1.0 / 9.0, 0.0, -1.0])
    rng = np.random.default_rng(4)
    basis, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    turned = basis @ cylinder @ basis.T
    found = smallest_eigenvalue(0.5 * (turned + turned.T))
    assert found.degenerate
    assert found.value == pytest.approx(4 * np.finfo(float).eps, rel=1e-6)


def test_the_algebraic_minimum_of_a_semidefinite_matrix_is_flagged():
    assert smallest_eigenvalue(np.diag([1.0, 2, 3, 0]), Reading.ALGEBRAIC_MINIMUM).degenerate


@settings(max_examples=60)
@given(Q=symmetric, factor=st.floats(0.01, 100))
def test_the_value_scales_with_the_matrix_whatever_its_sign(Q, factor):
    value = smallest_eigenvalue(Q).value
    assert smallest_eigenvalue(-factor * Q).value == pytest.approx(factor * value, abs=1e-11)

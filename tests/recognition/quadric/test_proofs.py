import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from recognition.errors import QuadricError
from recognition.quadric.proofs import (
    SOLVERS,
    column_sums,
    least_quotient,
    precise_smallest,
    ramp_surface,
    sdp_bound,
    substituted,
)
from recognition.quadric.quadric import (
    by_inverse,
    height_field_matrix,
    rotation_xyz,
    scaling,
    translation,
)

CAP = height_field_matrix(a=-4.0, b=-3.0, d=0.5, g=1.0, h=2.0, k=100.0)
SYMMETRIC = arrays(np.float64, (4, 4), elements=st.floats(-10, 10)).map(lambda a: a + a.T)
IDENTITY = np.eye(4)


@pytest.mark.slow
@settings(max_examples=15)
@given(Q=SYMMETRIC)
def test_program_and_descent_find_the_smallest_eigenvalue(Q):
    bound, size = sdp_bound(Q, IDENTITY), max(np.abs(Q).max(), 1e-300)
    assert bound == pytest.approx(np.linalg.eigvalsh(Q)[0], abs=1e-13 * size)
    reached = least_quotient(Q, IDENTITY)
    assert bound - 1e-12 * size <= reached <= bound + 1e-3 * max(size, 1e-3)


@pytest.mark.parametrize(
    ("M_inv", "same"),
    [
        (IDENTITY, True),
        (scaling(0.4), True),
        (np.diag([0.5, -2.0, 3.0, 1.0]), True),
        (rotation_xyz([0.0, 0.0, 0.4]), False),
        (translation([0.5, 0.0, 0.0]), False),
    ],
    ids=["identity", "scale", "diagonal", "rotation", "translation"],
)
def test_column_sums_are_the_product_for_a_diagonal_inverse_alone(M_inv, same):
    assert np.allclose(column_sums(M_inv), M_inv, rtol=1e-12) is same


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_the_substituted_quotient_keeps_its_infimum_and_the_eigenvalue_of_q_prime_moves(seed):
    rng = np.random.default_rng(seed)
    shift = translation(np.append(rng.uniform(0.5, 2.0, 2), 0.0))
    M_inv = scaling(rng.uniform(0.3, 0.8)) @ rotation_xyz(rng.uniform(0, 6, 3)) @ shift
    lowest = np.linalg.eigvalsh(CAP)[0]
    assert sdp_bound(*substituted(CAP, M_inv)) == pytest.approx(lowest, rel=1e-9)
    assert sdp_bound(by_inverse(CAP, M_inv), IDENTITY) != pytest.approx(lowest, rel=0.01)


def test_a_quotient_without_a_definite_denominator_is_refused() -> None:
    sums = column_sums(translation([-1.0, 0.0, 0.0]))
    with pytest.raises(QuadricError, match="no infimum is defined"):
        sdp_bound(CAP, sums @ sums)
    coupled = np.zeros((4, 4))
    coupled[0, 3] = coupled[3, 0] = 1.0
    with pytest.raises(QuadricError, match="no feasible alpha"):
        sdp_bound(coupled, np.diag([1.0, 1.0, 1.0, 1e-300]))


@pytest.mark.parametrize("name", SOLVERS)
def test_each_solver_finds_the_smallest_magnitude_in_double_precision(name):
    axes, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(20, 4, 4)))
    Q = axes * np.array([-1e-3, 2.0, -7.0, 1e2]) @ np.swapaxes(axes, 1, 2)
    Q = 0.5 * (Q + np.swapaxes(Q, 1, 2))
    assert precise_smallest(Q) == pytest.approx(1e-3, rel=1e-10)
    assert SOLVERS[name](Q) == pytest.approx(1e-3, rel=1e-6)


def test_single_precision_spoils_the_polynomial_and_not_the_symmetric_solver() -> None:
    axes, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(50, 4, 4)))
    Q = axes * np.array([-1e-3, 2.0, -7.0, 1e2]) @ np.swapaxes(axes, 1, 2)
    narrow = (0.5 * (Q + np.swapaxes(Q, 1, 2))).astype(np.float32)
    true = precise_smallest(narrow.astype(np.float64))
    off = {name: np.abs(SOLVERS[name](narrow) / true - 1.0) for name in SOLVERS}
    assert np.mean(off["companion matrix"] > 0.08) > 0.3
    assert off["symmetric QR (eigvalsh)"].max() < 0.08


def test_the_form_with_five_coordinates_is_the_fitted_surface() -> None:
    rng = np.random.default_rng(3)
    xy, share = rng.uniform(-1, 1, (40, 2)), rng.uniform(0, 1, 40)
    height = 3 * xy[:, 0] ** 2 - xy[:, 1] * share + 2 * share**2 - share + 5
    v = np.column_stack([xy, height, share, np.ones(40)])
    Q = ramp_surface(xy, share, height)
    assert np.einsum("ni,ij,nj->n", v, Q, v) == pytest.approx(np.zeros(40), abs=1e-9)

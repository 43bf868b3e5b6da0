import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.infimum import approach_infimum, printed, sdp_bound, substituted
from recognition.errors import QuadricError
from recognition.quadric import quadric
from recognition.quadric.quadric import height_field_matrix

CAP = height_field_matrix(a=-4.0, b=-3.0, d=0.5, g=1.0, h=2.0, k=100.0)
symmetric = arrays(np.float64, (4, 4), elements=st.floats(-10, 10)).map(lambda a: a + a.T)
IDENTITY = np.eye(4)


def _inverse(scale=1.0, offset=(0.0, 0.0, 0.0), angle=(0.0, 0.0, 0.0)):
    return np.linalg.inv(
        quadric.compose(
            translate=quadric.translation(offset),
            rotate=quadric.rotation_xyz(angle),
            scale=quadric.scaling(scale),
        )
    )


@settings(derandomize=True, max_examples=40, deadline=None)
@given(Q=symmetric)
def test_the_semidefinite_program_and_descent_find_the_smallest_eigenvalue(Q):
    bound, (reached, _) = sdp_bound(Q, IDENTITY), approach_infimum(Q, IDENTITY)
    size = max(np.abs(Q).max(), 1e-300)
    assert bound == pytest.approx(np.linalg.eigvalsh(Q)[0], abs=1e-13 * size)
    # exact for quadratics; descent may stop early where the infimum lies at infinity
    assert bound - 1e-12 * size <= reached <= bound + 1e-3 * max(size, 1e-3)


def test_an_infimum_at_infinity_is_approached_and_not_attained():
    far = np.diag([-1.0, 1.0, 1.0, 0.0])
    assert sdp_bound(far, IDENTITY) == pytest.approx(-1.0)
    reached, x = approach_infimum(far, IDENTITY)
    assert -1.0 < reached < -0.9999
    assert np.linalg.norm(x) > 50


@pytest.mark.parametrize(
    ("M_inv", "same"),
    [
        (_inverse(), True),
        (_inverse(scale=2.5), True),
        (np.diag([0.5, -2.0, 3.0, 1.0]), True),
        (_inverse(angle=(0, 0, 0.4)), False),
        (_inverse(offset=(0.5, 0, 0)), False),
    ],
    ids=["identity", "scale", "diagonal", "rotation", "translation"],
)
def test_column_sums_are_the_product_where_the_inverse_is_diagonal_alone(M_inv, same):
    found, true = printed(CAP, M_inv), substituted(CAP, M_inv)
    assert all(np.allclose(a, b, rtol=1e-12) for a, b in zip(found, true, strict=True)) is same


@settings(derandomize=True, max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_substituted_quotient_keeps_its_infimum_whatever_the_transformation(seed):
    rng = np.random.default_rng(seed)
    M_inv = _inverse(rng.uniform(0.5, 4), rng.uniform(-2, 2, 3), rng.uniform(0, 6, 3))
    expected = np.linalg.eigvalsh(CAP)[0]
    assert sdp_bound(*substituted(CAP, M_inv)) == pytest.approx(expected, rel=1e-9)
    # as printed it is kept as well, for the same reason and though it is another quotient
    assert sdp_bound(*printed(CAP, M_inv)) == pytest.approx(expected, rel=1e-6)


def test_the_eigenvalue_of_the_transformed_matrix_is_another_infimum():
    ball = np.diag([1 / 4.75**2] * 3 + [-1.0])
    for M_inv, kept in (
        (_inverse(angle=(0.3, 1.0, -0.5)), True),
        (_inverse(offset=(2.0, 2.0, 0.0)), False),
    ):
        found = sdp_bound(quadric.by_inverse(ball, M_inv), IDENTITY)
        assert (abs(found + 1.0) < 1e-9) is kept


def test_a_quotient_without_a_definite_denominator_is_refused():
    with pytest.raises(QuadricError, match="no infimum is defined"):
        sdp_bound(CAP, np.diag([1.0, 1.0, 1.0, 0.0]))
    # a column sum vanishes: D = 1 - 1
    with pytest.raises(QuadricError, match="no infimum is defined"):
        sdp_bound(*printed(CAP, _inverse(offset=(1.0, 0.0, 0.0))))
    coupled = np.zeros((4, 4))
    coupled[0, 3] = coupled[3, 0] = 1.0
    with pytest.raises(QuadricError, match="no feasible alpha"):
        sdp_bound(coupled, np.diag([1.0, 1.0, 1.0, 1e-300]))

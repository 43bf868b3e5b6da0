import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper import infimum
from benchmarks.paper.infimum import Pencil, approach_infimum, sdp_bound
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


@settings(derandomize=True, max_examples=60, deadline=None)
@given(Q=symmetric)
def test_the_semidefinite_program_finds_the_smallest_eigenvalue(Q):
    found = sdp_bound(Pencil(P=Q, N=IDENTITY))
    expected = np.linalg.eigvalsh(Q)[0]
    size = max(np.abs(Q).max(), 1e-300)
    assert found.feasible == pytest.approx(expected, abs=1e-13 * size)
    assert found.infeasible - found.feasible <= 1e-14 * size


@settings(derandomize=True, max_examples=25, deadline=None)
@given(Q=symmetric)
def test_no_point_of_space_is_below_the_bound_and_descent_comes_down_to_it(Q):
    bound = sdp_bound(Pencil(P=Q, N=IDENTITY)).feasible
    size = max(np.abs(Q).max(), 1e-3)
    reached = approach_infimum(Pencil(P=Q, N=IDENTITY))
    assert reached.value >= bound - 1e-12 * size
    # exact for quadratics; descent may stop early where the infimum lies at infinity
    assert reached.value <= bound + 1e-3 * size


def test_an_infimum_at_infinity_is_approached_and_not_attained():
    far = np.diag([-1.0, 1.0, 1.0, 0.0])
    assert sdp_bound(Pencil(P=far, N=IDENTITY)).feasible == pytest.approx(-1.0)
    reached = approach_infimum(Pencil(P=far, N=IDENTITY))
    assert -1.0 < reached.value < -0.9999
    assert np.linalg.norm(reached.x) > 50


def test_the_bound_of_the_form_7_is_the_algebraic_minimum_of_equation_6():
    found = sdp_bound(Pencil(P=CAP, N=IDENTITY))
    assert found.feasible == pytest.approx(np.linalg.eigvalsh(CAP)[0], rel=1e-12)
    assert found.feasible < 0  # a surface with real points
    assert found.n_factorisations < 100


@pytest.mark.parametrize(
    "M_inv",
    [_inverse(), _inverse(scale=2.5), np.diag([0.5, -2.0, 3.0, 1.0])],
    ids=["identity", "scale", "diagonal"],
)
def test_column_sums_are_the_product_where_the_inverse_is_diagonal(M_inv):
    points = np.column_stack([np.random.default_rng(1).normal(size=(20, 3)), np.ones(20)])
    assert infimum.printed_image(M_inv, points) == pytest.approx(infimum.true_image(M_inv, points))
    printed, true = infimum.printed_pencil(CAP, M_inv), infimum.substituted_pencil(CAP, M_inv)
    np.testing.assert_allclose(printed.P, true.P, rtol=1e-12)
    np.testing.assert_allclose(printed.N, true.N, rtol=1e-12)


@pytest.mark.parametrize(
    "M_inv",
    [
        _inverse(angle=(0, 0, 0.4)),
        _inverse(offset=(0.5, 0, 0)),
        _inverse(2.0, (1, 1, 0), (1, 1, 1)),
    ],
    ids=["rotation", "translation", "all"],
)
def test_column_sums_are_not_the_product_under_rotation_and_translation(M_inv):
    points = np.column_stack([np.random.default_rng(1).normal(size=(20, 3)), np.ones(20)])
    difference = infimum.printed_image(M_inv, points) - infimum.true_image(M_inv, points)
    assert np.abs(difference).max() > 0.1


@settings(derandomize=True, max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_substituted_quotient_keeps_its_infimum_whatever_the_transformation(seed):
    rng = np.random.default_rng(seed)
    M_inv = _inverse(rng.uniform(0.5, 4), rng.uniform(-2, 2, 3), rng.uniform(0, 6, 3))
    expected = np.linalg.eigvalsh(CAP)[0]
    found = sdp_bound(infimum.substituted_pencil(CAP, M_inv)).feasible
    assert found == pytest.approx(expected, rel=1e-9)
    # as printed it is kept as well, for the same reason and though it is another quotient
    assert sdp_bound(infimum.printed_pencil(CAP, M_inv)).feasible == pytest.approx(
        expected, rel=1e-6
    )


def test_the_eigenvalue_of_the_transformed_matrix_is_another_infimum():
    turned = _inverse(angle=(0.3, 1.0, -0.5))
    moved = _inverse(offset=(2.0, 2.0, 0.0))
    ball = np.diag([1 / 4.75**2] * 3 + [-1.0])
    for M_inv, kept in ((turned, True), (moved, False)):
        found = sdp_bound(Pencil(P=quadric.by_inverse(ball, M_inv), N=IDENTITY)).feasible
        assert found == pytest.approx(np.linalg.eigvalsh(M_inv.T @ ball @ M_inv)[0], rel=1e-9)
        assert (abs(found + 1.0) < 1e-9) is kept


def test_a_quotient_without_a_definite_denominator_is_refused():
    flat = np.diag([1.0, 1.0, 1.0, 0.0])
    with pytest.raises(QuadricError, match="no infimum is defined"):
        sdp_bound(Pencil(P=CAP, N=flat))
    # a column sum vanishes: D = 1 - 1
    with pytest.raises(QuadricError, match="no infimum is defined"):
        sdp_bound(infimum.printed_pencil(CAP, _inverse(offset=(1.0, 0.0, 0.0))))
    coupled = np.zeros((4, 4))
    coupled[0, 3] = coupled[3, 0] = 1.0
    with pytest.raises(QuadricError, match="no feasible alpha"):
        sdp_bound(Pencil(P=coupled, N=np.diag([1.0, 1.0, 1.0, 1e-300])))

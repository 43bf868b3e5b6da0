import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from recognition.errors import QuadricError
from recognition.quadric.eigen import smallest_eigenvalue
from recognition.quadric.quadric import fit_height_field, height_field_matrix


def _grid(n=7, pitch_m=0.002):
    along = (np.arange(n) - (n - 1) / 2) * pitch_m
    return np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)


def test_fit_recovers_an_exact_height_field():
    x, y = _grid().T / np.sqrt(np.mean(np.sum(_grid() ** 2, axis=1)))
    expected = height_field_matrix(a=-1.5, b=-0.8, d=0.2, g=0.4, h=-0.3, k=100.0)
    z = -1.5 * x**2 - 0.8 * y**2 + 2 * (0.2 * x * y + 0.4 * x - 0.3 * y) + 100.0
    found = fit_height_field(_grid() + np.array([0.003, -0.002]), z)
    assert found == pytest.approx(expected, abs=1e-9)


def test_paraboloid_of_the_paper_has_eigenvalues_of_order_1e_minus_3_and_1e2():
    # peak 100 counts, radius 5 at the base: -4, -4, -0.0025, 100.0025
    Q = height_field_matrix(a=-4.0, b=-4.0, k=100.0)
    assert np.linalg.eigvalsh(Q) == pytest.approx([-4, -4, -0.0025, 100.0025], rel=1e-4)


@settings(max_examples=40)
@given(
    a=st.floats(-8, -1),
    b=st.floats(-8, -1),
    g=st.floats(-5, 5),
    h=st.floats(-5, 5),
    k=st.floats(60, 255),
)
def test_the_feature_is_the_inverse_peak_height(a, b, g, h, k):
    Q = height_field_matrix(a=a, b=b, g=g, h=h, k=k)
    peak = k - g * g / a - h * h / b
    assert smallest_eigenvalue(Q).value == pytest.approx(0.25 / peak, rel=0.15)
    assert np.linalg.det(Q) == pytest.approx(-0.25 * a * b, rel=1e-9)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_fit_does_not_depend_on_the_order_and_follows_motion_in_the_plane(seed):
    rng = np.random.default_rng(seed)
    xy = _grid(n=4) + rng.normal(scale=2e-4, size=(16, 2))
    z = 100.0 - 2e6 * np.sum(xy**2, axis=1) + rng.normal(size=16)
    first = fit_height_field(xy, z)
    order = rng.permutation(16)
    np.testing.assert_allclose(fit_height_field(xy[order], z[order]), first, atol=1e-7)
    turn = rng.uniform(0, 2 * np.pi)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = fit_height_field(3.0 * xy @ R.T + (0.1, -0.2), z)
    same = smallest_eigenvalue(first).value
    assert smallest_eigenvalue(moved).value == pytest.approx(same, rel=1e-6)


@pytest.mark.parametrize(
    ("xy", "message"),
    [
        (np.zeros((6, 2)), "6 points, a height field needs at least 7"),
        (np.ones((9, 2)), "have one position"),
        (_grid()[:14], "14 points do not determine .* two rows"),
        (np.c_[np.arange(9.0), np.arange(9.0)], "condition"),
    ],
)
def test_degenerate_points_are_refused(xy, message):
    with pytest.raises(QuadricError, match=message):
        fit_height_field(xy, np.zeros(len(xy)))

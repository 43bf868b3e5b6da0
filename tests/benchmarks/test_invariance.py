from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from benchmarks.paper.invariants import (
    TRANSFORMATIONS,
    change_over,
    corrected_eigenvalue,
    squared_semi_axes,
)
from benchmarks.paper.spectrum_fifth import (
    at_fifth,
    carry,
    fit_ramp_surface,
    interlacing,
    ramp_matrix,
)
from recognition.errors import QuadricError, TrajectoryError
from recognition.quadric import quadric
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.quadric import height_field_matrix
from recognition.quadric.trajectory import sweep

OVAL = np.diag([1 / 7.0**2, 1 / 7.0**2, 1 / 5.85**2, -1.0])
BOX = np.diag([1 / 5.0**2, 1 / 7.95**2, 1 / 5.0**2, -1.0])
CYLINDER = np.diag([1 / 3.0**2, 1 / 3.0**2, 0.0, -1.0])
BALL = np.diag([1 / 4.75**2] * 3 + [-1.0])
CAP = height_field_matrix(a=-7.0, b=-5.0, k=150.0)
LOWEST = Reading.ALGEBRAIC_MINIMUM


@pytest.mark.parametrize("reading", list(Reading))
@pytest.mark.parametrize("Q", [OVAL, BOX, CAP], ids=["oval", "box", "cap"])
def test_rotation_about_the_origin_keeps_it(Q, reading):
    found = change_over(Q, TRANSFORMATIONS["rotation"], reading)
    assert found.n == 17**3
    assert found.relative < 1e-9


def test_translation_does_not_keep_it_in_general():
    assert change_over(BOX, TRANSFORMATIONS["translation"]).relative > 0.05
    assert change_over(BALL, TRANSFORMATIONS["translation"], LOWEST).relative > 0.1
    # but does where the smallest curvature is double, and nearly does for a high cap
    assert change_over(OVAL, TRANSFORMATIONS["translation"]).relative < 1e-12
    assert change_over(CAP, TRANSFORMATIONS["translation"]).relative < 1e-3


def test_scale_divides_it_by_its_square():
    for Q in (OVAL, BOX, BALL):
        assert change_over(Q, TRANSFORMATIONS["scale"]).factor == pytest.approx(16.0)
    assert change_over(BALL, TRANSFORMATIONS["scale"], LOWEST).relative < 1e-12
    assert change_over(CAP, TRANSFORMATIONS["scale"]).factor == pytest.approx(16.0, rel=0.05)


def test_all_loops_are_the_sweep():
    grid = TRANSFORMATIONS["all three loops"]
    found = change_over(BOX, grid)
    least, greatest = sweep(BOX[None], grid).spread[0]
    assert (found.least, found.greatest) == pytest.approx((least, greatest), rel=1e-10)
    assert found.n == grid.n_evaluations


def test_what_has_no_level_is_refused():
    for Q in (np.diag([1.0, 1.0, 0.0, -1.0]), np.eye(5)):
        with pytest.raises(TrajectoryError, match="without a level"):
            change_over(Q, replace(TRANSFORMATIONS["scale"]))


# --- the fifth coordinate --------------------------------------------------------------------

RAMP = ramp_matrix(a=-4.0, b=-3.0, d=0.5, g=0.4, h=-0.2, k=-60.0, w1=0.1, w2=-0.3, w4=80.0, w5=10.0)


def _heights(Q, xy, w):
    return np.array(
        [[np.array([x, y, 0, f, 1]) @ Q @ np.array([x, y, 0, f, 1]) for x, y in xy] for f in w]
    )


def test_the_ramp_surface_is_recovered():
    xy = np.random.default_rng(1).uniform(-1, 1, (12, 2))
    w = np.linspace(0.2, 1.0, 6)
    assert fit_ramp_surface(xy, w, _heights(RAMP, xy, w)) == pytest.approx(RAMP, abs=1e-9)


def test_at_one_force_it_is_the_form_7():
    expected = height_field_matrix(
        a=-4.0, b=-3.0, d=0.5, g=0.1 + 0.5 * 0.4, h=-0.3 - 0.5 * 0.2, k=10 + 80.0 - 15.0
    )
    assert at_fifth(RAMP, 0.5) == pytest.approx(expected)


def test_spectra_of_the_form_and_its_block_interlace():
    rng = np.random.default_rng(2)
    batch = rng.normal(size=(500, 5, 5))
    batch = batch + np.swapaxes(batch, -1, -2)
    assert interlacing(batch).shape == (500, 8)
    assert interlacing(batch).min() > -1e-12
    assert interlacing(RAMP).min() > -1e-11
    # in particular lambda_5 in the algebraic reading is never above that of the 4x4
    outer = smallest_eigenvalue(batch, LOWEST).value
    assert np.all(outer <= smallest_eigenvalue(batch[:, :4, :4], LOWEST).value + 1e-12)


def test_poses_leave_the_fifth_coordinate_and_rotation_keeps_the_spectrum():
    M = quadric.rotation_xyz([0.3, 1.0, 2.0])
    inverse = np.linalg.inv(carry(M))
    turned = inverse.T @ RAMP @ inverse
    assert np.linalg.eigvalsh(turned) == pytest.approx(np.linalg.eigvalsh(RAMP), abs=1e-10)
    pushed = quadric.translation([[1.0, -2.0, 0.5]])
    inverse = np.linalg.inv(carry(pushed))[0]
    at_once = quadric.congruence(at_fifth(RAMP, 0.7), pushed[0])
    assert at_fifth(inverse.T @ RAMP @ inverse, 0.7) == pytest.approx(at_once)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_ramp_surface(np.ones((4, 2)), np.ones(3), np.ones((4, 3))), "do not fit"),
        (lambda: fit_ramp_surface(np.ones((4, 2)), np.ones(3), np.full((3, 4), np.nan)), "finite"),
        (
            lambda: fit_ramp_surface(np.ones((9, 2)), np.ones(3), np.ones((3, 9))),
            "do not determine",
        ),
        (lambda: at_fifth(np.eye(4), 0.5), r"expected \(..., 5, 5\)"),
    ],
)
def test_refusals_name_the_cause(call, message):
    with pytest.raises(QuadricError, match=message):
        call()


def test_size_survives_motion_and_a_factor():
    rng = np.random.default_rng(9)
    M = quadric.translation(rng.uniform(-5, 5, 3)) @ quadric.rotation_xyz(rng.uniform(0, 6, 3))
    axes = np.sqrt(squared_semi_axes(-3.0 * quadric.congruence(OVAL, M)))
    assert np.sort(axes) == pytest.approx([5.85, 7.0, 7.0], rel=1e-9)
    with pytest.raises(QuadricError, match="no single centre"):
        squared_semi_axes(CYLINDER)


@settings(derandomize=True, max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), reading=st.sampled_from(list(Reading)))
def test_the_corrected_feature_is_invariant_where_the_plain_one_is_not(seed, reading):
    rng = np.random.default_rng(seed)
    pose = quadric.compose(
        translate=quadric.translation(rng.uniform(-5, 5, 3)),
        rotate=quadric.rotation_xyz(rng.uniform(0, 2 * np.pi, 3)),
        scale=quadric.scaling(rng.uniform(0.3, 3.0)),
    )
    moved = rng.uniform(0.1, 10) * quadric.congruence(BOX, pose)
    at_rest = corrected_eigenvalue(BOX, reading).value
    assert corrected_eigenvalue(moved, reading).value == pytest.approx(at_rest, rel=1e-7)


def test_cylinders_and_cones_have_no_corrected_feature():
    with pytest.raises(QuadricError, match="no single centre"):
        corrected_eigenvalue(CYLINDER)
    with pytest.raises(QuadricError, match="cone"):
        corrected_eigenvalue(np.diag([1.0, 1.0, -1.0, 0.0]))
    with pytest.raises(QuadricError, match="4, 4"):
        corrected_eigenvalue(np.eye(5))

"""The paper's quadric: contact, motions, eigenvalues, height fields, sweeps, thresholds."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from recognition.errors import ContactError, QuadricError, TrajectoryError, TransformError
from recognition.quadric import quadric
from recognition.quadric.level import main_patch
from recognition.quadric.quadric import (
    PAPER_SWEEP,
    Reading,
    SweepSettings,
    check_level,
    find_thresholds,
    fit_height_field,
    height_field_matrix,
    smallest_eigenvalue,
    sweep,
    with_noise,
)
from tests.values import make_pads

PADS = make_pads(shapes=((16, 4), (16, 4)), adc_max=255, pitch_m=4e-3)


def heights(*loaded):
    """Heights of all taxels: counts by pad, row and column, 0 elsewhere."""
    grid = np.zeros((2, 16, 4))
    for pad, row, column, counts in loaded:
        grid[pad, row, column] = counts
    return grid.ravel()


def test_the_most_loaded_patch_joins_over_corners():
    touching_over_a_corner = ((1, 2, 1, 50.0), (1, 3, 2, 60.0))
    height = heights(*touching_over_a_corner, (1, 10, 0, 20.0), (1, 11, 0, 20.0), (0, 5, 1, 255.0))
    assert main_patch(height, PADS, 1, 2.0).tolist() == [64 + 9, 64 + 14]
    assert main_patch(height, PADS, 0, 2.0).tolist() == [5 * 4 + 1]


def test_the_rim_takes_unloaded_neighbours_along_and_leaves_other_patches():
    height = heights((0, 5, 1, 80.0), (0, 7, 1, 30.0))  # two rows apart: two patches
    patch = main_patch(height, PADS, 0, 2.0, rim=1)
    assert len(patch) == 9
    assert sorted(height[patch])[-2:] == [0.0, 80.0]
    assert 7 * 4 + 1 not in main_patch(height, PADS, 0, 2.0, rim=2)
    assert len(main_patch(heights((0, 0, 0, 9.0)), PADS, 0, 2.0, rim=1)) == 4


def test_an_untouched_pad_is_refused_with_its_largest_height():
    message = "it is not touched: largest height 1 counts, threshold 2"
    with pytest.raises(ContactError, match=message):
        main_patch(heights((0, 3, 3, 1.0), (1, 3, 3, 9.0)), PADS, 0, 2.0)


# -- Motions of a quadric --------------------------------------------------------------------------


numbers = st.floats(-3.0, 3.0)


def _point(x, y, z):
    return np.array([x, y, z, 1.0])


def test_each_rotation_turns_right_handed():
    quarter = np.pi / 2
    assert quadric.rotation_xyz([quarter, 0, 0]) @ _point(0, 1, 0) == pytest.approx(_point(0, 0, 1))
    assert quadric.rotation_xyz([0, quarter, 0]) @ _point(0, 0, 1) == pytest.approx(_point(1, 0, 0))
    assert quadric.rotation_xyz([0, 0, quarter]) @ _point(1, 0, 0) == pytest.approx(_point(0, 1, 0))


@settings(max_examples=50)
@given(
    values=arrays(np.float64, (4, 4), elements=numbers),
    offset=arrays(np.float64, 3, elements=numbers),
    angle=arrays(np.float64, 3, elements=numbers),
    scale=st.floats(0.25, 4.0),
    point=arrays(np.float64, 3, elements=numbers),
)
def test_congruence_keeps_the_value_at_the_moved_point(values, offset, angle, scale, point):
    Q = values + values.T
    M = quadric.translation(offset) @ quadric.rotation_xyz(angle) @ quadric.scaling(scale)
    P = np.append(point, 1.0)
    moved = quadric.by_inverse(Q, np.linalg.inv(M))
    assert np.array_equal(moved, moved.T)
    assert (M @ P) @ moved @ (M @ P) == pytest.approx(P @ Q @ P, abs=1e-8)
    assert quadric.by_inverse(moved, M) == pytest.approx(Q, abs=1e-8)


# -- Eigenvalues -----------------------------------------------------------------------------------


GRADED = np.array([-1e2, -3.0, 1e-3, 40.0])


def test_the_two_readings_of_smallest():
    Q = np.diag(GRADED)
    assert smallest_eigenvalue(Q).value == pytest.approx(1e-3, rel=1e-12)
    assert smallest_eigenvalue(Q, Reading.ALGEBRAIC_MINIMUM).value == pytest.approx(-1e2)


def test_graded_spectrum_keeps_ten_digits():
    basis, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(2, 250, 4, 4)))
    batch = basis * GRADED @ basis.mT
    batch = 0.5 * (batch + batch.mT)
    smallest = smallest_eigenvalue(batch)
    assert smallest.value.shape == (2, 250)
    # eps * |lambda|max / |lambda|min is 2.2e-11; forming the matrices costs as much again
    assert np.abs(smallest.value / 1e-3 - 1.0).max() < 3e-10
    assert not smallest.degenerate.any()


def test_a_singular_matrix_is_flagged_and_stands_at_the_floor():
    cylinder = np.diag([1.0 / 9.0, 1.0 / 9.0, 0.0, -1.0])
    basis, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(4, 4)))
    turned = basis @ cylinder @ basis.T
    smallest = smallest_eigenvalue(0.5 * (turned + turned.T))
    assert smallest.degenerate
    assert smallest.value == pytest.approx(4 * np.finfo(float).eps, rel=1e-6)


# -- Height fields ---------------------------------------------------------------------------------


def _grid(n=7, pitch_m=0.002):
    along = (np.arange(n) - (n - 1) / 2) * pitch_m
    return np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)


def test_fit_recovers_an_exact_height_field():
    x, y = _grid().T / np.sqrt(np.mean(np.sum(_grid() ** 2, axis=1)))
    expected = height_field_matrix(a=-1.5, b=-0.8, d=0.2, g=0.4, h=-0.3, k=100.0)
    z = -1.5 * x**2 - 0.8 * y**2 + 2 * (0.2 * x * y + 0.4 * x - 0.3 * y) + 100.0
    fit = fit_height_field(_grid() + np.array([0.003, -0.002]), z)
    assert fit == pytest.approx(expected, abs=1e-9)


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
    assert not height_field_matrix(a=a, b=b, k=k)[[0, 0, 1], [1, 3, 3]].any()
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
        (np.ones((9, 2)), "lie at one place"),
        (_grid()[:14], "14 points do not determine .* two rows"),
        (np.c_[np.arange(9.0), np.arange(9.0)], "condition"),
    ],
)
def test_degenerate_points_are_refused(xy, message):
    with pytest.raises(QuadricError, match=message):
        fit_height_field(xy, np.zeros(len(xy)))


# -- Sweeps ----------------------------------------------------------------------------------------


# the paper's objects as full quadrics in mm, k = -1
PAPER_OBJECTS = np.array(
    [
        np.diag([1 / 7.0**2, 1 / 7.0**2, 1 / 5.85**2, -1.0]),
        np.diag([1 / 3.0**2, 1 / 3.0**2, 0.0, -1.0]),
        np.diag([1 / 5.0**2, 1 / 7.95**2, 1 / 5.0**2, -1.0]),
        np.diag([1 / 4.75**2, 1 / 4.75**2, 1 / 4.75**2, -1.0]),
        np.diag([1 / 5.0**2, 1 / 5.0**2, -1 / 6.5**2, -1.0]),
    ]
)


def _plain_loops(Q, grid, reading):
    """Algorithm 1's training loops as printed, one matrix at a time."""
    values = []
    for scale, shift, angle in itertools.product(grid.scale, grid.translation, grid.angle_rad):
        M = (
            quadric.translation([shift, shift, 0.0])
            @ quadric.rotation_xyz([0.0, 0.0, angle])
            @ quadric.rotation_xyz([0.0, angle, 0.0])
            @ quadric.rotation_xyz([angle, 0.0, 0.0])
            @ quadric.scaling(scale)
        )
        inverse = np.linalg.inv(M)
        eigenvalues = np.linalg.eigvalsh(inverse.T @ Q @ inverse)
        smallest = reading is Reading.SMALLEST_MAGNITUDE
        values.append(np.abs(eigenvalues).min() if smallest else eigenvalues[0])
    return np.array(values)


def test_the_printed_grid_has_21607_points_an_object():
    assert sweep(PAPER_OBJECTS[:1]).shape == (1, 21_607)
    assert PAPER_SWEEP.scale == pytest.approx(np.arange(31) * 0.1 + 1)
    assert PAPER_SWEEP.translation == pytest.approx(np.arange(41) * 0.1 - 2)
    assert PAPER_SWEEP.angle_rad == pytest.approx(np.arange(17) * np.pi / 8)


@pytest.mark.parametrize("reading", [Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM])
def test_the_sweep_is_the_printed_loops(reading):
    grid = SweepSettings(
        scale=np.array([1.0, 1.7, 4.0]),
        translation=np.linspace(-2, 2, 5),
        angle_rad=np.linspace(0, 2 * np.pi, 9),
        reading=reading,
    )
    surfaces = sweep(PAPER_OBJECTS[[0, 2, 4]], grid)
    for index, Q in enumerate(PAPER_OBJECTS[[0, 2, 4]]):
        assert surfaces[index] == pytest.approx(_plain_loops(Q, grid, reading), rel=1e-9)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: quadric.scaling([1.0, 0.0]), TransformError, "scale factor is 0"),
        (lambda: sweep(np.eye(4)), TrajectoryError, r"shape \(4, 4\)"),
        (lambda: sweep(np.zeros((2, 5, 5))), TrajectoryError, "expected"),
        (lambda: SweepSettings(scale=np.array([])), TrajectoryError, "scale must be"),
        (lambda: SweepSettings(angle_rad=np.array([np.inf])), TrajectoryError, "angle_rad"),
    ],
)
def test_refusals_name_the_cause(call, error, message):
    with pytest.raises(error, match=message):
        call()


# --- thresholds -----------------------------------------------------------------------------


def test_thresholds_are_the_middles_between_neighbouring_bands():
    levels = find_thresholds([[5.0, 6.0], [1.0, 2.0], [8.0, 9.0]])
    assert levels.order.tolist() == [1, 0, 2]
    assert levels.threshold == pytest.approx([3.5, 7.0])
    assert levels.window == pytest.approx([3.0, 2.0])
    # inside the bands, on either side of the threshold 7, beyond the reach of every band
    expected = {1.5: 1, 5.5: 0, 8.5: 2, 6.4: 0, 7.5: 2, 7.0: None, 3.5: None, 2.1: 1, 11.0: None}
    assert {value: check_level(levels, value) for value in expected} == expected


def test_an_object_without_a_level_is_never_named():
    levels = find_thresholds([[np.nan], [1.0, 2.0], []])
    assert levels.order.tolist() == [1]
    assert check_level(levels, 1.5) == 1
    assert check_level(levels, 100.0) is None
    with pytest.raises(TrajectoryError, match="no object of 2"):
        find_thresholds([[np.nan], []])


@settings(max_examples=80)
@given(
    bands=st.lists(st.lists(st.floats(0.1, 100), min_size=1, max_size=4), min_size=1, max_size=5),
    value=st.floats(0.01, 200),
)
def test_a_named_value_lies_in_reach_and_in_no_second_band(bands, value):
    levels = find_thresholds(bands)
    named = check_level(levels, value)
    inside = [i for i, band in enumerate(bands) if min(band) <= value <= max(band)]
    if len(inside) == 1:
        assert named == inside[0]
    elif len(inside) > 1:
        assert named is None
    elif named is not None:
        wide = with_noise(levels, levels.margin)
        low, high = wide.low, wide.high
        assert low[named] <= value <= high[named]
        assert levels.distance(value)[named] == np.min(levels.distance(value))


def test_windows_narrow_with_the_noise_seen_until_they_close():
    levels = find_thresholds([[1.0, 1.1], [1.3, 1.4], [3.0, 3.3]])
    assert with_noise(levels, 0.0).window == pytest.approx(levels.window)
    a_little = with_noise(levels, 0.05)
    assert a_little.window == pytest.approx([1.3 * 0.95 - 1.1 * 1.05, 3.0 * 0.95 - 1.4 * 1.05])
    assert check_level(a_little, 1.14) == 0
    much = with_noise(levels, 0.2)
    assert (much.window <= 0.0).tolist() == [True, False]
    # a value that both may have caused names none, the other object is still named
    assert [check_level(levels, value) for value in (1.15, 3.1)] == [0, 2]
    assert [check_level(much, value) for value in (1.15, 3.1)] == [None, 2]
    with pytest.raises(TrajectoryError, match="noise_share is 1"):
        with_noise(levels, 1.0)

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from recognition.errors import TrajectoryError
from recognition.quadric import quadric
from recognition.quadric.eigen import Reading
from recognition.quadric.quadric import height_field_matrix
from recognition.quadric.thresholds import check_level, find_thresholds, with_noise
from recognition.quadric.trajectory import PAPER_SWEEP, SweepSettings, sweep

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
CAPS = np.array([height_field_matrix(a=-4.0, b=-4.0, k=peak) for peak in (50.0, 100.0, 200.0)])


def _plain_loops(Q, grid, reading):
    """Algorithm 1's training loops as printed, one matrix at a time."""
    values = []
    for scale in grid.scale:
        for shift in grid.translation:
            for angle in grid.angle_rad:
                M = (
                    quadric.translation([shift, shift, 0.0])
                    @ quadric.rotation_xyz([0.0, 0.0, angle])
                    @ quadric.rotation_xyz([0.0, angle, 0.0])
                    @ quadric.rotation_xyz([angle, 0.0, 0.0])
                    @ quadric.scaling(scale)
                )
                inverse = np.linalg.inv(M)
                eigenvalues = np.linalg.eigvalsh(inverse.T @ Q @ inverse)
                values.append(
                    np.abs(eigenvalues).min()
                    if reading is Reading.SMALLEST_MAGNITUDE
                    else eigenvalues[0]
                )
    return np.array(values)


def test_the_printed_grid_has_21607_points_an_object():
    assert PAPER_SWEEP.n_evaluations == 21_607
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
    found = sweep(PAPER_OBJECTS[[0, 2, 4]], grid)
    for index, Q in enumerate(PAPER_OBJECTS[[0, 2, 4]]):
        assert found.value[index] == pytest.approx(_plain_loops(Q, grid, reading), rel=1e-9)


def test_full_quadrics_are_not_invariant_over_the_printed_grid():
    magnitude = sweep(PAPER_OBJECTS)
    expected = [(1.3e-3, 2.0e-2), None, (9.9e-4, 1.8e-2), (2.8e-3, 4.4e-2), (1.5e-3, 2.4e-2)]
    for index, band in enumerate(expected):
        if band is not None:
            assert magnitude.spread[index] == pytest.approx(band, rel=0.05)
    lowest = sweep(PAPER_OBJECTS, SweepSettings(reading=Reading.ALGEBRAIC_MINIMUM))
    expected_lowest = [-0.776, -0.333, -0.698, -0.668, -0.697]
    assert lowest.spread[:, 1] == pytest.approx(expected_lowest, abs=2e-3)
    assert lowest.spread[:, 0] == pytest.approx([-1, -1, -1, -1, -1.182], abs=1e-3)
    levels = find_thresholds([magnitude.value[i] for i in (0, 2, 3, 4)])
    assert len(levels.closed) == 3  # no two neighbours can be told apart


def test_scale_alone_moves_the_smallest_eigenvalue_by_sixteen():
    still = SweepSettings(translation=np.zeros(1), angle_rad=np.zeros(1))
    value = sweep(PAPER_OBJECTS[3:4], still).value[0]
    assert value == pytest.approx(value[0] / still.scale**2, rel=1e-9)
    assert value[0] / value[-1] == pytest.approx(16.0)
    caps = sweep(CAPS, still).value
    assert caps[:, 0] / caps[:, -1] == pytest.approx([16.0] * 3, rel=0.05)


def test_caps_in_counts_hardly_feel_translation_and_rotation():
    def relative_range(**grid):
        value = sweep(CAPS, SweepSettings(scale=np.ones(1), **grid)).value
        return np.ptp(value, axis=1) / value[:, len(value[0]) // 2]

    assert np.all(relative_range(angle_rad=np.zeros(1)) < 1e-3)
    both = relative_range()
    assert both == pytest.approx([0.12, 0.06, 0.03], rel=0.4)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: sweep(np.eye(4)), TrajectoryError, r"shape \(4, 4\)"),
        (lambda: sweep(np.zeros((2, 5, 5))), TrajectoryError, "expected"),
        (lambda: SweepSettings(scale=np.array([])), TrajectoryError, "scale must be"),
        (lambda: SweepSettings(angle_rad=np.array([np.inf])), TrajectoryError, "angle_rad"),
    ],
)
def test_refusals_name_the_cause(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_trajectory_is_read_only():
    found = sweep(CAPS, SweepSettings(scale=np.ones(1), translation=np.zeros(1)))
    with pytest.raises(ValueError, match="read-only"):
        found.value[0, 0] = 1.0


# --- thresholds -----------------------------------------------------------------------------


def test_thresholds_are_the_middles_between_neighbouring_bands():
    levels = find_thresholds([[5.0, 6.0], [1.0, 2.0], [8.0, 9.0]], margin=0.2)
    assert levels.order.tolist() == [1, 0, 2]
    assert levels.threshold == pytest.approx([3.5, 7.0])
    assert levels.window == pytest.approx([3.0, 2.0])
    assert levels.closed == ()
    # inside the bands, on either side of the threshold 7, beyond the reach of every band
    expected = {1.5: 1, 5.5: 0, 8.5: 2, 6.9: 0, 7.1: 2, 7.0: None, 3.5: None, 2.3: 1, 11.0: None}
    assert {value: check_level(levels, value) for value in expected} == expected


def test_nothing_is_told_in_a_closed_window():
    levels = find_thresholds([[1.0, 4.0], [3.0, 6.0]])
    assert levels.window == pytest.approx([-1.0])
    assert levels.closed == ((0, 1),)
    assert [check_level(levels, value) for value in (2.0, 3.5, 5.0)] == [0, None, 1]


def test_an_object_without_a_level_is_never_named():
    levels = find_thresholds([[np.nan], [1.0, 2.0], []])
    assert levels.order.tolist() == [1]
    assert check_level(levels, 1.5) == 1
    assert check_level(levels, 100.0) is None
    with pytest.raises(TrajectoryError, match="no object of 2"):
        find_thresholds([[np.nan], []])
    with pytest.raises(TrajectoryError, match="margin is 1"):
        find_thresholds([[1.0]], margin=1.0)


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
        low, high = levels.reach()
        assert low[named] <= value <= high[named]
        assert levels.distance(value)[named] == np.min(levels.distance(value))


def test_windows_narrow_with_the_noise_seen_until_they_close():
    levels = find_thresholds([[1.0, 1.1], [1.3, 1.4], [3.0, 3.3]])
    assert with_noise(levels, 0.0).window == pytest.approx(levels.window)
    a_little = with_noise(levels, 0.05)
    assert a_little.window == pytest.approx([1.3 * 0.95 - 1.1 * 1.05, 3.0 * 0.95 - 1.4 * 1.05])
    assert a_little.closed == ()
    assert check_level(a_little, 1.14) == 0
    much = with_noise(levels, 0.2)
    assert much.closed == ((0, 1),)
    # a value that both may have caused names none, the other object is still named
    assert [check_level(levels, value) for value in (1.15, 3.1)] == [0, 2]
    assert [check_level(much, value) for value in (1.15, 3.1)] == [None, 2]
    with pytest.raises(TrajectoryError, match="noise_share is 1"):
        with_noise(levels, 1.0)

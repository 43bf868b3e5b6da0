"""Counts to forces: the paper's figures, inverses, behaviour at both ends."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tactile.errors import CalibrationError
from tactile.sensor.calibration import FoamCalibration, LinearCalibration, TableCalibration


def test_equation_11_gives_the_papers_curve_from_zero_to_full_scale() -> None:
    counts = FoamCalibration(255).counts(np.array([0.0, 2.0, 4.0, 6.0, 8.0, 100.0]))
    # Resistances of the paper's sensor in MOhm: the first term of its equation alone.
    resistance = np.array([1.579, 0.643, 0.262, 0.107, 0.0435, 0.0])
    np.testing.assert_allclose(counts, 255 * (1 - resistance / 1.579), rtol=2e-3)


@settings(max_examples=50)
@given(force_n=st.floats(-0.5, 9.0), gain=st.floats(0.5, 2.0), adc_max=st.sampled_from([255, 4095]))
def test_counts_round_trip(force_n: float, gain: float, adc_max: int) -> None:
    calibration = FoamCalibration(adc_max, gain=gain)
    counts = calibration.counts(np.array([force_n]))
    if counts[0] <= adc_max - 0.5:
        assert calibration.force_n(counts)[0] == pytest.approx(force_n, abs=1e-9)


def test_law_is_smooth_and_rising_through_zero() -> None:
    force_n = FoamCalibration(255).force_n(np.arange(-20.0, 255.0))
    steps = np.diff(force_n)
    assert np.all(steps > 0)
    assert steps[19] == pytest.approx(steps[20], rel=0.01)
    assert force_n[20] == 0.0


def test_full_scale_gives_the_smallest_force_that_saturates() -> None:
    calibration = FoamCalibration(255)
    force_n = calibration.force_n(np.array([254.5, 255.0, 400.0]))
    np.testing.assert_allclose(force_n, calibration.force_max_n)
    assert calibration.force_max_n == pytest.approx(13.88, abs=0.01)
    assert np.rint(calibration.counts(np.array([calibration.force_max_n + 0.01])))[0] == 255


def test_linear_calibration() -> None:
    calibration = LinearCalibration(0.002, 4095)
    np.testing.assert_allclose(calibration.force_n(np.array([-10.0, 0.0, 500.0])), [-0.02, 0, 1.0])
    np.testing.assert_allclose(calibration.counts(np.array([1.0])), [500.0])


@pytest.mark.parametrize("gain", [0.0, -1.0, float("nan"), [1.0, float("inf")]])
def test_impossible_gains_are_refused(gain: object) -> None:
    with pytest.raises(CalibrationError, match="gains"):
        FoamCalibration(255, gain=gain)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="gains"):
        LinearCalibration(gain, 255)  # type: ignore[arg-type]


def test_impossible_full_scale_is_refused() -> None:
    with pytest.raises(CalibrationError, match="adc_max is 0"):
        FoamCalibration(0)
    with pytest.raises(CalibrationError, match="adc_max is 0"):
        LinearCalibration(1.0, 0)


def test_a_table_goes_straight_from_node_to_node_and_on_beyond_them() -> None:
    law = TableCalibration((10.0, 30.0), (0.1, 0.7), 255, np.array([1.0, 2.0]))
    assert law.force_n(np.array([5.0, 5.0])) == pytest.approx([0.05, 0.1])
    assert law.force_n(np.array([20.0, 40.0])) == pytest.approx([0.4, 2.0])
    assert law.force_n(np.array([-5.0, 0.0])) == pytest.approx([-0.05, 0.0])
    counts = np.array([-3.0, 25.0])
    assert law.counts(law.force_n(counts)) == pytest.approx(counts)


@pytest.mark.parametrize(
    "nodes", [((), ()), ((5.0, 3.0), (1.0, 2.0)), ((3.0, 5.0), (1.0, 1.0)), ((0.0,), (1.0,))]
)
def test_a_table_that_does_not_rise_is_refused(nodes: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(CalibrationError, match="rise from above 0"):
        TableCalibration(*nodes, 255)  # type: ignore[arg-type]

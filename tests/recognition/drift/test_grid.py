"""The grid of drifts: its prior, and what grasps of taught and of new objects show."""

import numpy as np
import pytest

from recognition.drift.grid import DriftGrid, DriftPrior


@pytest.mark.parametrize(
    "values",
    [
        {"log_gain_sd": 0.0},
        {"offset_sd_mm": -1.0},
        {"offset_mm": 60.0},
        {"log_gain": float("nan")},
        {"unchanged": 1.5},
    ],
)
def test_a_prior_out_of_range_is_refused(values):
    with pytest.raises(ValueError, match="must be"):
        DriftPrior(**values)


def evidence(grid, log_gain, offset_mm, sd=(0.1, 0.5)):
    """Return a Gaussian log likelihood over the hypotheses."""
    gain = -0.5 * ((grid.log_gains - log_gain) / sd[0]) ** 2
    offset = -0.5 * ((grid.offsets_mm - offset_mm) / sd[1]) ** 2
    return gain[:, None] + offset


def test_without_grasps_half_the_weight_is_on_no_drift():
    grid = DriftGrid()
    assert grid.weight.sum() == pytest.approx(1.0)
    assert grid.unchanged == pytest.approx(0.5, abs=0.02)
    assert np.exp(grid.log_weight(0.99)).max() == pytest.approx(0.99, abs=0.01)
    assert grid.drift.gain == pytest.approx(1.0)
    assert not grid.likely


def test_a_narrow_prior_has_few_hypotheses_about_its_mean():
    prior = DriftPrior(
        log_gain=-0.2, log_gain_sd=0.05, offset_mm=-4.3, offset_sd_mm=0.3, unchanged=0.0
    )
    grid = DriftGrid(prior=prior)
    assert grid.weight.size < DriftGrid().weight.size / 3
    assert grid.drift.aperture_offset_m == pytest.approx(-4.3e-3, abs=1e-4)
    assert grid.drift.gain == pytest.approx(np.exp(-0.2), rel=0.02)
    assert grid.offset_sd_m == pytest.approx(0.3e-3, rel=0.2)
    assert grid.unchanged < 1e-6


def test_a_gauge_counts_less_than_its_grasps_by_how_objects_are_placed():
    grid = DriftGrid()
    found = evidence(grid, np.log(0.7), -4.0, (0.02, 0.2))
    sharp, blurred = grid.with_gauge(found, 0.1), grid.with_gauge(found, 2.0)
    assert sharp.drift.aperture_offset_m == pytest.approx(-4e-3, abs=0.3e-3)
    assert blurred.offset_sd_m > 2.0 * sharp.offset_sd_m
    assert blurred.with_gauge(found, 2.0).offset_sd_m < blurred.offset_sd_m


def test_unnamed_grasps_show_a_drift_together_and_are_forgotten_in_time():
    grid = DriftGrid()
    for _ in range(20):
        grid = grid.with_unnamed(evidence(grid, np.log(0.7), -4.0, (0.3, 2.0)))
    assert grid.likely
    assert grid.drift.aperture_offset_m == pytest.approx(-4e-3, abs=0.5e-3)
    for _ in range(80):
        grid = grid.with_unnamed(evidence(grid, 0.0, 0.0, (0.3, 2.0)))
    assert abs(grid.drift.aperture_offset_m) < 1e-3
    assert grid.without_unnamed().weight == pytest.approx(DriftGrid().weight)


def test_it_comes_back_from_arrays_without_what_was_followed():
    grid = DriftGrid().with_gauge(evidence(DriftGrid(), -0.3, 2.0), 0.5)
    again = DriftGrid.from_arrays(grid.with_unnamed(evidence(grid, 0.3, -2.0)).to_arrays())
    assert np.array_equal(again.weight, grid.weight)
    assert again.values == grid.values
    broken = {**grid.to_arrays(), "drift_gauged": np.zeros((3, 4))}
    with pytest.raises(ValueError, match="shape"):
        DriftGrid.from_arrays(broken)

"""The grid of drifts: its prior, and what grasps of taught and of new objects show."""

import pytest

from recognition.drift.grid import DriftPrior


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

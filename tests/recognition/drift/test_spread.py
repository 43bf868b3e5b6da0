"""The spread between days is learnt from what all objects of a day have in common."""

import numpy as np
import pytest

from recognition.drift.drift import Drift
from recognition.drift.grid import DriftPrior
from recognition.drift.spread import learn_spread
from recognition.grasp import Grasp
from recognition.ramp.ramp import learn_rest
from tests.cell.archive.fleet import SIZES_MM, ramp


def days(log_gain_sd: float, offset_sd_mm: float, n_days: int) -> tuple[list[Grasp], list[str]]:
    rng = np.random.default_rng(7)
    grasps, groups = [], []
    for day in range(n_days):
        gain = float(np.exp(log_gain_sd * rng.standard_normal()))
        offset_m = 1e-3 * offset_sd_mm * rng.standard_normal()
        drift = Drift(gains=(gain, gain), aperture_offset_m=offset_m)
        grasps += [drift.apply(ramp(label, rng)) for label in SIZES_MM for _ in range(4)]
        groups += [str(day)] * (4 * len(SIZES_MM))
    return grasps, groups


def test_the_spread_that_was_made_is_found() -> None:
    grasps, groups = days(0.15, 1.5, 30)
    prior = learn_spread(grasps, groups, learn_rest(grasps))
    assert prior.log_gain_sd == pytest.approx(0.15, rel=0.35)
    assert prior.offset_sd_mm == pytest.approx(1.5, rel=0.35)
    assert prior.unchanged == 0.0


def test_few_days_leave_most_to_the_usual_spread_and_one_day_shows_none() -> None:
    grasps, groups = days(0.0, 0.0, 2)
    rest = learn_rest(grasps)
    prior = learn_spread(grasps, groups, rest)
    assert 1.0 < prior.offset_sd_mm < DriftPrior().offset_sd_mm
    assert learn_spread(grasps, ["0"] * len(grasps), rest) is None
    others = [f"{group} {grasp.label}" for group, grasp in zip(groups, grasps, strict=True)]
    apart = [g if g.endswith("ball") else "0" for g in others]
    assert learn_spread(grasps[:12], apart[:12], rest) is None  # no object on two days

"""The drift estimate: a Gaussian that likely objects narrow, and new ones leave as it is."""

import numpy as np
import pytest

from recognition.drift.drift import Drift
from recognition.drift.estimate import OFFSET_SD_MM, DriftEstimate, DriftMeasurement

TRUE = np.array([np.log(0.7), np.log(0.9), -4.0])


def measured(label="egg", probability=1.0, values=TRUE, sd=(0.05, 0.05, 0.4)):
    seen = len(values)
    return DriftMeasurement(
        label=label, probability=probability, values=values, covariance=np.diag(sd[:seen]) ** 2
    )


@pytest.fixture
def before():
    return DriftEstimate.before((0, 2), 4, n_labels=9)


def test_without_grasps_nothing_has_changed(before):
    assert before.unchanged == pytest.approx(0.997)
    assert not before.likely
    assert before.present == before.expected
    assert before.offset_sd_m == pytest.approx(OFFSET_SD_MM * 1e-3)
    assert before.n_objects == 0


def test_several_objects_that_agree_show_a_drift(before):
    found = before
    for number in range(4):
        found = found.after([measured(f"object {number}")])
    assert found.likely
    assert found.n_objects == 4
    assert found.present.gains_of((0, 2)) == pytest.approx([0.7, 0.9], rel=0.05)
    assert found.present.gains_of((1, 3)) == pytest.approx(np.sqrt(0.63), rel=0.05)
    assert found.present.aperture_offset_m == pytest.approx(-4e-3, abs=4e-4)
    assert found.log_gain_sd < before.log_gain_sd / 3


def test_one_object_counts_as_one_however_often_it_comes(before):
    many, one = before, before.after([measured()])
    several = before
    for number in range(20):
        many = many.after([measured()])
        several = several.after([measured(f"object {number}")])
    assert many.n_objects == 1
    assert many.mean == pytest.approx(one.mean)
    assert many.offset_sd_m == pytest.approx(one.offset_sd_m)
    assert not many.likely
    assert several.offset_sd_m < one.offset_sd_m / 2


def test_the_order_of_the_sequences_does_not_matter(before):
    other = measured("cone", probability=0.6, values=0.5 * TRUE)
    ahead, after = (
        before.after([measured()]).after([other]),
        before.after([other]).after([measured()]),
    )
    assert np.array_equal(ahead.mean, after.mean)
    assert np.array_equal(ahead.covariance, after.covariance)


def test_a_new_object_changes_nothing(before):
    found = before.after([])
    assert found.mean == pytest.approx(before.mean, abs=0.1)
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([0.25, 0.25, 3.0], rel=0.05)
    assert found.unchanged == pytest.approx(0.997, abs=1e-3)


def test_an_object_that_is_unsure_shows_less(before):
    sure, unsure = before.after([measured()]), before.after([measured(probability=0.3)])
    assert abs(unsure.mean[-1]) < abs(sure.mean[-1])
    assert unsure.offset_sd_m > sure.offset_sd_m


def test_it_agrees_with_the_integral_on_a_grid(before):
    objects = [measured(f"object {n}", 0.6, TRUE + 0.1 * n, (0.1, 0.1, 1.0)) for n in range(3)]
    found = before
    for one in objects:
        found = found.after([one])
    gains, offsets = np.linspace(-1.2, 1.2, 49), np.linspace(-12, 12, 97)
    points = np.stack(np.meshgrid(gains, gains, offsets, indexing="ij"), axis=-1).reshape(-1, 3)

    def density(at, mean, variance):
        return np.exp(-0.5 * ((at - mean) ** 2 / variance).sum(axis=-1)) / np.sqrt(variance.prod())

    prior = np.array([0.25, 0.25, 3.0]) ** 2
    weight = density(points, 0.0, prior)
    for one in objects:
        noise = np.diag(one.covariance) + np.array([0.1, 0.1, 1.0]) ** 2
        whatever = density(one.values, 0.0, prior + noise)
        weight = weight * (0.4 + 0.6 * density(points, one.values, noise) / whatever)
    mean = (weight @ points) / weight.sum()
    spread = np.sqrt((weight @ (points - mean) ** 2) / weight.sum())
    assert found.mean == pytest.approx(mean, abs=0.1 * spread.max())
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(spread, rel=0.1)


def test_objects_that_contradict_each_other_leave_it_open(before):
    other = measured("cone", probability=0.5, values=-TRUE)
    found = before.after([measured(probability=0.5), other])
    assert abs(found.drift.aperture_offset_m) < 1.5e-3
    assert not found.likely
    assert found.offset_sd_m > 2e-3


def test_touch_alone_leaves_the_opening_open(before):
    found = before.after([measured(values=TRUE[:2])])
    assert found.drift.aperture_offset_m == 0.0
    assert found.offset_sd_m == pytest.approx(before.offset_sd_m, rel=0.05)
    assert found.log_gain_sd < before.log_gain_sd


def test_a_drift_that_was_gauged_is_no_change():
    gauged = Drift(gains=(0.7, 0.8, 0.9, 0.8), aperture_offset_m=-4e-3)
    found = DriftEstimate.before((0, 2), 4, n_labels=9, expected=gauged)
    for number in range(4):
        found = found.after([measured(f"object {number}")])
    assert found.unchanged > 0.99
    assert found.present == gauged

"""Grasps of objects that nobody named show together what drifted."""

import dataclasses

import numpy as np
import pytest

from recognition.drift import Drift, drift_grid
from recognition.drift_following import follow
from recognition.recognizers import make_trainer
from recognition.shift import evaluate_shift

DRIFT = Drift(gain=0.7, aperture_offset_m=-4e-3)


@pytest.fixture(scope="module")
def taught(train):
    return make_trainer("force_ramp").fit(train)


def expected(recognizer):
    drift = recognizer.grid.likeliest
    return drift.gain, drift.aperture_offset_m * 1e3


def mixed(grasps):
    return sorted(grasps, key=lambda grasp: grasp.start_ms)


def after(recognizer, grasps):
    for grasp in grasps:
        recognizer = recognizer.following([grasp])
    return recognizer


def test_a_shift_of_different_objects_shows_the_drift(taught, fresh):
    drifted = [DRIFT.apply(grasp) for grasp in mixed(fresh)]
    learnt = after(taught, drifted)
    gain, offset_mm = expected(learnt)
    assert gain == pytest.approx(0.7, rel=0.25)
    assert offset_mm == pytest.approx(-4.0, abs=0.8)
    before = np.mean([taught.posterior(g).unknown > 0.5 for g in drifted])
    answers = [learnt.posterior(g) for g in drifted]
    assert np.mean([a.best == g.label for a, g in zip(answers, drifted, strict=True)]) >= 0.95
    assert np.mean([a.unknown > 0.5 for a in answers]) <= min(0.2, before)


def test_without_a_drift_none_is_found_and_nothing_changes(taught, fresh):
    learnt = after(taught, mixed(fresh))
    assert expected(learnt) == (1.0, 0.0)
    same = [learnt.posterior(g).best == taught.posterior(g).best for g in fresh]
    assert np.mean(same) >= 0.95


def test_one_object_alone_makes_no_drift(train, fresh):
    taught = make_trainer("force_ramp").fit([g for g in train if g.label != "egg"])
    strange = [g for g in fresh if g.label == "egg"]
    assert expected(taught.following(strange)) == (1.0, 0.0)


def test_a_drift_that_goes_again_is_noticed(taught, fresh):
    drifted = after(taught, [DRIFT.apply(grasp) for grasp in mixed(fresh)])
    gain, offset_mm = expected(after(drifted, mixed(fresh)))
    assert gain == pytest.approx(1.0, rel=0.15)
    assert offset_mm == pytest.approx(0.0, abs=0.6)


def test_what_it_has_learnt_is_kept_with_the_model(taught, fresh):
    learnt = after(taught, [DRIFT.apply(grasp) for grasp in mixed(fresh)[:4]])
    again = type(taught).from_arrays(learnt.to_arrays())
    assert np.array_equal(again.grid.log_prior, learnt.grid.log_prior)


def test_touch_alone_learns_the_gain_and_nothing_of_the_opening(taught, fresh):
    blind = [
        dataclasses.replace(g, aperture_m=np.full_like(g.aperture_m, np.nan)) for g in mixed(fresh)
    ]
    quieter = [dataclasses.replace(DRIFT, aperture_offset_m=0.0).apply(g) for g in blind]
    gain, offset_mm = expected(after(taught, quieter))
    assert gain < 0.9
    assert offset_mm == 0.0


def test_a_shift_is_evaluated_from_its_eleventh_grasp(taught, train, fresh):
    found = evaluate_shift(taught, [DRIFT.apply(g) for g in fresh], seed=0)
    assert (found.before, found.n) == (10, len(fresh) - 10)
    assert found.accuracy >= 0.9
    assert found.interval[0] < found.accuracy <= found.interval[1]
    assert found.known_rejected <= 0.2
    assert evaluate_shift(taught, fresh[:10], seed=0) is None
    assert evaluate_shift(make_trainer("shrinkage_lda").fit(train), fresh, seed=0) is None


def test_grasps_that_tell_nothing_change_nothing(taught, train, fresh):
    missed = dataclasses.replace(fresh[0], counts=np.zeros_like(fresh[0].counts))
    assert taught.following([]) is taught
    assert taught.following([missed]) is taught
    alone = make_trainer("force_ramp").fit([g for g in train if g.label == "pin"])
    assert alone.following([fresh[0]]) is alone


def test_all_drifts_together_keep_a_probability_of_one():
    grid = drift_grid()
    bias = np.zeros(grid.log_prior.shape)
    told = np.zeros((2, *bias.shape))
    told[:, 3, 5] = 1e3
    for _ in range(30):
        grid = follow(grid, told, bias)
    assert np.exp(grid.log_prior).sum() == pytest.approx(1.0)
    assert np.argmax(grid.log_prior) == 3 * grid.log_prior.shape[1] + 5
    assert grid.log_prior.min() > -20.0


def test_a_drift_that_undrifted_grasps_prefer_is_not_believed():
    grid = drift_grid()
    bias = np.zeros(grid.log_prior.shape)
    bias[3, 5] = 2.0
    believed = grid
    for _ in range(20):
        believed = follow(believed, bias[None], bias)
    assert np.argmax(believed.log_prior) == np.argmax(grid.log_prior)

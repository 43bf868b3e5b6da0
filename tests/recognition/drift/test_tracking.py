"""Grasps of objects that nobody named show together what drifted."""

import dataclasses

import numpy as np
import pytest

from recognition.drift.drift import Drift, drift_grid
from recognition.drift.tracking import DriftTrack, ObjectDriftEvidence, bounded_log_likelihood
from recognition.evaluation.evaluation import evaluate_shift
from recognition.recognizers import make_trainer

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
        recognizer = recognizer.track_drift([grasp])
    return recognizer


def test_a_shift_of_different_objects_shows_the_drift(taught, fresh):
    drifted = [DRIFT.apply(grasp) for grasp in mixed(fresh)]
    learnt = after(taught, drifted)
    gain, offset_mm = expected(learnt)
    assert gain == pytest.approx(0.7, rel=0.25)
    assert offset_mm == pytest.approx(-4.0, abs=0.8)
    assert learnt.drift_estimate.likely
    assert learnt.drift_estimate.present.aperture_offset_m == pytest.approx(-4e-3, abs=0.8e-3)
    assert taught.drift_estimate.unchanged > 0.99
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
    assert expected(taught.track_drift(strange)) == (1.0, 0.0)
    again_and_again = after(taught, 4 * strange)
    assert expected(again_and_again) == (1.0, 0.0)
    assert not again_and_again.drift_estimate.likely
    assert again_and_again.drift_estimate.unchanged > 0.9


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
    assert taught.track_drift([]) is taught
    assert taught.track_drift([missed]) is taught
    alone = make_trainer("force_ramp").fit([g for g in train if g.label == "pin"])
    assert alone.track_drift([fresh[0]]) is alone


GRID = drift_grid()
NO_BIAS = np.zeros(GRID.log_prior.shape)
MIDDLE = tuple(n // 2 for n in NO_BIAS.shape)


def seen(told, place):
    return ObjectDriftEvidence(
        view="both", positions=np.full((2, 4), float(place)), log_likelihood=told
    )


def speaking_for(gain, offset, strength=9.0):
    told = np.full(NO_BIAS.shape, -strength)
    told[gain, offset] = 0.0
    return told


def test_all_drifts_together_keep_a_probability_of_one():
    shift = DriftTrack(prior=GRID)
    for number in range(30):
        shift = shift.after(seen(speaking_for(3, 5), 100.0 * number))
    assert len(shift.seen) == 20
    assert np.exp(shift.grid.log_prior).sum() == pytest.approx(1.0)
    assert np.argmax(shift.grid.log_prior) == 3 * NO_BIAS.shape[1] + 5
    assert shift.grid.log_prior.min() > -20.0
    assert shift.drift_estimate.likely
    assert shift.drift_estimate.drift.gain == pytest.approx(GRID.gains[3], rel=0.01)
    assert shift.drift_estimate.present is not None
    assert shift.drift_estimate.n_objects == 20


def test_the_same_object_again_and_again_counts_once():
    once = DriftTrack(prior=GRID).after(seen(speaking_for(3, 5), 0.0))
    again = once
    for _ in range(10):
        again = again.after(seen(speaking_for(3, 5), 0.5))
    assert again.grid.log_prior == pytest.approx(once.grid.log_prior)
    assert not again.drift_estimate.likely
    assert again.drift_estimate.n_objects == 1
    assert again.drift_estimate.present == again.drift_estimate.expected
    different = once.after(seen(speaking_for(3, 5), 50.0))
    assert different.drift_estimate.unchanged < again.drift_estimate.unchanged - 0.3


def test_somebody_who_knows_the_objects_makes_repeats_count():
    trusted = DriftTrack(prior=GRID, mostly_taught=True)
    for _ in range(25):
        trusted = trusted.after(seen(speaking_for(3, 5, 4.0), 0.5))
    assert len(trusted.seen) == 25
    assert trusted.weights.sum() == pytest.approx(25 / (1.0 + 24 * 0.2))


def test_places_in_two_views_are_not_compared():
    a = seen(NO_BIAS, 0.0)
    assert a.same_as(seen(NO_BIAS, 1.0))
    assert not a.same_as(seen(NO_BIAS, 9.0))
    assert not a.same_as(dataclasses.replace(a, view="touch"))


def test_an_object_that_no_drift_explains_says_nothing():
    never_taught = np.full((2, *NO_BIAS.shape), -30.0)
    never_taught[:, 3, 5] = -12.0
    told = bounded_log_likelihood(never_taught, NO_BIAS)
    assert np.ptp(told) < 1e-3
    taught = np.full((2, *NO_BIAS.shape), -30.0)
    taught[:, 3, 5] = 2.0
    told = bounded_log_likelihood(taught, NO_BIAS)
    assert told.max() == told[3, 5] == 0.0
    assert told.min() == pytest.approx(-6.0, abs=0.1)


def test_no_object_says_more_than_it_may():
    sure = np.full((1, *NO_BIAS.shape), -30.0)
    sure[0, 3, 5] = 50.0
    assert bounded_log_likelihood(sure, NO_BIAS).min() == -9.0


def test_a_drift_that_undrifted_grasps_prefer_gets_no_more_likelihood():
    bias = NO_BIAS.copy()
    bias[3, 5] = 2.0
    shift = DriftTrack(prior=GRID)
    for number in range(20):
        shift = shift.after(seen(bounded_log_likelihood(bias[None], bias), 100.0 * number))
    assert shift.drift_estimate.unchanged > 0.99
    assert shift.drift_estimate.present == shift.drift_estimate.expected


def test_a_small_drift_is_followed_and_not_said():
    shift = DriftTrack(prior=GRID)
    for number in range(10):
        shift = shift.after(seen(speaking_for(MIDDLE[0] + 1, MIDDLE[1]), 100.0 * number))
    assert shift.grid.likeliest.gain == pytest.approx(1.105, abs=0.001)
    assert not shift.drift_estimate.likely

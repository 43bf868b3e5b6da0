"""Strange grasps are found, and the share of familiar ones that is turned away is kept."""

import numpy as np
import pytest

from recognition.statistics.novelty import (
    FEWER_KEPT,
    KNOWN_KEPT,
    NoveltyDetector,
    fit_novelty_detector,
)

MANY = np.full(5, 1000)


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    return rng.normal(0, 1, 300), rng.normal(4.0, 1, 200)


def test_strange_grasps_are_found_and_few_familiar_ones_turned_away(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, known, MANY)
    assert np.mean(novelty.probability(strange) > 0.5) > 0.9
    rejected = np.mean(novelty.probability(known) > 0.5)
    assert rejected == pytest.approx(1 - KNOWN_KEPT, abs=0.01)


def test_kinds_that_lie_apart_give_a_steeper_curve(samples):
    known, strange = samples
    near = fit_novelty_detector(known, strange - 2.5, known, MANY)
    far = fit_novelty_detector(known, strange, known, MANY)
    assert far.slope > near.slope > 0.0


def test_caution_calls_more_of_both_kinds_new(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, known, MANY)
    odds = [novelty.probability(known, caution=caution) for caution in (1.0, 3.0)]
    assert odds[1] / (1 - odds[1]) == pytest.approx(3.0 * odds[0] / (1 - odds[0]))


def test_without_objects_to_leave_out_distance_decides(samples):
    known, _ = samples
    novelty = fit_novelty_detector(np.zeros(0), np.zeros(0), known, MANY)
    near, far = novelty.probability(np.array([-1.0, 5.0]))
    assert near < 0.5 < far


def test_novelty_comes_back_from_its_arrays(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, known, MANY)
    assert NoveltyDetector.from_arrays(novelty.to_arrays("n_"), "n_") == novelty


def test_the_fewer_grasps_are_taught_the_less_far_off_is_new(samples):
    known, strange = samples
    few = fit_novelty_detector(known, strange, known, np.array([6, 6]))
    assert few.even < fit_novelty_detector(known, strange, known, MANY).even
    kept = np.mean(known < few.even)
    assert kept == pytest.approx(KNOWN_KEPT - FEWER_KEPT / 6, abs=0.01)

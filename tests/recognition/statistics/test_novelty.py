"""Strange grasps are found, and the share of familiar ones that is turned away is kept."""

import numpy as np
import pytest

from recognition.statistics.novelty import (
    KNOWN_KEPT,
    NoveltyDetector,
    fit_novelty_detector,
    held_out_kept,
)

EVEN = 1.9
"""The 97th percentile of a standard normal distribution."""


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    return rng.normal(0, 1, 300), rng.normal(4.0, 1, 200)


def test_strange_grasps_are_found_and_few_familiar_ones_turned_away(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, EVEN)
    assert np.mean(novelty.probability(strange) > 0.5) > 0.9
    rejected = np.mean(novelty.probability(known) > 0.5)
    assert rejected == pytest.approx(1 - KNOWN_KEPT, abs=0.01)


def test_kinds_that_lie_apart_give_a_steeper_curve(samples):
    known, strange = samples
    near = fit_novelty_detector(known, strange - 2.5, EVEN)
    far = fit_novelty_detector(known, strange, EVEN)
    assert far.slope > near.slope > 0.0


def test_caution_calls_more_of_both_kinds_new(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, EVEN)
    odds = [novelty.probability(known, caution=caution) for caution in (1.0, 3.0)]
    assert odds[1] / (1 - odds[1]) == pytest.approx(3.0 * odds[0] / (1 - odds[0]))


def test_without_objects_to_leave_out_distance_decides():
    novelty = fit_novelty_detector(np.zeros(0), np.zeros(0), EVEN)
    near, far = novelty.probability(np.array([-1.0, 5.0]))
    assert near < 0.5 < far


def test_novelty_comes_back_from_its_arrays(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, EVEN)
    assert NoveltyDetector.from_arrays(novelty.to_arrays("n_"), "n_") == novelty


def test_the_fewer_grasps_are_taught_the_fewer_held_out_ones_are_kept():
    shares = [held_out_kept(np.full(5, n)) for n in (3, 6, 20, 1000)]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(KNOWN_KEPT, abs=0.001)
    assert held_out_kept(np.array([6, 60])) < held_out_kept(np.array([60, 60]))

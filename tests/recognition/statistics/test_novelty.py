"""Strange grasps are found, and the share of familiar ones that is turned away is kept."""

import numpy as np
import pytest

from recognition.statistics.novelty import (
    KNOWN_KEPT,
    NoveltyDetector,
    fit_novelty_detector,
    novelty_features,
)


def test_signs_are_logarithms_of_distances():
    distances = np.array([[4.0, 1.0, 9.0]])
    own, second = np.array([[7.0, 3.0, 2.0]]), np.array([[2.0, 8.0, 6.0]])
    told = distances, own, np.array([0.5]), np.array([5.0])
    signs = np.exp(novelty_features(*told, second)[0])
    assert signs == pytest.approx([1.1, 1.1 / 4.1, 0.6, 3.1, 5.1, 8.1, 8.1 / 2.1])
    assert novelty_features(*told)[0] == pytest.approx(np.log(signs[:5]))


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    known, strange = rng.normal(0, 1, (300, 3)), rng.normal(0, 1, (200, 3))
    strange[:, 1] += 4.0
    return known, strange


def test_the_telling_sign_gets_the_weight(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, known)
    assert np.argmax(np.abs(novelty.weight)) == 1
    assert np.mean(novelty.probability(strange) > 0.5) > 0.9


def test_few_familiar_grasps_are_turned_away(samples):
    known, strange = samples
    rejected = np.mean(fit_novelty_detector(known, strange, known).probability(known) > 0.5)
    assert rejected == pytest.approx(1 - KNOWN_KEPT, abs=0.01)


def test_without_objects_to_leave_out_distance_decides(samples):
    known, _ = samples
    none = np.zeros((0, 3))
    novelty = fit_novelty_detector(none, none, known)
    near, far = novelty.probability(np.array([[-1.0, 0, 0], [5.0, 0, 0]]))
    assert near < 0.5 < far


def test_novelty_comes_back_from_its_arrays(samples):
    known, strange = samples
    novelty = fit_novelty_detector(known, strange, known)
    again = NoveltyDetector.from_arrays(novelty.to_arrays("n_"), "n_")
    assert np.array_equal(again.probability(strange), novelty.probability(strange))

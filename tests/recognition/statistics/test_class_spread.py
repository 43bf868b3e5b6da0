"""Covariances of classes: a class that varies along one axis is wide there, and nowhere else."""

import numpy as np
import pytest

from recognition.statistics.class_spread import ClassSpread, fit_class_spread

CENTRES = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def spread():
    rng = np.random.default_rng(0)
    long = rng.normal(0.0, (0.5, 4.0, 0.5), (60, 3)) + CENTRES[0]
    round_ = rng.normal(0.0, 0.5, (60, 3)) + CENTRES[1]
    return fit_class_spread(np.concatenate([long, round_]), np.repeat([0, 1], 60), CENTRES)


def plain(z):
    return ((z[:, None] - CENTRES) ** 2).sum(axis=-1)


def test_the_long_class_is_near_along_its_axis_only(spread):
    along, across = np.array([[3.0, 5.0, 0.0]]), np.array([[3.0, 0.0, 5.0]])
    near, far = (spread.distances(z, plain(z))[0] for z in (along, across))
    assert near[0] < near[1]
    assert near[0] < plain(along)[0, 0] < far[0]


def test_a_class_that_varies_more_has_the_larger_volume(spread):
    assert spread.log_volume[0] > spread.log_volume[1]


def test_distances_are_those_of_the_covariance(spread):
    z = np.random.default_rng(1).normal(0, 3, (5, 3))
    for c, centre in enumerate(CENTRES):
        expected = [(p - centre) @ spread.precision[c] @ (p - centre) for p in z]
        assert spread.distances(z, plain(z))[:, c] == pytest.approx(expected)


def test_it_comes_back_from_its_arrays(spread):
    again = ClassSpread.from_arrays(spread.to_arrays("s_"), "s_")
    assert np.array_equal(again.precision, spread.precision)

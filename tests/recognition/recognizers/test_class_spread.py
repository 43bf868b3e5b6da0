"""Each class varies in its own directions: distances by its covariance."""

import numpy as np
import pytest

from recognition.recognizers.force_ramp.class_spread import ClassSpread, fit_spread


@pytest.fixture(scope="module")
def spread_case():
    rng = np.random.default_rng(1)
    classes = np.repeat([0, 1, 2], [40, 6, 12])
    centres = rng.normal(0.0, 5.0, (3, 5))
    scale = np.array([[4, 1, 1, 1, 1], [1, 1, 1, 1, 1], [1, 1, 0.1, 1, 1]])[classes]
    samples = centres[classes] + scale * rng.normal(size=(58, 5))
    weight = np.where(np.arange(58) % 2, 1.0, 0.3)
    return samples, classes, weight, centres


def direct(samples, classes, weight, centres, z):
    """Return the same by whole matrices: distances (h, C) and half the log determinants (C,)."""
    residuals = (samples - centres[classes]) * np.sqrt(weight)[:, None]
    level = (residuals**2).sum() / (weight.sum() * samples.shape[1])
    distances, volumes = [], []
    for label, centre in enumerate(centres):
        mine = residuals[classes == label]
        total = weight[classes == label].sum() + 15.0
        covariance = (mine.T @ mine / level + 15.0 * np.eye(samples.shape[1])) / total
        away = z - centre
        distances.append(np.einsum("ij,ij->i", away @ np.linalg.inv(covariance), away))
        volumes.append(0.5 * np.linalg.slogdet(covariance)[1])
    return np.array(distances).T, np.array(volumes)


def test_distances_are_those_of_whole_covariances(spread_case):
    samples, classes, weight, centres = spread_case
    spread = fit_spread(samples, classes, weight, centres)
    z = np.random.default_rng(2).normal(0.0, 6.0, (30, 5))
    plain = ((z[:, None] - centres) ** 2).sum(axis=2)
    distances, volumes = direct(*spread_case, z)
    assert spread.distances(z, plain) == pytest.approx(distances)
    assert spread.log_volume == pytest.approx(volumes)


def test_a_class_reaches_further_where_its_grasps_vary(spread_case):
    samples, classes, weight, centres = spread_case
    spread = fit_spread(samples, classes, weight, centres)
    z = centres[0] + 6.0 * np.eye(5)[:2]
    plain = ((z[:, None] - centres) ** 2).sum(axis=2)
    along, across = spread.distances(z, plain)[:, 0]
    assert along < 0.5 * across


def test_spread_comes_back_from_its_arrays(spread_case):
    spread = fit_spread(*spread_case)
    again = ClassSpread.from_arrays(spread.to_arrays("a_"), "a_")
    z = spread_case[0]
    plain = np.ones((len(z), 3))
    assert np.array_equal(again.distances(z, plain), spread.distances(z, plain))

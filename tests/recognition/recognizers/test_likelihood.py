"""Class likelihoods under drifts: the quick way against the plain formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import ortho_group

from recognition.drift.drift import CERTAIN, DriftGrid, drift_grid
from recognition.recognizers.force_ramp.likelihood import fit_class_likelihood
from recognition.recognizers.force_ramp.training_set import FeatureRows, TrainingSet
from recognition.recognizers.force_ramp.view import fit_view
from recognition.statistics.lda import fit_lda

N_CLASSES = 70
FEATURES = 90


def taught_with(features, classes, n_classes, *, virtual=None, n_second=None):
    """Return the likelihoods of classes taught with features (n, F) alone."""
    n = len(features)
    return fit_class_likelihood(
        TrainingSet(
            features=features,
            virtual=virtual,
            nuisance=None,
            rows=FeatureRows(tactile=np.zeros((n, 1, 0)), aperture=np.zeros((n, 1, 0))),
            classes=classes,
            n_classes=n_classes,
            n_second=n_second,
            grid=CERTAIN,
        )
    )


@pytest.fixture(scope="module")
def many():
    """Return likelihoods of more classes than axes, and grasps under each drift of a grid."""
    rng = np.random.default_rng(5)
    centres = rng.normal(0.0, 3.0, (N_CLASSES, FEATURES))
    classes = np.repeat(np.arange(N_CLASSES), 5)
    taught = centres[classes] + rng.normal(size=(len(classes), FEATURES))
    likelihood = taught_with(
        taught, classes, N_CLASSES, virtual=taught + rng.normal(size=taught.shape), n_second=80
    )
    grid = drift_grid()
    by_gain = rng.normal(0.0, 2.0, 80) * np.log(grid.gains)[:, None]
    by_offset = rng.normal(0.0, 0.5, 10) * grid.offsets_mm[:, None]
    seen = centres[::6] + rng.normal(size=(len(centres[::6]), FEATURES))
    rows = FeatureRows(
        tactile=seen[:, None, :80] + by_gain, aperture=seen[:, None, 80:] + by_offset
    )
    return likelihood, rows, grid.log_prior


def plain_scores(likelihood, tactile, aperture, log_prior):
    """Return scores (C,) of one grasp by whole matrices and without shortcuts."""
    lda = likelihood.discriminant
    rank = likelihood.samples.shape[1]
    scale = rank * likelihood.reach
    pairs = [(g, o) for g in range(len(tactile)) for o in range(len(aperture))]
    z = lda.project(np.array([np.concatenate([tactile[g], aperture[o]]) for g, o in pairs]))
    apart = ((z[:, None] - lda.centres) ** 2).sum(axis=2)
    exponent = 0.5 * (rank + 3.0)
    likely = log_prior.ravel() - exponent * np.log1p(apart.min(axis=1) / scale)
    chosen = set(np.argsort(-likely)[:24].tolist()) | {int(np.argmax(log_prior))}
    parts = []
    for pair in chosen:
        own = likelihood.spread.distances(z[[pair]], apart[[pair]])[0]
        around = -exponent * np.log1p(own / scale) - likelihood.spread.log_volume
        squared = ((z[pair] - likelihood.samples) ** 2).sum(axis=1)
        density = likelihood.log_weight - exponent * np.log1p(squared / scale)
        near = [logsumexp(density[likelihood.sample_class == c]) for c in range(len(around))]
        near = np.logaddexp(near, density.max() + np.log(1e-30))
        parts.append(log_prior.ravel()[pair] + 0.5 * (around + near))
    return logsumexp(parts, axis=0)


@pytest.mark.parametrize("reach", [1.0, 3.0])
def test_scores_are_those_of_the_plain_formulas(many, reach):
    likelihood, rows, log_prior = many
    likelihood = replace(likelihood, reach=reach)
    found = likelihood.score(rows, log_prior)
    for n in range(0, len(found.scores), 4):
        plain = plain_scores(likelihood, rows.tactile[n], rows.aperture[n], log_prior)
        assert found.scores[n] == pytest.approx(plain, abs=1e-6)


def test_novelty_features_alone_are_those_of_a_full_score(many):
    likelihood, rows, log_prior = many
    novelty = likelihood.novelty(rows, log_prior)
    assert novelty.shape == (len(rows.tactile), likelihood.n_novelty_features)
    assert novelty == pytest.approx(likelihood.score(rows, log_prior).novelty, abs=1e-6)


def test_many_classes_share_a_bounded_number_of_axes_and_are_still_separated(many):
    likelihood, rows, log_prior = many
    assert likelihood.samples.shape[1] < N_CLASSES - 1
    found = likelihood.score(rows, log_prior).scores.argmax(axis=1)
    assert np.mean(found == np.arange(N_CLASSES)[::6]) > 0.9


def test_few_classes_keep_all_their_axes():
    rng = np.random.default_rng(6)
    classes = np.repeat(np.arange(36), 4)
    rows = rng.normal(0.0, 5.0, (36, 60))[classes] + rng.normal(size=(144, 60))
    assert taught_with(rows, classes, 36).samples.shape[1] == 35


def test_the_axes_kept_are_those_that_separate_best():
    rng = np.random.default_rng(7)
    turn = ortho_group.rvs(6, random_state=7)
    centres = rng.normal(size=(8, 6)) * np.array([9.0, 6.0, 0.1, 0.1, 0.1, 0.1]) @ turn
    classes = np.repeat(np.arange(8), 30)
    rows = centres[classes] + rng.normal(size=(240, 6))
    whole, few = fit_lda(rows, classes, 8), fit_lda(rows, classes, 8, max_rank=2)
    assert few.projection.shape == (6, 2)
    assert few.projection == pytest.approx(whole.projection[:, :2])
    same = few.distances(rows).argmin(axis=1) == whole.distances(rows).argmin(axis=1)
    assert np.mean(same) > 0.95


def training(n_grasps, n_opening, step):
    """Return a training of five objects, each a random walk of placings with the given step."""
    rng = np.random.default_rng(8)
    classes = np.repeat(np.arange(5), n_grasps)
    walk = step * rng.normal(size=(5, n_grasps, 12)).cumsum(axis=1).reshape(-1, 12)
    features = rng.normal(0.0, 6.0, (5, 12))[classes] + rng.normal(size=walk.shape) + walk
    n_touch = 12 - n_opening
    # Only the opening has an offset that may drift.
    offsets = np.array([-1.0, 0.0, 1.0]) if n_opening else np.zeros(1)
    prior = np.where(offsets == 0.0, 0.98, 0.01)
    aperture = np.repeat(features[:, None, n_touch:], len(offsets), axis=1)
    return TrainingSet(
        features=features,
        virtual=None,
        nuisance=None,
        rows=FeatureRows(tactile=features[:, None, :n_touch], aperture=aperture),
        classes=classes,
        n_classes=5,
        n_second=n_touch if n_opening else None,
        grid=DriftGrid(gains=np.ones(1), offsets_mm=offsets, log_prior=np.log(prior)[None]),
    )


def test_few_grasps_and_placings_that_walk_make_later_grasps_reach_further_out():
    steady, few, walking = (
        fit_view(training(n, 2, step)).likelihood.reach
        for n, step in ((30, 0.0), (3, 0.0), (30, 0.5))
    )
    assert steady == pytest.approx(1.0, abs=0.15)
    assert few > 1.3
    assert walking > 1.3


def test_by_touch_alone_nothing_reaches_further_out():
    assert fit_view(training(3, 0, 0.5)).likelihood.reach == 1.0


def test_reach_comes_back_from_the_arrays(many):
    likelihood, rows, log_prior = many
    far = replace(likelihood, reach=2.5)
    again = type(far).from_arrays(far.to_arrays("a_"), "a_")
    few = rows.take(np.arange(len(rows.tactile)) < 2)
    assert np.array_equal(again.score(few, log_prior).scores, far.score(few, log_prior).scores)


def test_without_the_opening_the_first_features_show_a_drift():
    rng = np.random.default_rng(7)
    centres = rng.normal(0.0, 3.0, (12, 40))
    classes = np.repeat(np.arange(12), 6)
    taught = centres[classes] + rng.normal(size=(len(classes), 40))
    likelihood = taught_with(taught, classes, 12, n_second=25)
    seen = centres[3] + rng.normal(size=(4, 5, 40))
    found = likelihood.drift_log_likelihood(FeatureRows(tactile=seen, aperture=np.zeros((4, 1, 0))))
    distance = fit_lda(taught[:, :25], classes, 12, min_shrinkage=0.15, max_rank=48).distances(
        seen[..., :25].reshape(20, 25)
    )
    plain = logsumexp(-0.5 * 0.5 * (11 + 3.0) * np.log1p(distance / 11), axis=1)
    assert found == pytest.approx(plain.reshape(4, 5, 1))

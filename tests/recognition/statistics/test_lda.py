"""The discriminant against what is known of Gaussians, and the calibration of its answers."""

import numpy as np
import pytest

from recognition.statistics.calibration import (
    UNIFORM_SHARE,
    blocked_folds,
    fit_temperature,
    to_probability,
)
from recognition.statistics.lda import LinearDiscriminant, fit_lda


def gaussians(rng, n=60, shift=3.0, n_features=6):
    centres = np.eye(3, n_features) * shift
    classes = np.repeat([0, 1, 2], n)
    return centres[classes] + rng.normal(size=(3 * n, n_features)), classes


def test_nearest_class_is_the_right_one():
    rng = np.random.default_rng(0)
    x, y = gaussians(rng, shift=6.0)
    lda = fit_lda(x, y, 3)
    assert np.array_equal(lda.distances(x).argmin(axis=1), y)
    assert lda.centres.shape == (3, 2)


def test_the_axes_that_separate_best_are_kept():
    x, y = gaussians(np.random.default_rng(0), shift=6.0)
    x[y == 2] += 12.0
    every, one = fit_lda(x, y, 3), fit_lda(x, y, 3, most_axes=1)
    assert one.centres == pytest.approx(every.centres[:, :1])
    assert (one.distances(x).argmin(axis=1) == y)[y == 2].all()


def test_distances_are_in_standard_deviations():
    rng = np.random.default_rng(1)
    x, y = gaussians(rng, n=2000, shift=5.0)
    lda = fit_lda(x, y, 3)
    own = lda.distances(x)[np.arange(len(y)), y]
    assert own.mean() == pytest.approx(2.0, rel=0.05)
    apart = ((lda.centres[0] - lda.centres[1]) ** 2).sum()
    assert apart == pytest.approx(2 * 25.0, rel=0.1)


def test_scale_and_offset_of_a_feature_do_not_matter():
    rng = np.random.default_rng(2)
    x, y = gaussians(rng)
    moved = x * np.array([1e3, 1, 1e-3, 5, 1, 1]) + 7.0
    assert fit_lda(moved, y, 3).distances(moved) == pytest.approx(
        fit_lda(x, y, 3).distances(x), rel=1e-6
    )


def test_more_features_than_rows_and_constant_features_are_no_trouble():
    rng = np.random.default_rng(3)
    x, y = gaussians(rng, n=4, shift=8.0, n_features=50)
    x[:, 10:20] = 1.0
    lda = fit_lda(x, y, 3)
    assert np.array_equal(lda.distances(x).argmin(axis=1), y)
    assert np.all(np.isfinite(lda.distances(rng.normal(size=(5, 50)))))


def test_what_few_rows_hardly_show_to_vary_has_the_least_unit():
    x, y = gaussians(np.random.default_rng(3))
    x = np.column_stack([x, np.zeros(len(x))])
    once = np.eye(1, 7, k=6)

    def off(least_unit):
        lda = fit_lda(x, y, 3, nuisance=1e-8 * once, least_unit=least_unit)
        return np.linalg.norm(0.02 * once / lda.scale @ lda.whitening)

    assert off(0.0) > 1e5
    assert off(0.02) < 1e2


def test_full_shrinkage_leaves_plain_scaled_distance():
    rng = np.random.default_rng(4)
    x, y = gaussians(rng)
    lda = fit_lda(x, y, 3, min_shrinkage=1.0)
    means = np.stack([x[y == k].mean(axis=0) for k in range(3)])
    scaled = (((means[0] - means[1]) / lda.scale) ** 2).sum()
    found = ((lda.centres[0] - lda.centres[1]) ** 2).sum()
    assert found == pytest.approx(scaled, rel=0.02)


def test_what_no_class_has_shown_lies_beside_them_all():
    rng = np.random.default_rng(8)
    x, y = gaussians(rng, n=2000, shift=5.0)
    lda = fit_lda(x, y, 3)
    again = LinearDiscriminant.from_arrays(lda.to_arrays("a_"), "a_")

    def beside(rows):
        every = ((rows - lda.mean) / lda.scale @ again.whitening) ** 2
        return (every.sum(axis=1) - (lda.project(rows) ** 2).sum(axis=1)).mean()

    assert beside(x) == pytest.approx(6 - 2, rel=0.05)
    strange = x + np.eye(1, 6, k=4) * 10.0
    assert beside(strange) - beside(x) == pytest.approx(100.0, rel=0.1)
    assert lda.distances(strange) == pytest.approx(lda.distances(x), rel=0.2, abs=3.0)


def test_too_few_rows_are_refused():
    with pytest.raises(ValueError, match="at least three times"):
        fit_lda(np.eye(3), np.arange(3), 3)
    with pytest.raises(ValueError, match="at least three times"):
        fit_lda(np.eye(4), np.array([0, 0, 1, 1]), 3)


def test_discriminant_comes_back_from_its_arrays():
    x, y = gaussians(np.random.default_rng(5))
    lda = fit_lda(x, y, 3)
    again = LinearDiscriminant.from_arrays(lda.to_arrays("a_"), "a_")
    assert np.array_equal(again.distances(x), lda.distances(x))


def test_folds_are_runs_in_time_that_leave_each_class_something():
    classes = np.array([0] * 7 + [1] * 2 + [2])
    folds = blocked_folds(classes, 3)
    assert sum(f.astype(int) for f in folds).tolist() == [1] * 9 + [0]
    for fold in folds:
        assert set(classes[~fold]) == {0, 1, 2}
        rows = np.flatnonzero(fold & (classes == 0))
        assert np.array_equal(rows, np.arange(rows[0], rows[-1] + 1))


@pytest.mark.parametrize("truth", [0.5, 1.0, 4.0])
def test_temperature_is_found_again(truth):
    rng = np.random.default_rng(6)
    scores = rng.normal(0, 3, (6000, 4))
    p = np.exp(scores / truth)
    p /= p.sum(axis=1, keepdims=True)
    classes = np.array([rng.choice(4, p=row) for row in p])
    assert fit_temperature(scores, classes) == pytest.approx(truth, rel=0.1)


def test_few_grasps_all_right_make_no_answer_certain():
    scores = np.array([[0.0, -8.0], [-8.0, 0.0]] * 3)
    assert 1.0 < fit_temperature(scores, np.array([0, 1] * 3)) < 2.0


def test_a_feature_with_a_small_target_outweighs_many_that_repeat_each_other():
    rng = np.random.default_rng(8)
    classes = np.repeat([0, 1], 5)
    repeated = rng.normal(0, 1, (10, 1)) + rng.normal(0, 0.3, (10, 60))
    x = np.column_stack([repeated, rng.normal(0, 1, 10) + 4.0 * classes])
    target = np.append(np.ones(60), 0.1)
    axes = [fit_lda(x, classes, 2, target=t).projection[:, 0] for t in (None, target)]
    plain, weighted = (abs(axis[-1]) / np.linalg.norm(axis) for axis in axes)
    assert weighted > 1.1 * plain


def test_no_taught_object_is_impossible():
    p = to_probability(np.array([[1000.0, 0.0, -1000.0]]), 1.0)
    assert p.sum() == pytest.approx(1.0)
    assert p.min() >= UNIFORM_SHARE / 3

"""The discriminant against what is known of Gaussians, and the calibration of its answers."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.calibration import (
    UNIFORM_SHARE,
    blocked_folds,
    fit_temperature,
    to_probability,
)
from recognition.statistics.fusion import MAX_UNKNOWN, DecisionKind, StopRule, decide, fuse
from recognition.statistics.lda import (
    LinearDiscriminant,
    TaughtSizes,
    fit_class_spread,
    fit_lda,
    fit_sizes,
    squared_distances,
)


def gaussians(seed, n=60, shift=3.0, n_features=6):
    rng = np.random.default_rng(seed)
    centres = np.eye(3, n_features) * shift
    classes = np.repeat([0, 1, 2], n)
    return centres[classes] + rng.normal(size=(3 * n, n_features)), classes


def distances(lda, x):
    return squared_distances(lda.project(x), lda.centres)


def test_the_axes_that_separate_best_are_kept():
    x, y = gaussians(0, shift=6.0)
    x[y == 2] += 12.0
    every, one = fit_lda(x, y, 3), fit_lda(x, y, 3, most_axes=1)
    assert one.centres == pytest.approx(every.centres[:, :1])
    assert (distances(one, x).argmin(axis=1) == y)[y == 2].all()


def test_distances_are_in_standard_deviations():
    x, y = gaussians(1, n=2000, shift=5.0)
    lda = fit_lda(x, y, 3)
    own = distances(lda, x)[np.arange(len(y)), y]
    assert lda.centres.shape == (3, 2)
    assert own.mean() == pytest.approx(2.0, rel=0.05)
    assert ((lda.centres[0] - lda.centres[1]) ** 2).sum() == pytest.approx(2 * 25.0, rel=0.1)


def test_scale_and_offset_of_a_feature_do_not_matter():
    x, y = gaussians(2)
    moved = x * np.array([1e3, 1, 1e-3, 5, 1, 1]) + 7.0
    assert distances(fit_lda(moved, y, 3), moved) == pytest.approx(
        distances(fit_lda(x, y, 3), x), rel=1e-6
    )


def squared_lengths(lda: LinearDiscriminant, rows):
    scaled = (rows - lda.mean) / lda.scale
    return (scaled**2).sum(axis=1) - ((scaled @ lda.variation) ** 2).sum(axis=1)


def test_more_features_than_rows_and_constant_features_are_no_trouble():
    x, y = gaussians(3, n=4, shift=8.0, n_features=50)
    x[:, 10:20] = 1.0
    lda = fit_lda(x, y, 3)
    assert np.array_equal(distances(lda, x).argmin(axis=1), y)
    assert np.all(np.isfinite(distances(lda, x + 1.0)))


def test_what_few_rows_hardly_show_to_vary_has_the_least_unit():
    x, y = gaussians(3)
    x = np.column_stack([x, np.zeros(len(x))])
    once = np.eye(1, 7, k=6)

    def off(least_unit):
        lda = fit_lda(x, y, 3, nuisance=1e-8 * once, least_unit=least_unit)
        return np.sqrt(squared_lengths(lda, 0.02 * once + lda.mean))

    assert off(0.0) > 1e5
    assert off(0.02) < 1e2


def test_full_shrinkage_leaves_plain_scaled_distance():
    x, y = gaussians(4)
    lda = fit_lda(x, y, 3, min_shrinkage=1.0)
    means = np.stack([x[y == k].mean(axis=0) for k in range(3)])
    scaled = (((means[0] - means[1]) / lda.scale) ** 2).sum()
    assert ((lda.centres[0] - lda.centres[1]) ** 2).sum() == pytest.approx(scaled, rel=0.02)


def test_what_no_class_has_shown_lies_beside_them_all():
    x, y = gaussians(8, n=2000, shift=5.0)
    lda = fit_lda(x, y, 3)
    again = LinearDiscriminant.from_arrays(lda.to_arrays("a_"), "a_")

    def outside(rows):
        return (squared_lengths(again, rows) - (lda.project(rows) ** 2).sum(axis=1)).mean()

    assert outside(x) == pytest.approx(6 - 2, rel=0.05)
    strange = x + np.eye(1, 6, k=4) * 10.0
    assert outside(strange) - outside(x) == pytest.approx(100.0, rel=0.1)
    assert distances(lda, strange) == pytest.approx(distances(lda, x), rel=0.2, abs=3.0)


def test_too_few_rows_and_equal_objects_are_refused():
    for n, classes in ((3, [0, 1, 2]), (4, [0, 0, 1, 1])):
        with pytest.raises(ValueError, match="at least three times"):
            fit_lda(np.eye(n), np.array(classes), 3)
    with pytest.raises(ValueError, match="the same mean"):
        fit_lda(np.tile(np.eye(3), (2, 1)), np.array([0, 0, 0, 1, 1, 1]), 2)


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
    fits = [fit_lda(x, classes, 2, target=t) for t in (None, np.append(np.ones(60), 0.1))]
    axes = [lda.projection[:, 0] / lda.scale for lda in fits]
    plain, weighted = (abs(axis[-1]) / np.linalg.norm(axis) for axis in axes)
    assert weighted > 1.1 * plain


def test_no_taught_object_is_impossible():
    p = to_probability(np.array([[1000.0, 0.0, -1000.0]]), 1.0)
    assert p.sum() == pytest.approx(1.0)
    assert p.min() >= UNIFORM_SHARE / 3


# -- Covariances of classes ------------------------------------------------------------------------


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


def test_distances_are_those_of_the_covariance(spread):
    z = np.random.default_rng(1).normal(0, 3, (5, 3))
    for c, centre in enumerate(CENTRES):
        expected = [(p - centre) @ spread.precision[c] @ (p - centre) for p in z]
        assert spread.distances(z, plain(z))[:, c] == pytest.approx(expected)


# -- Sizes of the taught grasps --------------------------------------------------------------------


CLASSES = np.repeat([0, 1], 6)


def sizes(spread_mm: float) -> np.ndarray:
    """Return two sizes of six grasps each of objects of 10 and 30 mm."""
    off_mm = np.linspace(-2.5, 2.5, 6) * spread_mm
    return (np.repeat([10.0, 30.0], 6) + np.tile(off_mm, 2))[:, None] + np.array([0.0, 2.0])


def novelty(fitted: TaughtSizes, sizes_mm: list[list[float]], slack_mm: float = 0.0) -> np.ndarray:
    """Return the squared distances to the first object."""
    objects = np.zeros((len(sizes_mm), 1, 1), dtype=np.int64)
    return fitted.distances(np.array(sizes_mm)[:, None], np.array([slack_mm]), objects)[:, 0, 0]


def test_a_size_between_the_taught_ones_is_new_and_theirs_is_not():
    fitted = fit_sizes(sizes(0.2), CLASSES)
    taught, between, of_the_other = novelty(fitted, [[10.1, 12.1], [20.0, 22.0], [30.0, 32.0]])
    assert taught < 0.5
    assert of_the_other > between > 400.0
    assert novelty(fitted, [[20.0, 22.0]], slack_mm=10.0) < 3.0


def test_both_faces_of_an_object_are_fitted():
    two_faces = np.where(np.arange(12) % 2, 10.0, 16.0)[:, None] + np.array([0.0, 2.0])
    fitted = fit_sizes(two_faces, np.zeros(12, dtype=np.int64))
    thin, middle, thick = novelty(fitted, [[10.0, 12.0], [13.0, 15.0], [16.0, 18.0]])
    assert thin == thick == 0.0
    assert middle > 50.0


def test_few_grasps_keep_the_unit_near_the_expected_one():
    same = np.full((40, 2), 10.0)
    few = fit_sizes(same[:3], np.zeros(3, dtype=np.int64))
    many = fit_sizes(same, np.zeros(40, dtype=np.int64))
    assert np.all(few.unit_mm > 0.7 * np.array([0.5, 0.2]))
    assert np.all(many.unit_mm < 0.5 * few.unit_mm)


def test_the_only_grasp_on_another_side_hides_no_other_object():
    of_two = np.array([10.0, 10.1, 15.9, 6.0, 6.1, 6.2])[:, None] + np.array([0.0, 2.0])
    fitted = fit_sizes(of_two, np.repeat([0, 1], 3))
    on_a_side, on_the_other, other_object = novelty(fitted, [[10.05, 12.05], [15.9, 17.9], [8, 10]])
    assert max(on_a_side, on_the_other) < 0.5
    assert other_object > 50.0


def test_a_lonely_one_of_many_grasps_teaches_no_size():
    many = np.append(np.linspace(9.5, 10.5, 59), 14.0)[:, None] + np.array([0.0, 2.0])
    (at_the_lonely,) = novelty(fit_sizes(many, np.zeros(60, dtype=np.int64)), [many[-1].tolist()])
    assert at_the_lonely > 6.0


# -- Fusing grasps: what must hold for any posteriors, and when to stop ----------------------------


LABELS = ("a", "b", "c", "d")


def posterior(*weights: float, unknown: float = 0.05) -> Posterior:
    p = np.array(weights, dtype=float)
    return Posterior(labels=LABELS[: len(p)], probability=p / p.sum(), unknown=unknown)


posteriors = st.lists(
    st.builds(
        lambda w, u: posterior(*w, unknown=u),
        st.lists(st.floats(1e-6, 1.0), min_size=4, max_size=4),
        st.floats(0.0, 1.0),
    ),
    min_size=1,
    max_size=6,
)
properties = settings(max_examples=60)


@properties
@given(posteriors, st.randoms(use_true_random=False))
def test_order_of_the_grasps_does_not_matter(ps, random):
    shuffled = list(ps)
    random.shuffle(shuffled)
    a, b = fuse(ps), fuse(shuffled)
    assert a.probability == pytest.approx(b.probability, rel=1e-9)
    assert a.unknown == pytest.approx(b.unknown, rel=1e-9)


@properties
@given(posteriors)
def test_fused_is_a_posterior_that_is_never_certain(ps):
    fused = fuse(ps)
    assert fused.probability.sum() == pytest.approx(1.0)
    assert np.all(fused.probability > 0)
    assert 0.0 < fused.unknown < 1.0


@properties
@given(posteriors)
def test_fully_dependent_grasps_tell_no_more_than_one_of_them(ps):
    def odds(p):
        return np.log(p.probability[:, None] / p.probability)

    alone = np.stack([odds(fuse([p])) for p in ps])
    whole = odds(fuse(ps, dependence=1.0))
    assert np.all(whole <= alone.max(axis=0) + 1e-9)
    assert np.all(whole >= alone.min(axis=0) - 1e-9)


def test_agreeing_grasps_grow_surer_but_less_than_independent_ones():
    p = posterior(0.6, 0.4)
    assert 0.6 < fuse([p, p]).probability[0] < 0.36 / (0.36 + 0.16)


def test_a_grasp_without_evidence_changes_no_answer_and_alone_is_no_answer():
    one, missed = posterior(0.9, 0.1), Posterior.uninformed(LABELS[:2])
    assert fuse([one, missed, missed]).probabilities == fuse([one]).probabilities
    assert fuse([missed, missed]).name == UNKNOWN


def test_grasps_that_contradict_each_other_speak_for_an_untaught_object():
    a, b = posterior(1, 1e-4, 1e-4, 1e-4), posterior(1e-4, 1, 1e-4, 1e-4)
    assert fuse([a, b]).unknown > 5 * fuse([a, a]).unknown


def test_fuse_refuses_what_does_not_belong_together():
    with pytest.raises(ValueError, match="grasp at least once"):
        fuse([])
    with pytest.raises(ValueError, match="different labels"):
        fuse([posterior(1, 1), posterior(1, 1, 1)])
    with pytest.raises(ValueError, match="dependence"):
        fuse([posterior(1, 1)], dependence=1.5)


SURE, UNSURE, EVEN = posterior(1.0, 1e-5, 1e-5), posterior(0.6, 0.4), posterior(1, 1, 1, 1)
STRANGE = posterior(0.9, 0.1, unknown=0.9)
MAYBE_NEW = posterior(1.0, 1e-6, unknown=2.0 * MAX_UNKNOWN)


@pytest.mark.parametrize(
    ("grasps", "rule", "answer", "between"),
    [
        ([SURE], StopRule(error_rate=0.02), (DecisionKind.DECIDED, "a"), (0.98, 1.0)),
        ([UNSURE], StopRule(max_grasps=3), (DecisionKind.CONTINUE, "a"), (0.59, 0.61)),
        ([UNSURE] * 2, StopRule(max_grasps=3), (DecisionKind.CONTINUE, "a"), (0.6, 0.99)),
        ([UNSURE] * 3, StopRule(max_grasps=3), (DecisionKind.DECIDED, "a"), (0.6, 0.99)),
        ([STRANGE], StopRule(max_grasps=4), (DecisionKind.CONTINUE, "a"), (0.89, 0.91)),
        ([STRANGE] * 3, StopRule(max_grasps=4), (DecisionKind.UNKNOWN, UNKNOWN), (0.95, 1.0)),
        ([EVEN], StopRule(max_grasps=1), (DecisionKind.UNKNOWN, UNKNOWN), (0.762, 0.763)),
        ([MAYBE_NEW], StopRule(max_grasps=2), (DecisionKind.CONTINUE, "a"), (0.99, 1.0)),
        ([MAYBE_NEW] * 2, StopRule(max_grasps=2), (DecisionKind.DECIDED, "a"), (0.99, 1.0)),
    ],
)
def test_a_sequence_ends_with_a_sure_name_a_new_object_or_the_last(grasps, rule, answer, between):
    decision = decide(grasps, rule)
    assert (decision.kind, decision.label) == answer
    assert between[0] < decision.probability <= between[1]


@pytest.mark.parametrize("share", [0.4, 0.6, 0.9, 1.0])
@pytest.mark.parametrize("unknown", [0.0, 0.3, 0.45, 0.6])
def test_a_name_needs_its_probability_and_its_novelty(share, unknown):
    one = posterior(share, 1.0 - share, unknown=unknown)
    named = (1.0 - unknown) * max(share, 1.0 - share)
    assert (one.name != UNKNOWN) == (unknown <= 0.5)
    assert posterior(1, 1, 1, unknown=unknown).name == UNKNOWN
    assert one.name_probability == pytest.approx(1.0 - named if one.name == UNKNOWN else named)
    assert decide([one], StopRule(max_grasps=1)).label == fuse([one]).name


@pytest.mark.parametrize("wrong", [{"error_rate": 0.0}, {"error_rate": 1.0}, {"max_grasps": 0}])
def test_stop_rule_refuses_what_cannot_be(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        StopRule(**wrong)


# -- Dependence of grasps: what repeats another grasp counts less ----------------------------------


def test_fusion_goes_by_the_dependence_that_posteriors_carry():
    p = np.array([0.7, 0.2, 0.1])

    def both(dependence: float) -> Posterior:
        one = Posterior(labels=("a", "b", "c"), probability=p, unknown=0.1, dependence=dependence)
        return fuse([one, one])

    assert both(1.0).probability == pytest.approx(p, abs=0.005)
    assert both(0.0).probability[0] > both(0.5).probability[0] > both(1.0).probability[0]
    assert both(0.3).dependence == pytest.approx(0.3)
    with pytest.raises(ValueError, match="dependence"):
        both(1.2)

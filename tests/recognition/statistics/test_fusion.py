"""Fusing grasps: what must hold for any posteriors, and when to stop."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import MAX_UNKNOWN, DecisionKind, StopRule, decide, fuse

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
def test_order_of_the_labels_does_not_matter(ps):
    turned = [
        Posterior(labels=p.labels[::-1], probability=p.probability[::-1], unknown=p.unknown)
        for p in ps
    ]
    assert fuse(turned).probability == pytest.approx(fuse(ps).probability[::-1], rel=1e-9)


@properties
@given(posteriors)
def test_fused_is_a_posterior_that_is_never_certain(ps):
    fused = fuse(ps)
    assert fused.probability.sum() == pytest.approx(1.0)
    assert np.all(fused.probability > 0)
    assert 0.0 < fused.unknown < 1.0


@properties
@given(posteriors)
def test_a_grasp_that_tells_nothing_does_not_change_the_order(ps):
    even = posterior(1, 1, 1, 1)
    before, after = fuse(ps).probability, fuse([*ps, even]).probability
    assert np.array_equal(np.argsort(before, kind="stable"), np.argsort(after, kind="stable"))


@properties
@given(posteriors)
def test_fully_dependent_grasps_tell_no_more_than_one_of_them(ps):
    def odds(p):
        return np.log(p.probability[:, None] / p.probability)

    alone = np.stack([odds(fuse([p])) for p in ps])
    whole = odds(fuse(ps, dependence=1.0))
    assert np.all(whole <= alone.max(axis=0) + 1e-9)
    assert np.all(whole >= alone.min(axis=0) - 1e-9)


def test_one_grasp_keeps_its_answer():
    p = posterior(0.6, 0.2, 0.15, 0.05)
    assert fuse([p]).probability == pytest.approx(p.probability, abs=0.005)
    assert fuse([p]).unknown == pytest.approx(p.unknown, abs=1e-6)


def test_agreeing_grasps_grow_surer_but_less_than_independent_ones():
    p = posterior(0.6, 0.4)
    two = fuse([p, p]).probability[0]
    assert 0.6 < two < 0.36 / (0.36 + 0.16)


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


def test_a_sure_grasp_decides_at_once():
    decision = decide([posterior(1.0, 1e-5, 1e-5)], StopRule(error_rate=0.02))
    assert decision.kind is DecisionKind.DECIDED
    assert decision.label == "a"
    assert decision.probability > 0.98


def test_an_unsure_grasp_calls_for_another_until_the_last():
    rule, p = StopRule(error_rate=0.01, max_grasps=3), posterior(0.6, 0.4)
    assert decide([p], rule).kind is DecisionKind.CONTINUE
    assert decide([p, p], rule).kind is DecisionKind.CONTINUE
    last = decide([p, p, p], rule)
    assert last.kind is DecisionKind.DECIDED
    assert 0.6 < last.probability < 0.99


def test_an_untaught_object_ends_the_search():
    strange = posterior(0.9, 0.1, unknown=0.9)
    rule = StopRule(max_grasps=4)
    assert decide([strange], rule).kind is DecisionKind.CONTINUE
    found = decide([strange] * 3, rule)
    assert found.kind is DecisionKind.UNKNOWN
    assert found.label == UNKNOWN
    assert found.probability >= 0.95


def test_after_the_last_grasp_an_unlikely_label_is_unknown():
    even = posterior(1, 1, 1, 1)
    decision = decide([even], StopRule(max_grasps=1))
    assert decision.kind is DecisionKind.UNKNOWN
    assert decision.probability == pytest.approx(1.0 - 0.95 * 0.25)


@pytest.mark.parametrize("share", [0.4, 0.6, 0.9, 1.0])
@pytest.mark.parametrize("unknown", [0.0, 0.3, 0.45, 0.6])
def test_a_name_needs_its_probability_and_its_novelty(share, unknown):
    one = posterior(share, 1.0 - share, unknown=unknown)
    named = (1.0 - unknown) * max(share, 1.0 - share)
    assert (one.name != UNKNOWN) == (unknown <= 0.5)
    assert posterior(1, 1, 1, unknown=unknown).name == UNKNOWN
    assert one.name_probability == pytest.approx(1.0 - named if one.name == UNKNOWN else named)
    assert decide([one], StopRule(max_grasps=1)).label == fuse([one]).name


def test_a_sure_name_of_what_may_be_new_calls_for_another_grasp():
    sure, rule = posterior(1.0, 1e-6, unknown=2.0 * MAX_UNKNOWN), StopRule(max_grasps=2)
    assert decide([sure], rule).kind is DecisionKind.CONTINUE
    assert decide([sure, sure], rule).label == "a"


@pytest.mark.parametrize("wrong", [{"error_rate": 0.0}, {"error_rate": 1.0}, {"max_grasps": 0}])
def test_stop_rule_refuses_what_cannot_be(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        StopRule(**wrong)

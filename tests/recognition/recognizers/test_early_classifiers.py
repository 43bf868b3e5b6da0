"""Decisions during the ramp: looks use no later frame, and a sure look ends the ramp."""

from dataclasses import replace

import numpy as np
import pytest

from recognition.drift.grid import DriftGrid, DriftPrior
from recognition.ramp.running_load import RunningLoad, load_so_far
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.early_classifiers import (
    EarlyClassifiers,
    EarlyDecider,
    EarlyTrainer,
)
from recognition.statistics.fusion import MAX_UNKNOWN, StopRule, fuse


@pytest.fixture(scope="module")
def early(train):
    return EarlyTrainer(base=make_trainer("shrinkage_lda"), shares=(0.3, 0.6)).fit(train)


def test_looks_come_in_order_and_use_no_later_frame(early, fresh):
    reached = [grasp for grasp in fresh if early.look_frames(grasp)]
    assert len(reached) > len(fresh) / 2
    for grasp in reached:
        looks = early.look_frames(grasp)
        assert list(looks) == sorted(looks)
        assert early.look_frames(grasp.first_frames(looks[0])) == looks[:1]
        whole = load_so_far(grasp, early.early.rest)
        part = load_so_far(grasp.first_frames(looks[0]), early.early.rest)
        assert part == pytest.approx(whole[: looks[0]])
        assert whole[looks[0] - 1] >= early.early.load_counts[0] > whole[looks[0] - 2]


def test_a_lax_rule_ends_earlier_than_a_strict_one(early, fresh):
    lax = [early.answer(g, StopRule(error_rate=0.3)) for g in fresh]
    strict = [early.answer(g, StopRule(error_rate=1e-6)) for g in fresh]
    assert np.mean([a.n_frames for a in lax]) < 0.8 * np.mean([g.n_frames for g in fresh])
    for answer, grasp in zip(strict, fresh, strict=True):
        assert not answer.decided
        assert answer.n_frames == grasp.n_frames
        assert answer.looks == len(early.look_frames(grasp)) + 1
    right = [a.posterior.best == g.label for a, g in zip(lax, fresh, strict=True)]
    assert np.mean(right) > 0.8


def test_a_ramp_that_stays_below_a_load_is_judged_as_it_is(early, fresh):
    short = fresh[0].first_frames(early.look_frames(fresh[0])[0])
    assert len(early.look_frames(short)) == 1
    assert early.answer(short, StopRule(error_rate=1e-6)).looks == 2


@pytest.mark.parametrize("shares", [(), (0.5, 0.5), (0.6, 0.3), (0.0, 0.5), (0.5, 1.0)])
def test_shares_are_parts_of_the_ramp_in_order(shares):
    with pytest.raises(ValueError, match="shares"):
        EarlyTrainer(base=make_trainer("shrinkage_lda"), shares=shares)


def test_the_load_comes_frame_by_frame_as_over_the_whole_grasp(early, fresh):
    for grasp in fresh[:4]:
        running = RunningLoad(early.early.rest)
        one_by_one = [running.push(counts) for counts in grasp.counts]
        assert one_by_one == pytest.approx(load_so_far(grasp, early.early.rest).tolist())


def posterior(share: float, unknown: float = 0.01) -> Posterior:
    return Posterior(labels=("a", "b"), probability=np.array([share, 1 - share]), unknown=unknown)


def test_earlier_grasps_count_and_the_last_grasp_is_no_reason_to_decide():
    rule = StopRule(error_rate=0.02, max_grasps=1)
    assert not rule.suffices(posterior(0.9))
    assert rule.suffices(fuse([posterior(0.9), posterior(0.95)]))
    assert not rule.suffices(fuse([posterior(0.02), posterior(0.9)]))
    assert not rule.suffices(posterior(0.999, unknown=0.99))
    assert not rule.suffices(posterior(0.999, unknown=1.0))
    assert not rule.suffices(posterior(0.999, unknown=2.0 * MAX_UNKNOWN))
    assert rule.suffices(posterior(0.999, unknown=0.5 * MAX_UNKNOWN))


def test_a_ramp_that_runs_is_decided_with_what_earlier_grasps_told(early, fresh):
    rule = StopRule(error_rate=1e-3)
    sooner = 0
    for grasp in fresh:
        looks = EarlyDecider(early.early, (), rule)
        alone = [n for n, c in enumerate(grasp.counts, 1) if looks.add_frame(c, lambda g=grasp: g)]
        known = Posterior(
            labels=early.labels,
            probability=np.array([0.99 if n == grasp.label else 0.0 for n in early.labels])
            + 0.01 / len(early.labels),
            unknown=0.01,
        )
        more = EarlyDecider(early.early, (known, known), rule)
        fused = [n for n, c in enumerate(grasp.counts, 1) if more.add_frame(c, lambda g=grasp: g)]
        assert len(alone) <= 1
        assert alone == ([] if looks.answer is None else [looks.answer.n_frames])
        assert set(alone) | set(fused) <= set(early.look_frames(grasp))
        if looks.answer is not None and alone == fused:
            assert more.answer.posterior.probability == pytest.approx(
                looks.answer.posterior.probability
            )
        sooner += bool(fused) and (not alone or fused[0] < alone[0])
    assert sooner > len(fresh) / 4


def test_heads_come_back_from_their_arrays(early, fresh):
    arrays = early.early.to_arrays()
    assert all(array.dtype.kind in "biufU" for array in arrays.values())
    early_classifiers = EarlyClassifiers.from_arrays(arrays, type(early.whole))
    assert early_classifiers.look_frames(fresh[0]) == early.look_frames(fresh[0])
    for one, was in zip(early_classifiers.recognizers, early.early.recognizers, strict=True):
        assert one.posterior(fresh[0]).probability == pytest.approx(
            was.posterior(fresh[0]).probability
        )
    for change in ({"load_counts": np.array([2.0, 1.0])}, {"load_counts": np.array([1.0, 2, 3])}):
        with pytest.raises((ValueError, KeyError)):
            EarlyClassifiers.from_arrays(arrays | change, type(early.whole))


def test_heads_follow_the_drift_that_the_whole_ramps_show(train, early):
    label = train[0].label
    few = [g for g in train if g.label == label][:3] + [g for g in train if g.label != label][:3]
    two = [replace(g, label="one" if g.label == label else "other") for g in few]
    whole = make_trainer("force_ramp", use_aperture=False).fit(two)
    drifted = whole.with_grid(DriftGrid(prior=DriftPrior(log_gain=-0.2, log_gain_sd=0.1)))
    early_classifiers = replace(early.early, recognizers=(whole, whole))
    for one in early_classifiers.with_drift_of(drifted).recognizers:
        assert one.grid is drifted.grid
    assert early.early.with_drift_of(early.whole) is early.early

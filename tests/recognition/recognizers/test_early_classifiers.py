"""Decisions during the ramp: checks use no later frame, and a sure check ends the ramp."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from recognition.drift.grid import DriftGrid, DriftPrior
from recognition.ramp.running_load import RunningLoad, load_so_far
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.early_classifiers import EarlyClassifiers, EarlyDecider, teach_early
from recognition.statistics.fusion import MAX_UNKNOWN, StopRule, fuse


@pytest.fixture(scope="module")
def whole(train):
    return make_trainer("shrinkage_lda").fit(train)


@pytest.fixture(scope="module")
def early(train, whole):
    return teach_early(make_trainer("shrinkage_lda"), train, whole.labels)


def check_frames(early, grasp):
    """Return after how many frames each load is reached."""
    load = load_so_far(grasp, early.rest)
    reached = [np.flatnonzero(load >= level) for level in early.load_counts]
    return [int(frames[0]) + 1 for frames in reached if len(frames)]


def answer(early, grasp, rule):
    """Return the posterior that ends the ramp, and after how many frames; None where none does."""
    decider = EarlyDecider(early, (), rule)
    for number, counts in enumerate(grasp.counts, 1):
        if decider.add_frame(counts, partial(grasp.first_frames, number)):
            return decider.answer, number
    return None


def test_checks_come_in_order_and_use_no_later_frame(early, fresh):
    reached = [grasp for grasp in fresh if check_frames(early, grasp)]
    assert len(reached) > len(fresh) / 2
    for grasp in reached:
        checks = check_frames(early, grasp)
        assert checks == sorted(checks)
        assert check_frames(early, grasp.first_frames(checks[0])) == checks[:1]
        all_of_it = load_so_far(grasp, early.rest)
        part = load_so_far(grasp.first_frames(checks[0]), early.rest)
        assert part == pytest.approx(all_of_it[: checks[0]])
        assert all_of_it[checks[0] - 1] >= early.load_counts[0] > all_of_it[checks[0] - 2]


def test_a_lax_rule_ends_earlier_than_a_strict_one(early, fresh):
    lax = [answer(early, grasp, StopRule(error_rate=0.3)) for grasp in fresh]
    assert not any(answer(early, grasp, StopRule(error_rate=1e-6)) for grasp in fresh)
    ended = [(one, grasp) for one, grasp in zip(lax, fresh, strict=True) if one is not None]
    assert len(ended) > 0.5 * len(fresh)
    assert all(n_frames < grasp.n_frames for (_, n_frames), grasp in ended)
    assert np.mean([one.best == grasp.label for (one, _), grasp in ended]) > 0.8


def test_the_load_comes_frame_by_frame_as_over_the_whole_grasp(early, fresh):
    for grasp in fresh[:4]:
        running = RunningLoad(early.rest)
        one_by_one = [running.push(counts) for counts in grasp.counts]
        assert one_by_one == pytest.approx(load_so_far(grasp, early.rest).tolist())


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


def test_a_ramp_that_runs_is_decided_with_what_earlier_grasps_told(whole, early, fresh):
    rule = StopRule(error_rate=1e-3)
    sooner = 0
    for grasp in fresh:
        decider = EarlyDecider(early, (), rule)
        alone = [
            n for n, c in enumerate(grasp.counts, 1) if decider.add_frame(c, lambda g=grasp: g)
        ]
        known = Posterior(
            labels=whole.labels,
            probability=np.array([0.99 if n == grasp.label else 0.0 for n in whole.labels])
            + 0.01 / len(whole.labels),
            unknown=0.01,
        )
        more = EarlyDecider(early, (known, known), rule)
        fused = [n for n, c in enumerate(grasp.counts, 1) if more.add_frame(c, lambda g=grasp: g)]
        assert len(alone) <= 1
        assert bool(alone) is (decider.answer is not None)
        assert set(alone) | set(fused) <= set(check_frames(early, grasp))
        if decider.answer is not None and alone == fused:
            assert more.answer.probability == pytest.approx(decider.answer.probability)
        sooner += bool(fused) and (not alone or fused[0] < alone[0])
    assert sooner > len(fresh) / 4


def test_heads_come_back_from_their_arrays(whole, early, fresh):
    arrays = early.to_arrays()
    assert all(array.dtype.kind in "biufU" for array in arrays.values())
    early_classifiers = EarlyClassifiers.from_arrays(arrays, type(whole))
    assert check_frames(early_classifiers, fresh[0]) == check_frames(early, fresh[0])
    for one, was in zip(early_classifiers.recognizers, early.recognizers, strict=True):
        assert one.posterior(fresh[0]).probability == pytest.approx(
            was.posterior(fresh[0]).probability
        )
    for change in ({"load_counts": np.array([2.0, 1.0])}, {"load_counts": np.array([1.0, 2, 3])}):
        with pytest.raises((ValueError, KeyError)):
            EarlyClassifiers.from_arrays(arrays | change, type(whole))


def test_heads_have_the_drift_and_the_caution_of_the_whole_ramps(train, whole, early):
    label = train[0].label
    few = [g for g in train if g.label == label][:3] + [g for g in train if g.label != label][:3]
    two = [replace(g, label="one" if g.label == label else "other") for g in few]
    ramps = make_trainer("force_ramp", use_aperture=False).fit(two)
    drifted = replace(
        ramps, grid=DriftGrid(prior=DriftPrior(log_gain=-0.2, log_gain_sd=0.1)), caution=3.0
    )
    early_classifiers = replace(early, recognizers=(ramps, ramps))
    for one in early_classifiers.as_wary_as(drifted).recognizers:
        assert one.grid is drifted.grid
        assert one.caution == drifted.caution
    assert early.as_wary_as(whole) is early

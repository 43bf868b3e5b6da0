"""Decisions during the ramp: looks use no later frame, and a sure look ends the ramp."""

import numpy as np
import pytest

from recognition.early import EarlyTrainer, cut, load_so_far
from recognition.fusion import StopRule
from recognition.recognizers import make_trainer


@pytest.fixture(scope="module")
def early(train):
    return EarlyTrainer(base=make_trainer("shrinkage_lda"), shares=(0.3, 0.6)).fit(train)


def test_looks_come_in_order_and_use_no_later_frame(early, fresh):
    reached = [grasp for grasp in fresh if early.looks(grasp)]
    assert len(reached) > len(fresh) / 2
    for grasp in reached:
        looks = early.looks(grasp)
        assert list(looks) == sorted(looks)
        assert early.looks(cut(grasp, looks[0])) == looks[:1]
        whole = load_so_far(grasp, early.rest)
        part = load_so_far(cut(grasp, looks[0]), early.rest)
        assert part == pytest.approx(whole[: looks[0]])
        assert whole[looks[0] - 1] >= early.load_counts[0] > whole[looks[0] - 2]


def test_a_lax_rule_ends_earlier_than_a_strict_one(early, fresh):
    lax = [early.answer(g, StopRule(error_rate=0.3, max_unknown=0.9)) for g in fresh]
    strict = [early.answer(g, StopRule(error_rate=1e-6)) for g in fresh]
    assert np.mean([a.n_frames for a in lax]) < 0.8 * np.mean([g.n_frames for g in fresh])
    for answer, grasp in zip(strict, fresh, strict=True):
        assert not answer.decided
        assert answer.n_frames == grasp.n_frames
        assert answer.looks == len(early.looks(grasp)) + 1
    right = [a.posterior.best == g.label for a, g in zip(lax, fresh, strict=True)]
    assert np.mean(right) > 0.8


def test_each_look_can_be_asked_for(early, fresh):
    looks = [early.posterior_at(fresh[0], look) for look in range(3)]
    assert looks[2].probability == pytest.approx(early.whole.posterior(fresh[0]).probability)
    assert all(p.labels == early.labels for p in looks)
    assert looks[0].unknown != pytest.approx(looks[2].unknown)


def test_a_ramp_that_stays_below_a_load_is_judged_as_it_is(early, fresh):
    short = cut(fresh[0], early.looks(fresh[0])[0])
    with pytest.raises(IndexError):
        early.posterior_at(short, 1)
    assert early.answer(short, StopRule(error_rate=1e-6)).looks == 2


@pytest.mark.parametrize("shares", [(), (0.5, 0.5), (0.6, 0.3), (0.0, 0.5), (0.5, 1.0)])
def test_shares_are_parts_of_the_ramp_in_order(shares):
    with pytest.raises(ValueError, match="shares"):
        EarlyTrainer(base=make_trainer("shrinkage_lda"), shares=shares)

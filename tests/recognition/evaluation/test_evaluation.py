"""Splits and figures of merit against hand-made numbers."""

import dataclasses

import numpy as np
import pytest

from recognition.evaluation.evaluation import (
    auroc,
    confusion_matrix,
    evaluate,
    interval_by_object,
    wilson_interval,
)
from recognition.evaluation.splits import (
    a_day_later,
    chronological_split,
    left_out_parts,
    parse_split,
    series_names,
)
from recognition.grasp import by_label, series_of
from recognition.recognizers import make_trainer
from tests.cell.cells import plain_grasp


def test_chronological_split_teaches_with_the_earlier_part(train):
    first, last = chronological_split(train[::-1], 0.6)
    assert len(first) + len(last) == len(train)
    for label, members in by_label(train).items():
        early = [g.start_ms for g in first if g.label == label]
        late = [g.start_ms for g in last if g.label == label]
        assert len(early) == round(0.6 * len(members))
        assert max(early) < min(late)


@pytest.mark.parametrize("fraction", [0.05, 0.95])
def test_both_parts_get_something(train, fraction):
    first, last = chronological_split(train, fraction)
    assert {g.label for g in first} == {g.label for g in last} == {g.label for g in train}


def test_a_split_is_read_from_its_text_or_refused():
    assert parse_split("chronological:0.6") == 0.6
    for text in ("", "random:0.5", "chronological", "chronological:2"):
        with pytest.raises(ValueError, match="chronological:FRACTION"):
            parse_split(text)


def test_each_series_of_an_object_with_several_is_left_out_once(train):
    bars = [g for g in train if g.label == "bar"]
    grasps = [*train, *map(a_day_later, bars[:3])]
    parts = left_out_parts(grasps, series_names(grasps))
    assert [len(test) for _, test in parts] == [len(bars), 3]
    for taught, test in parts:
        assert {g.label for g in test} == {"bar"}
        assert len(taught) + len(test) == len(grasps)
        assert not {id(g) for g in taught} & {id(g) for g in test}
    with pytest.raises(ValueError, match="another day, or name the series"):
        left_out_parts(train, series_names(train))


def test_named_series_count_without_a_pause_and_across_one(train):
    bars = [g for g in train if g.label == "bar"]
    named = [dataclasses.replace(g, series="ab"[i % 2]) for i, g in enumerate(bars)]
    later = [a_day_later(g) for g in named if g.series == "a"]
    series = series_of([*bars, *named, *later])
    assert [{g.series for g in one} for one in series] == [{""}, {"a"}, {"b"}]
    assert len(series[1]) == 2 * len(later)


@pytest.mark.parametrize("label", ["", "bar\0"])
def test_a_grasp_without_label_is_refused(train, label):
    with pytest.raises(ValueError, match="no label"):
        chronological_split([dataclasses.replace(train[0], label=label)], 0.5)


def test_confusion_counts_truth_by_answer():
    table = confusion_matrix(["a", "a", "b"], ["a", "b", "b"], ("a", "b"))
    assert table.tolist() == [[1, 1], [0, 1]]
    with pytest.raises(ValueError, match="not listed"):
        confusion_matrix(["c"], ["a"], ("a", "b"))
    with pytest.raises(ValueError, match="answers"):
        confusion_matrix(["a"], [], ("a", "b"))


def test_wilson_interval_of_known_cases():
    assert wilson_interval(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="no proportion"):
        wilson_interval(3, 2)


def test_auroc_counts_pairs_in_order():
    assert (auroc([0, 1], [2, 3]), auroc([0, 2], [1, 3])) == (1.0, 0.75)
    assert auroc([1, 1], [1, 1]) == 0.5
    assert np.isnan(auroc([], [1]))
    weighted = auroc([0, 2], [1, 3], (np.array([[1, 1], [0, 2]]), np.ones((2, 2))))
    assert weighted.tolist() == [0.75, 0.5]


def test_an_interval_by_objects_is_wider_where_grasps_of_an_object_agree():
    objects = [name for name in "abcdefghijklmnop" for _ in range(20)]
    alike = [name != "a" for name in objects]
    apart = [n % 16 != 0 for n in range(320)]
    wide, narrow = (interval_by_object(right, objects) for right in (alike, apart))
    assert wide[1] - wide[0] > 3.0 * (narrow[1] - narrow[0])
    assert wide[0] < 0.9 < wide[1]
    assert interval_by_object([True] * 320, objects) == wilson_interval(16, 16)
    assert interval_by_object([False] * 320, objects) == wilson_interval(0, 16)
    assert interval_by_object(alike[:60], objects[:60]) == wilson_interval(2, 3)
    assert interval_by_object([], []) == (0.0, 1.0)
    assert interval_by_object([True, False], ["ball", "ball"]) == (0.0, 1.0)


def test_each_group_is_left_out_in_turn_without_what_nothing_else_teaches():
    grasps = [plain_grasp(name) for name in ["ball"] * 6 + ["box"] * 6 + ["cup"] * 2]
    parts = left_out_parts(grasps, ["a"] * 3 + ["b"] * 3 + ["a"] * 3 + ["b"] * 3 + ["b"] * 2)
    assert [(len(taught), len(test)) for taught, test in parts] == [(6, 6), (6, 6)]
    assert {g.label for part in parts for some in part for g in some} == {"ball", "box"}
    with pytest.raises(ValueError, match="none can be left out"):
        left_out_parts(grasps, ["a"] * len(grasps))


# -- The evaluation on made grasps -----------------------------------------------------------------


@pytest.fixture(scope="module")
def score(train, fresh):
    return evaluate([(train, fresh)], make_trainer("level_check"), unknown_groups=5)


@pytest.mark.slow
def test_figures_fit_each_other(score, fresh):
    assert score.n == len(fresh)
    assert (score.n_untaught, score.confusion.sum()) == (0, score.n)
    assert np.trace(score.confusion) / score.n == pytest.approx(score.single_accuracy)
    low, high = score.interval
    assert low <= score.single_accuracy <= high
    assert set(score.fused_accuracy) == {1, 2, 3, 5}
    assert score.fused_accuracy[1] == pytest.approx(score.single_accuracy)
    few = wilson_interval(len(score.labels) * score.unknown_auroc, len(score.labels))
    assert score.auroc_interval == pytest.approx(few)
    assert sum(n for _, _, n, _ in score.unknown_reliability) == 5 * score.n
    assert sum(new for *_, new in score.unknown_reliability) == score.n
    assert score.trainer == "level_check"


def test_grasps_of_two_individuals_are_not_fused(train, fresh):
    two = [dataclasses.replace(g, series=str(n % 2)) for n, g in enumerate(fresh)]
    trainer = make_trainer("level_check")
    both = [evaluate([(train, t)], trainer, fuse=(4,), unknown_groups=0) for t in (fresh, two)]
    assert [np.isnan(one.fused_accuracy[4]) for one in both] == [False, True]


def test_more_grasps_than_there_are_give_no_figure(train, fresh):
    short = evaluate([(train, fresh)], make_trainer("level_check"), fuse=(50,), unknown_groups=0)
    assert np.isnan(short.fused_accuracy[50])
    assert np.isnan(short.fused_interval[50][0])
    assert np.isnan(short.unknown_auroc)
    counts = np.array([[3, 1, 0], [2, 3, 0], [0, 0, 5]])
    mixed = dataclasses.replace(short, labels=("a", "b", "c"), confusion=counts)
    assert mixed.confused == (("b", "a", 2), ("a", "b", 1)), "the most frequent one first"


def test_untaught_objects_count_in_no_accuracy(train, fresh):
    some = [g for g in train if g.label != "egg"]
    score = evaluate([(some, fresh)], make_trainer("force_ramp"), unknown_groups=0)
    assert (score.n_untaught, score.n) == (5, len(fresh) - 5)
    assert score.unknown_auroc > 0.9


def test_few_labels_are_not_left_out(train, fresh):
    def pair(grasps):
        return [g for g in grasps if g.label in ("bar", "egg")]

    for taught, tested in ((pair(train), pair(fresh)), (train, pair(fresh))):
        assert np.isnan(evaluate([(taught, tested)], make_trainer("level_check")).unknown_auroc)


@pytest.mark.slow
def test_the_answers_of_all_parts_count_together(score, train, fresh):
    half = len(fresh) // 2
    parts = [(train, fresh[:half]), (train, fresh[half:])]
    both = evaluate(parts, make_trainer("level_check"), unknown_groups=0)
    assert both.n == score.n
    assert both.confusion.tolist() == score.confusion.tolist()
    assert both.named_right == score.named_right


def test_nothing_to_test_is_refused(train, fresh):
    renamed = [dataclasses.replace(g, label="other") for g in fresh]
    with pytest.raises(ValueError, match="taught object"):
        evaluate([(train, renamed)], make_trainer("level_check"))

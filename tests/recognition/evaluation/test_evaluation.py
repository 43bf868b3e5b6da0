"""The evaluation on made grasps, and the default recogniser on recorded ones."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from cell.data.dataset import read_dataset
from recognition.evaluation.evaluation import evaluate
from recognition.evaluation.splits import chronological_split
from recognition.recognizers import make_trainer


@pytest.fixture(scope="module")
def found(train, fresh):
    return evaluate([(train, fresh)], make_trainer("shrinkage_lda"), unknown_groups=5)


@pytest.mark.slow
def test_figures_fit_each_other(found, fresh):
    assert found.n == len(fresh)
    assert found.n_untaught == 0
    assert found.confusion.sum() == found.n
    assert np.trace(found.confusion) / found.n == pytest.approx(found.single_accuracy)
    low, high = found.interval
    assert low <= found.single_accuracy <= high
    assert set(found.fused_accuracy) == {1, 2, 3, 5}
    assert found.fused_accuracy[1] == pytest.approx(found.single_accuracy)
    assert 0.0 <= found.calibration_error <= 0.3
    assert 0.5 <= found.unknown_auroc <= 1.0
    assert 0.0 <= found.known_rejected <= 0.5
    assert found.trainer == "shrinkage_lda"


def test_more_grasps_than_there_are_give_no_figure(train, fresh):
    short = evaluate([(train, fresh)], make_trainer("shrinkage_lda"), fuse=(50,), unknown_groups=0)
    assert np.isnan(short.fused_accuracy[50])
    assert np.isnan(short.random_fused_accuracy[50])
    assert np.isnan(short.unknown_auroc)


def test_untaught_objects_count_in_no_accuracy(train, fresh):
    some = [g for g in train if g.label != "egg"]
    found = evaluate([(some, fresh)], make_trainer("shrinkage_lda"), unknown_groups=0)
    assert found.n_untaught == 5
    assert found.n == len(fresh) - 5
    assert found.unknown_auroc > 0.9


def test_few_labels_are_not_left_out(train, fresh):
    def pair(grasps):
        return [g for g in grasps if g.label in ("bar", "egg")]

    found = evaluate([(pair(train), pair(fresh))], make_trainer("shrinkage_lda"))
    assert np.isnan(found.unknown_auroc)


@pytest.mark.slow
def test_the_answers_of_all_parts_count_together(train, fresh):
    trainer = make_trainer("shrinkage_lda")
    half = len(fresh) // 2
    both = evaluate([(train, fresh[:half]), (train, fresh[half:])], trainer, unknown_groups=0)
    whole = evaluate([(train, fresh)], trainer, unknown_groups=0)
    assert both.n == whole.n
    assert both.confusion.tolist() == whole.confusion.tolist()
    assert both.named_right == whole.named_right


def test_nothing_to_test_is_refused(train, fresh):
    renamed = [dataclasses.replace(g, label="other") for g in fresh]
    with pytest.raises(ValueError, match="taught object"):
        evaluate([(train, renamed)], make_trainer("shrinkage_lda"))


@pytest.mark.shared_data
@pytest.mark.skipif(
    "TACTILE_CELL_DATA" not in os.environ,
    reason="TACTILE_CELL_DATA does not name the folder of recorded grasps",
)
def test_recorded_grasps_are_named():
    # Only the earlier part of the recording: the later part is for the benchmark alone.
    recorded = read_dataset(Path(os.environ["TACTILE_CELL_DATA"]) / "pinch36.npz")
    earlier, _ = chronological_split(recorded, 0.6)
    train, test = chronological_split(earlier, 0.7)
    found = evaluate([(train, test)], make_trainer("force_ramp"), unknown_groups=2)
    assert found.single_accuracy > 0.94
    assert found.fused_accuracy[3] > 0.95
    assert found.unknown_auroc > 0.93

"""Identification without a cell: when a sequence ends, what is fused, what cannot spoil it."""

from dataclasses import replace
from typing import Any, cast

import pytest

from cell.control.identification import Identification, grasp_and_classify
from cell.control.keeping import Judge
from cell.control.records import GraspRecord
from cell.errors import CellError, ConfigError
from cell.learning.pad_knowledge import PadKnowledge
from cell.learning.shape_reading import in_words, shape_reader
from recognition.recognizer import UNKNOWN, Posterior
from recognition.shape.foam import FoamModel
from recognition.statistics.fusion import DecisionKind
from tests.cell.conftest import SURE, UNSURE, Scripted, small_config
from tests.values import raising


@pytest.fixture
def record(taught: Any) -> GraspRecord:
    """Return a grasp of the ball without its label."""
    ball: GraspRecord = taught.result.trials[0].records[0]
    return replace(ball, grasp=replace(ball.grasp, label=""))


def identified(
    record: GraspRecord,
    *answers: tuple[float, float],
    drawn_m: tuple[float, ...] = (),
    n_steps: int = 2,
    **options: Any,
) -> Identification:
    """Identify with a hand whose grasps are all the same; sure at the second one by default."""

    def grasp(_step: object, _looks: object, judge: Judge) -> tuple[GraspRecord, bool]:
        judge.start_answer(record)
        return record, False

    recognizer = Scripted(*(answers or (UNSURE, SURE)), drawn_m=drawn_m)
    return grasp_and_classify(
        grasp, recognizer, [record.step] * n_steps, error_rate=0.02, **options
    )


def test_identifying_ends_as_soon_as_it_is_sure_or_with_its_plan(record: GraspRecord) -> None:
    told: list[int] = []
    found = identified(record, n_steps=5, on_grasp=lambda number, *_told: told.append(number))
    assert (found.label, found.decision.kind) == ("ball", DecisionKind.DECIDED)
    assert told == [1, 2]
    assert len(found.records) == len(found.posteriors) == 2
    certain = found.decision.probability
    assert certain == pytest.approx(float(found.fused.probability.max()), abs=1e-6)
    assert certain > 0.98
    found = identified(record, UNSURE)
    assert len(found.records) == 2
    assert found.decision.kind is not DecisionKind.CONTINUE


@pytest.mark.slow
def test_shape_and_size_are_fused_over_the_grasps(record: GraspRecord) -> None:
    told: list[Any] = []
    found = identified(
        record,
        read_shape=shape_reader(small_config()),
        on_grasp=lambda *parts: told.append(parts[3]),
    )
    assert tuple(told) == found.shapes
    assert found.shape is not None
    assert len(found.shapes) == found.shape.n_grasps == 2
    assert {one.kind for one in told} == {found.shape.kind}
    assert found.shape.kind in ("sphere", "oval")  # one ball in forty is felt as an oval
    assert found.shape.low_m < 9.5e-3 < found.shape.high_m
    assert f"{found.shape.kind} of {1e3 * found.shape.size_m:.1f} mm" in in_words(found.shape)


@pytest.mark.slow
def test_the_label_does_not_hang_on_shapes_and_on_who_is_told(record: GraspRecord) -> None:
    read = shape_reader(small_config())
    assert read is not None
    for options, complaint in (
        ({"on_grasp": raising(CellError("closed"))}, "after grasp 1: closed"),
        ({"read_shape": raising(CellError("no law"))}, "shape of grasp 1: no law"),
        (
            {"read_shape": lambda grasp: replace(read(grasp), evidence=())},
            "shape of all grasps: unexpected error (ValueError): a fused shape",
        ),
    ):
        found = identified(record, **options)
        assert (found.label, found.shape) == ("ball", None)
        assert len(found.posteriors) == 2
        assert found.complaints[0].startswith(complaint)
    assert identified(record, read_shape=lambda _grasp: None).shapes == (None, None)


@pytest.mark.slow
@pytest.mark.parametrize(("drawn_m", "label"), [((4e-3,), UNKNOWN), ((4e-3, 9.5e-3), "ball")])
def test_a_felt_size_far_from_the_drawn_ones_is_of_no_taught_object(record, drawn_m, label) -> None:
    told: list[Posterior] = []
    found = identified(
        record,
        drawn_m=drawn_m,
        read_shape=shape_reader(small_config()),
        on_grasp=lambda *parts: told.append(parts[2]),
    )
    assert found.label == found.fused.name == label
    assert tuple(told) == found.posteriors


def test_a_config_may_want_no_shapes() -> None:
    config = small_config(recognition__shape=False)
    assert shape_reader(config, PadKnowledge(foam=FoamModel())) is None
    gauged = PadKnowledge(foam=FoamModel(), fit=cast("Any", "of a gauge"))
    with pytest.raises(ConfigError, match="a gauge serves shape and size"):
        shape_reader(config, gauged)

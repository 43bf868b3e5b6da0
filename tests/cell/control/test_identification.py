"""A sequence without a cell: its plan, one grasp, and when an identification ends."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from cell.config.sequence import (
    LinearRampConfig,
    SCurveRampConfig,
    SequenceConfig,
    StaircaseRampConfig,
    ramp_from_config,
)
from cell.control.controller import CellController
from cell.control.grasping import Grasper
from cell.control.identification import Identification, Judge
from cell.control.plan import GraspStep, Pose, plan
from cell.control.records import GraspRecord
from cell.errors import CellError, NoPartFound
from cell.learning.shape_reading import in_words, shape_reader
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import DecisionKind
from tactile.layout import paper_layout
from tests.cell.conftest import SURE, UNSURE, Scripted, small_config
from tests.fuzz.harness import Clock
from tests.values import raising


def test_random_plan_stays_in_its_ranges_and_repeats_with_its_seed() -> None:
    config = SequenceConfig()
    steps = plan(config, 200, seed=3)
    assert steps == plan(config, 200, seed=3)
    assert steps != plan(config, 200, seed=4)
    for step in steps:
        assert abs(step.pose.x_m) <= 2e-3
        assert abs(step.pose.y_m) <= 2e-3
        assert 0.0 <= step.pose.rotation_rad <= 2 * math.pi
        assert 2.0 <= step.force_n <= 8.0
    assert len({step.pose for step in steps}) == 200


def test_grid_visits_each_point_once_before_it_repeats() -> None:
    config = SequenceConfig(
        kind="grid", x_mm=(-1.0, 1.0), y_mm=(0.0, 0.0), roll_deg=(0.0, 0.0), force_n=(4.0, 4.0)
    )
    steps = plan(config, 18, seed=0)
    assert len({step.pose for step in steps}) == 9
    assert steps[:9] == steps[9:]
    assert {step.pose.x_m for step in steps} == {-1e-3, 0.0, 1e-3}


def test_list_is_taken_in_order_and_anew() -> None:
    config = SequenceConfig(
        kind="list",
        poses=({"x_mm": 1.0, "force_n": 3.0}, {"rotation_deg": 90.0}),  # type: ignore[arg-type]
    )
    steps = plan(config, 3, seed=0)
    assert steps[0].pose == Pose(x_m=1e-3)
    assert (steps[0].force_n, steps[1].pose.rotation_rad) == (3.0, pytest.approx(math.pi / 2))
    assert steps[2] == steps[0]


def test_no_plan_is_empty_and_no_pose_is_not_finite() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        plan(SequenceConfig(), 0, seed=0)
    with pytest.raises(ValueError, match="x_m"):
        Pose(x_m=math.nan)
    assert str(Pose(x_m=1e-3, rotation_rad=math.pi)).startswith(
        "x +1.0 mm, y +0.0 mm, rotation 180"
    )


@pytest.mark.parametrize(
    "config",
    [LinearRampConfig(), StaircaseRampConfig(kind="staircase"), SCurveRampConfig(kind="s_curve")],
)
def test_ramps_of_the_config_end_at_the_wanted_force(config) -> None:
    ramp = ramp_from_config(config, 5.0)
    assert ramp.final_n == 5.0
    assert ramp.setpoint_n(ramp.duration_s) == pytest.approx(5.0)


# -- One grasp without a cell ----------------------------------------------------------------------


@pytest.fixture
def grasper() -> Grasper:
    """A grasper whose hand finds nothing, and whose sensor sends no frame."""
    released: list[Callable[..., Any]] = []
    hand: Any = SimpleNamespace(
        layout=paper_layout(),
        period_s=0.005,
        phase=GripperPhase.IDLE,
        largest_ramp_n=12.0,
        check_ramp=lambda _ramp: None,
        open=lambda _watch: None,
        grasp=lambda _ramp, _watch: SimpleNamespace(result=GraspResult.NO_CONTACT),
        release=released.append,
        released=released,
    )
    positioner: Any = SimpleNamespace(blocks=False, move_to=lambda pose, *_: pose)
    return CellController(small_config(), hand, positioner, clock=Clock())._grasper


def test_fingers_that_close_before_a_frame_comes_open_again(grasper: Grasper) -> None:
    with pytest.raises(NoPartFound, match="had closed before a frame of the taxels came"):
        grasper.grasp(GraspStep(pose=Pose(), force_n=3.0), "")
    assert len(grasper.hand.released) == 1  # type: ignore[attr-defined]
    assert grasper.life.result is GraspResult.NO_CONTACT


def test_servos_that_carry_less_than_asked_for_end_the_ramp_there_with_one_note(
    grasper: Grasper, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand: Any = grasper.hand
    finals_n, notes = [], []
    monkeypatch.setattr(grasper.journal, "note", lambda _kind, text: notes.append(text))

    def grasp(ramp: ForceRamp, _watch: object) -> Any:
        finals_n.append(ramp.final_n)
        return SimpleNamespace(result=GraspResult.NO_CONTACT)

    hand.grasp, hand.largest_ramp_n = grasp, 4.0
    for force_n in (3.0, 6.0, 6.0):
        with pytest.raises(NoPartFound):
            grasper.grasp(GraspStep(pose=Pose(), force_n=force_n), "")
    assert finals_n == pytest.approx([3.0, 3.6, 3.6])
    (note,) = notes
    assert "grasps end at 3.6 N, 6.0 N were asked for" in note
    assert "current_max_a" in note
    # What the config itself does not allow is refused as ever.
    hand.check_ramp = lambda ramp: finals_n.append(ramp.final_n)
    grasper.check(GraspStep(pose=Pose(), force_n=40.0))
    assert finals_n[-1] == 40.0


# -- Identification without a cell: when a sequence ends, what is fused, what cannot spoil it ------


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
    plan = [record.step] * n_steps
    return Judge(recognizer=recognizer, plan=plan, error_rate=0.02, **options).identify(grasp)


@pytest.mark.slow
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
        assert (found.label, found.shape, len(found.posteriors)) == ("ball", None, 2)
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
    assert shape_reader(small_config(recognition__shape=False)) is None

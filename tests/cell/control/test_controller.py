"""The controller in virtual time: what it does, and what it leaves when something goes wrong."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.config.sequence import RampConfig, SequenceConfig
from cell.control.controller import CellController
from cell.control.identification import Identification, Judge
from cell.control.plan import GraspStep, Pose, plan
from cell.control.records import GraspRecord, pad_array, spliced
from cell.control.states import CellState, GraspState
from cell.errors import CellError, CellStateError, CellStopped, NoPartFound, PlanRefused
from cell.learning.shape_reading import shape_reader
from cell.recording.reader import read_recording
from gripper.errors import GripperError, LimitExceeded
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from recognition.grasp import ZERO_COLUMNS, SelfZero
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import DecisionKind
from tests.cell.cells import (
    SURE,
    UNSURE,
    MakeBench,
    Scripted,
    plain_grasp,
    quick_config,
    small_config,
)
from tests.cell.served import stub_cell
from tests.marks import LONG
from tests.values import raising

RAMPING, OPENING = GripperPhase.RAMPING, GripperPhase.OPENING
APPROACHING, RELEASING = GripperPhase.APPROACHING, GripperPhase.RELEASING
OPEN_M = quick_config().gripper.aperture_open_mm * 1e-3


# -- grasps ----------------------------------------------------------------------------------


def test_each_frame_has_the_opening_and_the_set_point_of_its_period(bench: Any) -> None:
    record = bench.ready().grasp(4.0, Pose(x_m=1e-3))
    assert (record.outcome.result, bench.grip_n) == (GraspResult.FORCE_REACHED, 0.0)
    assert (record.reached.x_m, record.step.force_n) == (1e-3, 4.0)
    grasp, cycles = record.grasp, record.cycles
    assert grasp.pads.same_as(pad_array(bench.controller.hand.layout))
    assert (grasp.label, grasp.source) == ("", "cell simulated cell")
    np.testing.assert_allclose(np.diff(grasp.t_s), 0.02, atol=2e-3)
    assert np.all(np.diff(grasp.aperture_m) < 3e-4)
    assert grasp.aperture_m[0] == pytest.approx(OPEN_M, abs=1e-3)
    assert grasp.aperture_m[-1] < 9.5e-3
    assert (grasp.force_n[0], grasp.force_n[-1]) == (0.0, 4.0)
    assert np.all(np.diff(grasp.force_n) >= 0.0)
    pairs = {(cycle.state.aperture_m, cycle.setpoint_n) for cycle in cycles}
    assert set(zip(grasp.aperture_m.tolist(), grasp.force_n.tolist(), strict=True)) <= pairs
    phases = [cycle.phase for cycle in cycles]
    assert phases == sorted(phases, key=[APPROACHING, RAMPING].index)
    pressed = grasp.counts.astype(int)
    assert pressed[-1].max() > pressed[0].max() + 40


@pytest.mark.parametrize("seed", [5, 10])
def test_a_stiff_finger_that_a_person_left_open_is_brought_back(make_bench, seed: int) -> None:
    bench = make_bench(quick_config(seed=seed))
    bench.simulated.devices.mechanics.move_by_hand(0, 0.02)
    bench.clock.sleep(1.0)
    assert bench.start().aperture_m == pytest.approx(0.012, abs=1e-3)


def test_a_machine_clock_set_back_leaves_the_grasps_in_order(bench, monkeypatch) -> None:
    bench.controller.start()
    bench.controller.moves.present("box")
    (step,) = plan(bench.config.sequence, 1, seed=4)
    before_ms = bench.controller.grasp(step).grasp.start_ms
    monkeypatch.setattr("time.time_ns", lambda: (before_ms - 60_000) * 1_000_000)
    assert bench.controller.grasp(step).grasp.start_ms == before_ms + 1
    monkeypatch.setattr("time.time_ns", lambda: 1_000_000_000)
    assert bench.controller.grasp(step).grasp.start_ms == 1_000


def test_a_part_that_sinks_into_the_foam_is_held_with_what_it_bears(make_bench, tmp_path) -> None:
    pin = {"label": "pin", "shape": "cylinder:diameter=3mm,length=20mm"}
    config = quick_config(gripper__aperture_min_mm=0.0, simulator__objects=[pin])
    bench = make_bench(config, folder=tmp_path).ready("pin")
    record = bench.controller.grip(8.0, Pose())
    assert record.outcome.result is GraspResult.FORCE_NOT_REACHED
    assert "8.0 N were asked for: the part is too small" in record.ended
    bench.idle(0.5)
    assert bench.controller.kept_part.verify().same
    bench.controller.release()
    # The cell goes on, and takes closed fingers for empty as before.
    bench.once_in(APPROACHING, bench.simulated.remove)
    with pytest.raises(NoPartFound, match=r"no contact at pose x \+0\.0 mm.*is the object in pla"):
        bench.grasp(8.0)
    assert (bench.life.state, bench.life.grasp_state) == (CellState.IDLE, GraspState.NO_PART_FOUND)
    assert (bench.life.fault, bench.aperture_m) == (None, pytest.approx(OPEN_M, abs=5e-4))
    bench.cell.close()
    recording = read_recording(tmp_path / "recording.mcap")
    events = recording.events
    assert len(recording.grasps) == 1
    assert [event["kind"] for event in events].count("no part") == 1
    assert ("verify", "the same part") in {(event["kind"], event["text"]) for event in events}
    (told,) = (event["text"] for event in events if event["kind"] == "ramp")
    assert re.search(r"8\.0 N were.* or soft.*min_mm is 0\)", told)


def test_the_recording_holds_what_happened(make_bench: MakeBench, tmp_path: Path) -> None:
    bench = make_bench(quick_config(recognition__shape=True), folder=tmp_path).ready()
    answer = bench.controller.identify(
        Scripted(SURE),
        [GraspStep(pose=Pose(), force_n=3.0)],
        read_shape=shape_reader(bench.config),
        on_grasp=raising(RuntimeError("window closed")),
    )
    bench.cell.close()
    recording = read_recording(tmp_path / "recording.mcap")
    (result,) = recording.results
    assert result["label"] == "ball"
    assert result["shape"]["size_m"] == pytest.approx(answer.shape.size_m, abs=1e-6)
    assert [one["kind"] for one in result["grasp_shapes"]] == [answer.shape.kind]
    texts = [event["text"] for event in recording.events if event["kind"] == "callback"]
    assert texts == ["after grasp 1: unexpected error (RuntimeError): window closed"]
    assert [loop["overruns"] for loop in recording.statistics] == [0, 0]
    after_grasp, at_end = recording.statistics
    assert 100 < after_grasp["cycles"] <= at_end["cycles"]
    assert after_grasp["lateness"]["max_s"] < 1e-6
    assert 2e-4 < after_grasp["transaction"]["p50_s"] < 5e-3
    assert 0.0 < after_grasp["sensor_age"]["max_s"] < 0.1
    assert set(recording.cycles.phase) == {"OPENING", "APPROACHING", "RAMPING", "RELEASING"}


def test_forces_that_are_not_allowed_and_what_is_no_plan_are_refused_before_anything_moves(
    bench: Any,
) -> None:
    control = bench.ready().controller
    began_s = bench.clock.monotonic()
    good, bad, none = (GraspStep(pose=Pose(), force_n=n) for n in (3.0, 14.9, math.nan))
    nothing: Any = None
    above = r"13\.64 N, so that its overshoot stays below fo"
    for error, complaint, ask, *given in (
        (LimitExceeded, above, control.grasp, bad),
        (LimitExceeded, above, control.check_plan, [good, bad]),
        (LimitExceeded, above, control.identify, Scripted(UNSURE), [good, bad]),
        (LimitExceeded, "must be finite", control.grasp, none),
        (PlanRefused, "None is not a step", control.grasp, nothing),
        (PlanRefused, "is not a step", control.grasp, GraspStep(pose=nothing, force_n=3.0)),
        (PlanRefused, "None is not a label", control.check_plan, [good], nothing),
        (PlanRefused, "is UNKNOWN, the answer for untau", control.check_plan, [good], "UNKNOWN"),
        (PlanRefused, "the plan is empty", control.check_plan, []),
        (PlanRefused, "the plan is empty", control.identify, Scripted(SURE), []),
    ):
        with pytest.raises(error, match=complaint):
            ask(*given)
    assert bench.clock.monotonic() == began_s
    assert (bench.life.state, bench.life.fault) == (CellState.IDLE, None)


# -- stopping --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "after_s", "least_n"), [(RAMPING, 0.3, 1.0), (APPROACHING, 0.2, 0.0)]
)
def test_cancelling_keeps_the_grip_until_it_is_released(bench, phase, after_s, least_n) -> None:
    bench.ready()
    bench.once_in(phase, bench.life.cancel, after_s)
    left = (
        "the grip is kept" if phase is RAMPING else r"stopped while closing, .* may touch the pads"
    )
    with pytest.raises(CellStopped, match=f"{left} until it is released on purpose"):
        bench.grasp(6.0)
    assert bench.life.state is CellState.HELD
    assert bench.life.holding
    assert bench.grip_n >= least_n
    bench.idle(1.0)
    assert least_n <= bench.grip_n < 6.6
    bench.controller.release()
    assert (bench.life.state, bench.grip_n) == (CellState.IDLE, 0.0)


def test_cancelling_between_two_grasps_leaves_the_fingers_open(bench: Any) -> None:
    bench.ready()
    bench.grasp()
    bench.life.cancel()
    with pytest.raises(CellStopped, match="between two grasps; the fingers are open"):
        bench.controller.identify(Scripted(SURE), [GraspStep(pose=Pose(), force_n=3.0)])
    assert (bench.life.state, bench.grip_n) == (CellState.IDLE, 0.0)
    bench.life.cancel()
    bench.life.forget_cancel()
    bench.grasp()


@pytest.mark.parametrize("again", ["release", "release_held"])
def test_a_release_can_be_stopped_too(bench: Any, again: str) -> None:
    bench.ready()
    bench.once_in(RAMPING, bench.life.cancel, 0.2)
    with pytest.raises(CellStopped):
        bench.grasp(6.0)
    if again == "release_held":
        bench.controller.shutdown()
    bench.once_in(RELEASING, bench.life.cancel, 0.03)
    with pytest.raises(
        CellStopped, match=r"letting go, at an opening .* may still touch the pads until"
    ):
        getattr(bench.controller, again)()
    assert bench.life.holding
    assert bench.life.state.value == ("HELD" if again == "release" else "STOPPED")
    getattr(bench.controller, again)()
    assert not bench.life.holding
    assert bench.grip_n == 0.0


MOTIONS: dict[str, Callable[[Any], object]] = {
    "start": lambda bench: bench.controller.start(),
    "zero": lambda bench: bench.controller.zeroing.measure(),
    "grasp": lambda bench: bench.grasp(6.0),
    "release": lambda bench: bench.controller.release(),
    "release_held": lambda bench: bench.controller.release_held(),
}


@pytest.mark.parametrize(
    ("motion", "phase", "after_s"),
    [
        ("start", OPENING, 0.0),
        ("zero", APPROACHING, 0.3),
        ("zero", RAMPING, 0.5),
        LONG("zero", GripperPhase.HOLDING, 4.0),  # one finger presses and yields
        LONG("zero", RELEASING, 0.1),
        LONG("zero", OPENING, 9.5),  # measures friction
        ("grasp", APPROACHING, 0.1),
        ("grasp", RAMPING, 0.3),
        ("release", RELEASING, 0.03),
        ("release_held", RELEASING, 0.03),
    ],
)
def test_an_interrupt_stops_each_motion_within_two_periods(bench, motion, phase, after_s) -> None:
    if motion != "start":
        bench.ready("nothing" if motion == "zero" else "ball")
    if motion.startswith("release"):
        bench.controller.grip(6.0, Pose())
    if motion == "release_held":
        bench.controller.shutdown()
    at_s = bench.once_in(phase, bench.life.interrupt, after_s)
    with pytest.raises(CellStopped, match="no part was gripped" if motion == "start" else None):
        MOTIONS[motion](bench)
    assert bench.clock.monotonic() - at_s[0] <= 2.0 * bench.controller.hand.period_s + 1e-6
    opening_m = bench.aperture_m
    bench.sleep(0.5)
    # No later motion begins, unlike after a cancel.
    for again in MOTIONS.values():
        with pytest.raises((CellStopped, CellStateError)):
            again(bench)
    assert bench.aperture_m == pytest.approx(opening_m, abs=1e-3)


# -- faults ----------------------------------------------------------------------------------


def test_a_stop_that_finds_the_servos_gone_is_a_fault(bench: Any) -> None:
    bench.ready()

    def stop_and_unplug() -> None:
        bench.life.cancel()
        bench.simulated.inject("servos.unplugged")

    bench.once_in(RAMPING, stop_and_unplug, 0.2)
    with pytest.raises(GripperError):
        bench.grasp(6.0)
    assert bench.life.state is CellState.ABORTED
    assert bench.grip_n > 0.5


# -- A sequence without a cell: its plan, one grasp, and when an identification ends ---------------


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


def test_a_further_ramp_follows_the_frames_of_the_first_one_before_it() -> None:
    zero = SelfZero(**dict.fromkeys(ZERO_COLUMNS, 0.01))
    first, further = plain_grasp("ball"), plain_grasp("ball", t_s=np.arange(12) * 0.02, zero=zero)
    whole = spliced(first, further, 1.0)
    assert whole.zero == zero
    assert np.flatnonzero(first.force_n < 1.0).tolist() == [0, 1, 2]
    assert whole.t_s[:6].tolist() == pytest.approx([0.0, 0.03, 0.06, 0.08, 0.1, 0.12])
    assert spliced(first, further, 0.0).t_s.tolist() == further.t_s.tolist()


def test_list_is_taken_in_order_and_anew() -> None:
    listed = ({"x_mm": 1.0, "force_n": 3.0}, {"rotation_deg": 90.0})
    steps = plan(SequenceConfig.model_validate({"poses": listed}), 3, seed=0)
    assert steps[0].pose == Pose(x_m=1e-3)
    assert (steps[0].force_n, steps[1].pose.rotation_rad) == (3.0, pytest.approx(math.pi / 2))
    assert steps[2] == steps[0]


def test_no_plan_is_empty_and_no_pose_is_not_finite() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        plan(SequenceConfig(), 0, seed=0)
    with pytest.raises(ValueError, match="x_m"):
        Pose(x_m=math.nan)
    pose = str(Pose(x_m=1e-3, rotation_rad=math.pi))
    assert pose.startswith("x +1.0 mm, y +0.0 mm, rotation 180")


def test_a_ramp_of_the_config_grows_at_its_rate_and_is_held() -> None:
    assert RampConfig(rate_n_s=10.0, hold_s=0.2).to(6.0) == ForceRamp.linear(6.0, 10.0, 0.2)


# -- One grasp without a cell ----------------------------------------------------------------------


@pytest.fixture
def controller() -> CellController:
    """A controller whose hand finds nothing, and whose sensor sends no frame."""
    made = stub_cell(small_config()).controller
    made.hand.configure_mock(largest_ramp_n=12.0)
    made.hand.grasp.return_value.result = GraspResult.NO_CONTACT
    made.life.state = CellState.IDLE
    return made


def test_fingers_that_close_before_a_frame_comes_open_again(controller: CellController) -> None:
    with pytest.raises(NoPartFound, match="had closed before a frame of the taxels came"):
        controller.grasp(GraspStep(pose=Pose(), force_n=3.0))
    controller.hand.release.assert_called_once()  # type: ignore[attr-defined]
    assert controller.life.result is GraspResult.NO_CONTACT
    assert (controller.life.state, controller.life.fault) == (CellState.IDLE, None)
    assert controller.life.status.fault_number == 0


def test_servos_that_carry_less_than_asked_for_end_the_ramp_there_with_one_note(
    controller: CellController, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand: Any = controller.hand
    notes: list[tuple[str, str]] = []
    monkeypatch.setattr(controller.journal, "note", lambda *note: notes.append(note))
    hand.largest_ramp_n = 4.0
    for force_n in (3.0, 6.0, 6.0):
        with pytest.raises(NoPartFound):
            controller.grasp(GraspStep(pose=Pose(), force_n=force_n))
    finals_n = [call.args[0].final_n for call in hand.grasp.call_args_list]
    assert finals_n == pytest.approx([3.0, 3.6, 3.6])
    ((_, note),) = (one for one in notes if one[0] == "note")
    assert "grasps end at 3.6 N, 6.0 N were asked for" in note
    assert "current_max_a" in note
    # What the config itself does not allow is refused as ever.
    controller._check_step(GraspStep(pose=Pose(), force_n=40.0))
    assert hand.check_ramp.call_args.args[0].final_n == 40.0


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

    def grasp(_step: object, judge: Judge) -> tuple[GraspRecord, bool]:
        judge.start_answer(record)
        return record, False

    recognizer = Scripted(*(answers or (UNSURE, SURE)), drawn_m=drawn_m)
    plan = [record.step] * n_steps
    return Judge(recognizer=recognizer, plan=plan, error_rate=0.02, **options).identify(grasp)


def test_identifying_ends_as_soon_as_it_is_sure_or_with_its_plan(record: GraspRecord) -> None:
    told: list[int] = []
    answer = identified(record, n_steps=5, on_grasp=lambda number, *_told: told.append(number))
    assert (answer.label, answer.decision.kind) == ("ball", DecisionKind.DECIDED)
    assert told == [1, 2]
    assert len(answer.records) == len(answer.posteriors) == 2
    certain = answer.decision.probability
    assert certain == pytest.approx(float(answer.fused.probability.max()), abs=1e-6)
    assert certain > 0.98
    answer = identified(record, UNSURE)
    assert len(answer.records) == 2
    assert answer.decision.kind is not DecisionKind.CONTINUE


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
        answer = identified(record, **options)
        assert (answer.label, answer.shape, len(answer.posteriors)) == ("ball", None, 2)
        assert answer.complaints[0].startswith(complaint)
    closed = replace(record, outcome=replace(record.outcome, unreached="the part is too small"))
    for one, reads in ((record, lambda _grasp: None), (closed, read)):
        assert identified(one, read_shape=reads).shapes == (None, None)


@pytest.mark.parametrize(("drawn_m", "label"), [((4e-3,), UNKNOWN), ((4e-3, 9.5e-3), "ball")])
def test_a_size_far_from_the_drawn_ones_is_of_no_taught_object(record, drawn_m, label) -> None:
    told: list[Posterior] = []
    answer = identified(
        record,
        drawn_m=drawn_m,
        read_shape=shape_reader(small_config()),
        on_grasp=lambda *parts: told.append(parts[2]),
    )
    assert answer.label == answer.fused.name == label
    assert tuple(told) == answer.posteriors

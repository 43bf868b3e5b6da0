"""Parts that stay in the grip: kept by an identification or a grip, verified, carried, let go."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.control.kept_part import HeldPart, compared
from cell.control.plan import GraspStep, Keep, Pose
from cell.control.positioner import Destination, HostPlaces, OperatorPositioner
from cell.control.states import CellState, GraspState
from cell.errors import CellStopped, PositionerError, RecordingError
from cell.hand.interface import LiveValues
from cell.hand.local import LocalHand
from gripper.errors import PartLost
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN
from tactile.errors import TactileError
from tests.cell.cells import STRANGE, SURE, UNSURE, Bench, MakeBench, Scripted, quick_config

CARRY_N = 4.0
"""Default of `sequence.carry_force_n`."""
TOLERANCE_N = 0.7
STEPS = tuple(
    GraspStep(pose=Pose(x_m=1e-3 * x), force_n=force_n)
    for x, force_n in ((0.0, 6.0), (1.0, 3.0), (-1.0, 5.0))
)


@pytest.fixture
def bench(bench: Bench) -> Bench:
    """A cell that is ready, with the ball at its place."""
    return bench.ready()


def identify(bench: Any, recognizer: Scripted, keep: Keep, steps: Any = STEPS[:1]) -> Any:
    return bench.controller.identify(recognizer, steps, keep=keep)


# -- what is kept ----------------------------------------------------------------------------


def test_what_is_shown_of_a_carried_part_is_what_its_supervision_measures(make_bench) -> None:
    bench = make_bench(quick_config(tactile__tare_frames=25)).ready()
    bench.idle(0.05)
    live = bench.controller.live
    assert live.force_n == pytest.approx(0.0, abs=0.1)
    assert live.opening_mm == pytest.approx(12.0, abs=0.1)
    identify(bench, Scripted(SURE), Keep.ALWAYS)
    measured_n, true_n = [], []
    for _ in range(100):
        bench.idle(0.01)
        live = bench.controller.live
        measured_n.append(live.force_n)
        true_n.append(bench.grip_n)
        # The noise of one sample is 0.26 N.
        assert (live.force_n, live.setpoint_n) == (pytest.approx(bench.grip_n, abs=1.3), CARRY_N)
        assert live.force_age_s <= 0.01
        assert live.frame_age_s <= 0.05
    assert np.mean(measured_n) == pytest.approx(np.mean(true_n), abs=0.1)
    assert len(set(measured_n)) > 80  # of 100: no stale value
    counts = live.counts
    bench.idle(0.05)
    assert np.any(bench.controller.live.counts != counts)


def test_a_look_at_the_part_waits_for_a_frame(make_bench) -> None:
    frames = {"force_period_ms": 0, "sync_period_ms": 40.0, "silence_ms": 200.0}
    frames |= {"loss_max_share": 0.5, "heartbeat_ms": 500}
    slow = {f"tactile__{key}": value for key, value in frames.items()}
    bench = make_bench(quick_config(**slow, gripper__force_stale_ms=300.0)).ready("ball")
    identify(bench, Scripted(SURE), Keep.ALWAYS)
    bench.simulated.inject("can.loss=1@0ms..125ms")
    assert bench.controller.kept_part.verify().same


def test_what_is_not_measured_is_not_shown_and_its_age_grows(bench: Any) -> None:
    identify(bench, Scripted(SURE), Keep.ALWAYS)
    bench.sleep(2.0)  # nobody ticks
    live = bench.controller.live
    assert live.force_age_s == pytest.approx(2.0, abs=0.05)
    assert live.frame_age_s == pytest.approx(2.0, abs=0.05)
    none = (live.force_n, live.setpoint_n, live.opening_mm, live.temperature_c, live.counts)
    assert none == (None,) * 5
    bench.simulated.inject("unit.off")
    with pytest.raises(TactileError):
        bench.idle(1.0)
    assert bench.life.state is CellState.ABORTED
    assert bench.life.fault.endswith(" s after the answer")
    assert bench.controller.live == LiveValues()


def test_a_lost_recording_that_is_a_fault_of_grasps_does_not_keep_a_part(
    make_bench: MakeBench, tmp_path: Path
) -> None:
    bench = make_bench(quick_config(recording__when_lost="hold"), folder=tmp_path).ready()
    identify(bench, Scripted(SURE), Keep.ALWAYS)
    recorder: Any = bench.cell._recorder
    recorder.fault = RecordingError("No space left")
    bench.controller.release()
    recorder.fault = None
    assert (bench.life.state, bench.grip_n) == (CellState.IDLE, 0.0)


@pytest.mark.parametrize(
    ("answers", "keep", "kept"),
    [
        ((UNSURE, SURE), Keep.NEVER, False),
        ((UNSURE, SURE), Keep.WHEN_NAMED, True),
        ((STRANGE,), Keep.WHEN_NAMED, False),
        ((STRANGE,), Keep.ALWAYS, True),
    ],
)
def test_a_part_is_held_while_it_is_named_and_kept_by_its_name(bench, answers, keep, kept) -> None:
    recognizer, n = Scripted(*answers, look=lambda: bench.grip_n), len(answers)
    answer = identify(bench, recognizer, keep, STEPS[:n])
    assert [one.reached.x_m for one in answer.records] == pytest.approx([0.0, 1e-3][:n])
    wanted_n = 0.0 if keep is Keep.NEVER else CARRY_N
    assert recognizer.seen == pytest.approx([wanted_n] * n, abs=TOLERANCE_N)
    assert answer.label == (UNKNOWN if STRANGE in answers else "ball")
    assert (answer.in_grip, bench.grip_n > 0.0) == (kept, kept)
    assert bench.life.state is (CellState.COMPLETE if kept else CellState.IDLE)


@pytest.mark.parametrize(
    ("keep", "phase"),
    [(Keep.NEVER, GripperPhase.RELEASING), (Keep.ALWAYS, GripperPhase.BACKING_OFF)],
)
def test_a_hand_in_a_process_of_its_own_moves_on_while_the_answer_is_computed(
    bench: Any, monkeypatch: pytest.MonkeyPatch, keep: Keep, phase: GripperPhase
) -> None:
    monkeypatch.setattr(LocalHand, "own_process", True)
    reached = threading.Event()
    bench.once_in(phase, reached.set)
    recognizer = Scripted(SURE, look=lambda: reached.wait(20.0))
    answer = identify(bench, recognizer, keep)
    assert recognizer.seen == [True]
    assert (answer.label, answer.in_grip) == ("ball", keep is Keep.ALWAYS)
    assert (bench.grip_n > 1.0) is answer.in_grip


@pytest.mark.parametrize("stopped", [True, False])
def test_neither_a_stop_nor_a_fault_waits_for_the_answer_and_the_part_is_kept(
    bench: Any, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    monkeypatch.setattr(LocalHand, "own_process", True)
    over = threading.Event()
    act = bench.life.cancel if stopped else lambda: bench.simulated.inject("can.unplugged")
    bench.once_in(GripperPhase.BACKING_OFF, act)
    with pytest.raises(CellStopped if stopped else TactileError):
        identify(bench, Scripted(SURE, look=lambda: over.wait(20.0)), Keep.ALWAYS)
    assert not over.is_set()
    over.set()
    assert bench.life.state is (CellState.HELD if stopped else CellState.ABORTED)
    assert bench.grip_n > 1.0


def test_an_error_while_it_is_named_is_a_fault_with_the_part_kept(bench: Any) -> None:
    with pytest.raises(IndexError):
        identify(bench, Scripted(), Keep.ALWAYS)
    assert bench.life.state is CellState.ABORTED
    assert bench.grip_n > 1.0


# -- one grip --------------------------------------------------------------------------------


def test_without_a_fixture_further_ramps_are_taken_in_the_same_grip(make_bench) -> None:
    bench = make_bench(quick_config(sequence__regrasp="none")).ready("box")
    recognizer = Scripted(UNSURE, UNSURE, UNSURE)
    held_n: list[float] = []

    def look(_now_s: float) -> None:
        if 0 < len(recognizer.grasps) < 3:
            held_n.append(bench.grip_n)

    bench.clock.on_advance.append(look)
    answer = bench.controller.identify(recognizer, STEPS)
    assert [record.same_grip for record in answer.records] == [False, True, True]
    assert len({record.reached for record in answer.records}) == 1
    assert [round(record.outcome.final_force_n) for record in answer.records] == [6, 3, 5]
    assert min(held_n) > 0.5
    assert answer.posteriors[1].dependence > answer.posteriors[0].dependence
    assert (bench.life.state, bench.grip_n) == (CellState.IDLE, 0.0)


# -- the same part? --------------------------------------------------------------------------


def test_noise_of_the_taxels_makes_no_part_another_one() -> None:
    rng = np.random.default_rng(3)
    pressed = np.where(np.arange(408) < 40, 60.0, 0.0)

    def part() -> HeldPart:
        frames = rng.normal(pressed, 24.0, (10, 408))
        noise = float(frames.var(axis=0).sum()) / 9
        return HeldPart(force_n=4.0, opening_m=0.01, footprint=frames.mean(axis=0), noise=noise)

    checks = [compared(part(), part()) for _ in range(20)]
    assert all(check.same for check in checks), [check.reasons for check in checks]
    assert not compared(replace(part(), footprint=np.roll(pressed, 30)), part()).same
    (reason,) = compared(replace(part(), opening_m=0.0125), part()).reasons
    assert reason.startswith("the opening is 12.50 mm and was 10.00 mm; a difference of ")
    lost = compared(replace(part(), opening_m=0.0125, force_n=0.1), part())
    assert (lost.held, lost.same, len(lost.reasons)) == (False, None, 1)


# -- to a place ------------------------------------------------------------------------------


TO_BIN = Destination(label="ball", place="bin 1")


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        ("there", PositionerError, "the part is kept"),
        (False, PositionerError, "the place bin 1 of ball"),
        (None, CellStopped, "on the way to bin 1; the part is kept"),
    ],
)
def test_a_refused_place_and_a_stop_on_the_way_leave_the_part_in_the_grip(
    make_bench: MakeBench, answer, error, says
) -> None:
    bench = make_bench(places=lambda _to: bench.life.cancel() if answer is None else answer)
    bench.ready().controller.grip(3.0, Pose())
    with pytest.raises(error, match=says):
        bench.controller.moves.carry_to(TO_BIN)
    assert (bench.life.state, bench.life.fault) == (CellState.COMPLETE, None)
    assert bench.grip_n > 1.0


def test_a_part_that_is_lost_on_the_way_ends_it_at_once(bench: Any) -> None:
    arrived = threading.Event()

    def places(_destination: Destination) -> None:
        bench.simulated.devices.world.remove()
        arrived.wait(30.0)

    bench.controller.grip(3.0, Pose())
    bench.controller.moves.positioner = HostPlaces(OperatorPositioner(lambda _text: ""), places)
    try:
        with pytest.raises(PartLost):
            bench.controller.moves.carry_to(TO_BIN)
    finally:
        arrived.set()
    assert bench.life.grasp_state is GraspState.PART_LOST
    lost_at_m = bench.aperture_m
    bench.sleep(0.5)
    assert abs(bench.aperture_m - lost_at_m) < 0.5e-3  # with frozen goals one finger closes 3 mm

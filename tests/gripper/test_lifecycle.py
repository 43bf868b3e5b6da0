"""What each kind of fault does to torque and goals: hold, stand still, open a step, go limp."""

import re
from contextlib import suppress

import pytest

from gripper.errors import (
    BusTimeout,
    FeedbackImplausible,
    FingerSilent,
    ForceAboveCap,
    GraspStopped,
    GripperStateError,
    LimitExceeded,
    PartSlipped,
    PositionContradicted,
    ServoFault,
    copy_fingers,
    fingers_left,
    note_fingers,
)
from gripper.force.ramp import ForceRamp
from gripper.servos import feedback
from gripper.values.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


def test_a_held_part_is_kept_where_a_report_creeps_out_of_its_range(cell) -> None:
    cell.hold_part(RAMP)
    held_n, since_s = cell.force_n, cell.clock.monotonic()

    def creep(now_s: float) -> None:
        # So slowly that the motor does not contradict it.
        counts = round(-0.03 * (now_s - since_s) / cell.motors[0].model.rad_per_pulse)
        cell.knobs[0].offset_report(counts)

    cell.clock.on_advance.append(creep)
    with pytest.raises((PositionContradicted, PartSlipped)):
        cell.gripper.hold(20.0)
    assert cell.torques == [1, 1]
    # The drifting position counts as a motion of a finger, until it contradicts the other one.
    assert cell.force_n == pytest.approx(held_n, abs=1.5)


def test_a_current_that_cannot_be_ends_in_limp_fingers(cell, monkeypatch) -> None:
    cell.hold_part(RAMP)

    def absurd(model, present_a: float, *_of: float) -> tuple[float, float]:
        return 12.0 * present_a, 12.0 * present_a

    observe = cell.once(lambda: monkeypatch.setattr(feedback, "winding_a", absurd), in_s=0.3)
    with pytest.raises(FeedbackImplausible, match=r"at most 1\.50 A are possible"):
        cell.gripper.hold(2.0, observe)
    assert cell.torques == [0, 0]


@pytest.mark.slow
def test_too_much_force_is_lowered_and_the_part_kept(make_cell) -> None:
    cell = make_cell(force_max_n=6.0)
    cell.hold_part(RAMP)
    force_n = cell.force_n
    observe = cell.once(lambda: swell(cell, 0.0004), in_s=0.5)
    with pytest.raises(ForceAboveCap, match="force_max_n is 6"):
        cell.gripper.hold(2.0, observe)
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.5
    peak_n = cell.peak_n
    cell.clock.sleep(1.0)
    assert cell.peak_n <= peak_n + 0.2
    assert cell.torques == [1, 1]
    assert 1.0 < cell.force_n < peak_n
    assert force_n == pytest.approx(4.0, abs=0.5)
    cell.gripper.clear_fault()
    cell.gripper.release()


@pytest.mark.slow
@pytest.mark.parametrize("cap_n", [5.0, 15.0])
@pytest.mark.parametrize("in_ramp", [True, False])
@pytest.mark.parametrize("factor", [1.25, 1.6, 2.0])
def test_motors_that_grow_stronger_in_a_grip_end_below_the_cap(
    make_cell, factor: float, cap_n: float, *, in_ramp: bool
) -> None:
    """Friction holds more than lower currents make."""
    cell = make_cell(force_max_n=cap_n, rate_hz=200.0, noise_n=0.1, current_max_a=1.5)
    force_n = 0.9 * cap_n

    def strengthen() -> None:
        for motor in cell.motors:
            motor.kt_factor = factor

    observe = cell.once(strengthen, at_n=0.8 * force_n if in_ramp else force_n)
    with suppress(LimitExceeded):
        cell.gripper.start()
        cell.gripper.grasp(ForceRamp.linear(force_n, rate_n_s=10.0, hold_s=0.5), observe)
    cell.clock.sleep(1.0)
    assert cell.acted_s
    assert 1.0 < cell.force_n <= cap_n


def swell(cell, more_m: float) -> None:
    cell.part.width_m += more_m


def test_the_other_finger_stands_still_when_a_servo_drops_its_torque(cell) -> None:
    cell.hold_part(RAMP)
    observe = cell.once(cell.knobs[1].overload, in_s=0.5)
    with pytest.raises(ServoFault, match="overload") as fault:
        cell.gripper.hold(2.0, observe)
    assert fault.value.torque_lost
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.02
    # The goal is where the finger was, not beyond: it pushes nothing ahead of itself.
    goal, present = cell.register(0, "goal_position"), cell.register(0, "present_position")
    assert abs(goal - present) < 12
    living_m = cell.mechanics.finger_position_m[0]
    cell.part.present = False
    cell.clock.sleep(1.0)
    assert abs(cell.mechanics.finger_position_m[0] - living_m) < 0.0008


# Fingers on their way stop where they are.


class Fails(Exception):
    """What an observer may raise."""


def in_the_way(cell, how: str):
    """Return an observer that stops, fails, stalls or silences while the fingers open fast."""

    def observe(cycle) -> None:
        if cycle.phase.moving and cycle.state.aperture_velocity_m_s > 0.03:
            if how == "stop":
                cell.gripper.request_stop()
            elif how == "fail":
                raise Fails("the disk is full")
            elif how == "stall":
                cell.clock.sleep(0.3)
            elif how == "deaf":
                cell.gripper.request_stop()
                cell.gripper.bus.sync_write = lambda *_a, **_k: None
            elif how == "silent":
                cell.device.faults.silent.add(1)
            else:
                cell.device.faults.silent.update((1, 2))

    return observe


@pytest.mark.parametrize(
    ("how", "error", "left"),
    [
        ("stop", GraspStopped, "stopped"),
        ("fail", Fails, "stopped"),
        ("stall", LimitExceeded, "stopped"),
        ("silent", FingerSilent, "were seen last"),
        ("deaf", ServoFault, "were seen last"),
        ("dead", BusTimeout, "were seen last"),
    ],
)
@pytest.mark.parametrize("command", ["release", "open"])
def test_fingers_on_their_way_stop_where_they_are(make_cell, command, how, error, left) -> None:
    cell = make_cell(aperture_open_m=0.04)
    if command == "release":
        cell.hold_part(RAMP)
    else:
        cell.gripper.start()
    with pytest.raises(error) as caught:
        getattr(cell.gripper, command)(observer=in_the_way(cell, how))
    told = fingers_left(caught.value)
    doing = "letting go" if command == "release" else "opening"
    assert told.startswith(f"the fingers {left} while {doing}, at an opening of ")
    assert ("half held" in told) == (command == "release")
    assert ("watchdog" in told) == (left != "stopped")
    if left != "stopped":
        cell.gripper.keep_grip()
        cell.gripper.close()
    cell.clock.sleep(0.25)
    stood_m = cell.mechanics.aperture_m
    assert stood_m < 0.036
    with suppress(BusTimeout):
        cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    assert cell.mechanics.aperture_m == pytest.approx(stood_m, abs=3e-4)
    if how in {"stop", "fail"}:
        said_mm = float(re.findall(r"([\d.]+) mm", told)[0])
        assert said_mm == pytest.approx(stood_m * 1e3, abs=1.0)
    if how == "stop":
        expected = GripperPhase.HELD_AFTER_FAULT if command == "release" else GripperPhase.IDLE
        assert cell.gripper.phase is expected
        getattr(cell.gripper, command)()
        assert cell.mechanics.aperture_m == pytest.approx(0.04, abs=1e-3)


def test_a_stop_at_the_begin_of_a_release_lets_nothing_fall(cell) -> None:
    cell.hold_part(RAMP)
    with pytest.raises(GraspStopped):
        cell.gripper.release(lambda _: cell.gripper.request_stop())
    cell.clock.sleep(1.0)
    assert cell.force_n > 0.5
    with pytest.raises(GripperStateError):
        cell.gripper.hold(0.1)
    cell.gripper.release()
    assert cell.force_n == 0.0


def test_a_stop_in_the_approach_goes_no_farther(make_started) -> None:
    cell = make_started(present=False, approach_speed_m_s=0.02)

    def stop(cycle) -> None:
        if cycle.state.aperture_m < 0.012:
            cell.gripper.request_stop()

    with pytest.raises(GraspStopped) as caught:
        cell.gripper.grasp(RAMP, stop)
    assert "closing, at an opening of 1" in fingers_left(caught.value)
    cell.clock.sleep(1.0)
    assert cell.mechanics.aperture_m > 0.0115
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    with pytest.raises(GripperStateError):
        cell.gripper.hold(1.0)
    cell.gripper.release()
    assert cell.gripper.phase is GripperPhase.IDLE


def test_no_note_is_made_where_fingers_hold(cell) -> None:
    cell.hold_part(RAMP)
    with pytest.raises(GraspStopped) as caught:
        cell.gripper.hold(1.0, lambda _: cell.gripper.request_stop())
    assert fingers_left(caught.value) == ""
    other = Fails("x")
    copy_fingers(caught.value, other)
    assert fingers_left(other) == ""
    note_fingers(caught.value, "stopped")
    copy_fingers(caught.value, other)
    copy_fingers(caught.value, other)
    assert other.__notes__ == ["the fingers stopped"]

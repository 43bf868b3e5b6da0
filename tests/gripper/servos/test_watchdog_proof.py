"""The self-test of the bus watchdog: it passes where the motor stops and nowhere else."""

import pytest

from gripper.errors import (
    FingerBlocked,
    GraspStopped,
    GripperStateError,
    LimitExceeded,
    WatchdogUnproven,
)
from gripper.force.ramp import ForceRamp
from gripper.mechanics.transmission import Drives
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from simulator.servo.device import WatchdogStop
from tests.marks import LONG

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0)


@pytest.mark.parametrize(
    ("how", "watchdog_s"),
    [
        (WatchdogStop.HOLD, 0.1),
        (WatchdogStop.ZERO_CURRENT, 0.9),
        *(LONG(WatchdogStop.ZERO_CURRENT, watchdog_s) for watchdog_s in (0.1, 0.2, 0.5)),
    ],
)
def test_a_watchdog_that_stops_the_motors_is_proven_once(make_started, how, watchdog_s) -> None:
    cell = make_started(watchdog_self_test=True, watchdog_s=watchdog_s)
    for servo in cell.servos:
        servo.watchdog_stop = how
    with pytest.raises(GripperStateError, match="open the gripper, the test follows"):
        cell.gripper.grasp(RAMP)
    opened_m: list[float] = []
    cell.clock.on_advance.append(lambda _: opened_m.append(cell.mechanics.aperture_m))
    cell.gripper.open(0.02)
    cell.clock.on_advance.pop()
    assert cell.mechanics.aperture_m == pytest.approx(0.02, abs=8e-4)
    assert 0.0122 < min(opened_m) < 0.0195
    assert cell.register(0, "bus_watchdog") == round(watchdog_s / 0.02)
    opened_s = cell.clock.monotonic()
    cell.gripper.open(0.021)
    assert cell.clock.monotonic() - opened_s < 0.5
    assert cell.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED


def test_a_watchdog_is_proven_again_after_the_servos_were_without_torque(make_started) -> None:
    cell = make_started(watchdog_self_test=True, present=False)
    cell.gripper.open()
    cell.gripper.close()
    cell.gripper.start()
    with pytest.raises(GripperStateError, match="self-test"):
        cell.gripper.grasp(RAMP)
    cell.gripper.open()
    assert cell.gripper.grasp(RAMP).result is GraspResult.NO_CONTACT


def test_a_motor_that_turns_on_is_found_and_no_grasp_is_begun(make_started) -> None:
    cell = make_started(watchdog_self_test=True)
    cell.servos[1].watchdog_stop = WatchdogStop.KEEPS_TURNING
    with pytest.raises(WatchdogUnproven, match=r"servo 2: register 98 tripped.*unattended") as bad:
        cell.gripper.open()
    assert "servo 1:" not in str(bad.value)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    cell.gripper.clear_fault()
    assert cell.gripper.phase is GripperPhase.IDLE
    with pytest.raises(GripperStateError, match="self-test"):
        cell.gripper.grasp(RAMP)
    with pytest.raises(WatchdogUnproven):
        cell.gripper.open()


def test_a_watchdog_that_never_trips_is_found(make_started, monkeypatch) -> None:
    cell = make_started(watchdog_self_test=True)
    monkeypatch.setattr(cell.servos[0], "set_watchdog", lambda *_: None)
    with pytest.raises(WatchdogUnproven, match="servo 1: register 98 did not trip"):
        cell.gripper.open()


def test_a_part_that_blocks_the_test_is_named_and_kept(make_started) -> None:
    cell = make_started(watchdog_self_test=True, width_m=0.0195)
    with pytest.raises(FingerBlocked, match=r"servo 1: .* servo 2: .* Take out"):
        cell.gripper.open(0.02)
    cell.gripper.clear_fault()
    with pytest.raises(GripperStateError, match="release the part first"):
        cell.gripper.open()


def test_fingers_of_high_friction_get_the_current_to_start(make_cell) -> None:
    cell = make_cell(watchdog_self_test=True, friction_error=1.5, force_max_n=4.0)
    cell.drives = Drives()
    cell.gripper = cell.new_gripper()
    cell.gripper.start()
    cell.gripper.open(0.02)
    assert cell.gripper.phase is GripperPhase.IDLE


def test_what_lies_between_the_fingers_at_a_stop_in_the_test_is_kept(make_started) -> None:
    cell = make_started(watchdog_self_test=True, width_m=0.0152)
    cell.clock.on_advance.append(lambda _: cell.force_n > 0.5 and cell.gripper.request_stop())
    with pytest.raises(GraspStopped, match="a part may touch the pads"):
        cell.gripper.open(0.02)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT


def test_it_refuses_a_long_way(make_started) -> None:
    with pytest.raises(LimitExceeded, match=r"shorten gripper\.watchdog_ms"):
        make_started(watchdog_self_test=True, watchdog_s=2.5).gripper.open()


def test_it_needs_open_fingers(make_started) -> None:
    cell = make_started(watchdog_self_test=True, aperture_min_m=0.01, present=False)
    with pytest.raises(LimitExceeded, match=r"closes the fingers by .* mm: open them further"):
        cell.gripper.open(0.0105)

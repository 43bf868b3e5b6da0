"""The gripper on simulated servos with friction, inertia and an elastic part, in virtual time."""

from contextlib import suppress
from dataclasses import replace
from statistics import fmean
from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, GroupSyncRead

from gripper import ForceSample, Gripper, RackPinion, open_gripper
from gripper.dynamixel.control_table import TORQUE_ENABLE
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.protocol2 import CheckedPacketHandler
from gripper.dynamixel.serial_port import SdkPort, open_line
from gripper.errors import (
    GraspStopped,
    GripperError,
    GripperStateError,
    LimitExceeded,
    PortLost,
    VerificationFailed,
)
from gripper.force.ramp import ForceRamp, largest_ramp_n
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from simulator import SimulatedCell, simulated_cell
from tactile import GripForce, open_sensor
from tests.marks import LONG

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)
D_GAIN = "position_d_gain"


def test_start_corrects_what_inspecting_reports_and_moves_nothing(cell) -> None:
    before_m = cell.mechanics.aperture_m
    # The gains follow the mode.
    rows = [(servo_id, item) for servo_id in (1, 2) for item in ("operating_mode", D_GAIN)]
    assert [(row.servo_id, row.item) for row in cell.gripper.inspect().failed] == rows
    assert cell.register(1, "operating_mode") == 3
    report = cell.gripper.start()
    assert report.ok
    assert [(row.servo_id, row.item) for row in report.rows if row.corrected] == rows[::2]
    assert cell.gripper.phase is GripperPhase.OFF
    assert cell.mechanics.aperture_m == before_m
    assert cell.torques == [0, 0]
    assert cell.register(1, "operating_mode") == 5
    assert not any(row.corrected for row in cell.gripper.start().rows)


@pytest.mark.slow
@pytest.mark.parametrize(("n_servos", "zero_raw"), [(1, 2048), (2, 10)])
def test_one_grasp_from_start_to_close(make_cell, n_servos: int, zero_raw: int) -> None:
    cell = make_cell(n_servos=n_servos, zero_raw=zero_raw)
    gripper = cell.gripper
    gripper.start()
    assert gripper.open().aperture_m == pytest.approx(0.03, abs=0.0008)
    assert gripper.phase is GripperPhase.IDLE
    assert cell.register(0, "bus_watchdog") == 10
    outcome = gripper.grasp(RAMP)
    assert outcome.result is GraspResult.FORCE_REACHED
    assert outcome.contact_aperture_m == pytest.approx(0.012, abs=0.0006)
    assert outcome.final_force_n == pytest.approx(8.0, abs=0.6)
    assert cell.force_n == pytest.approx(8.0, abs=0.5)
    assert gripper.phase is GripperPhase.HOLDING
    gripper.hold(0.5)
    assert gripper.release().state.aperture_m == pytest.approx(0.03, abs=0.0008)
    assert gripper.phase is GripperPhase.IDLE
    gripper.close()
    gripper.close()
    assert gripper.phase is GripperPhase.OFF
    assert cell.register(0, "torque_enable") == 0
    assert cell.register(0, "bus_watchdog") == 0
    assert gripper.statistics.late == 0


def ticks(cell, seconds: float, creep_m_s: float = 0.0) -> None:
    end_s = cell.clock.monotonic() + seconds
    while cell.clock.monotonic() < end_s:
        cell.clock.sleep(cell.gripper.settings.period_s)
        cell.part.width_m -= creep_m_s * cell.gripper.settings.period_s
        cell.gripper.tick()


@pytest.mark.slow
@pytest.mark.parametrize("force_n", [4.0, LONG(10.0)])
def test_each_tick_controls_a_carried_part_until_its_grip_is_kept(cell, force_n: float) -> None:
    cell.hold_part(RAMP)
    cell.least_n = 99.0
    cell.gripper.hold_at(force_n, 0.2)
    cell.gripper.hold(0.1)
    assert cell.least_n > min(force_n, 8.0) - 1.0
    assert cell.gripper.phase is GripperPhase.HOLDING
    assert cell.register(0, "bus_watchdog") == 0
    cell.gripper.request_stop()
    forces_n = []
    for _ in range(12):
        ticks(cell, 0.25, creep_m_s=2e-4)
        forces_n.append(cell.force_n)
    # The creep takes 2 N/s of this part, and a push waits until the samples show its lack.
    assert fmean(forces_n[-4:]) == pytest.approx(force_n, abs=0.7)
    # The feedback is old then, and the first reading gets no answer.
    cell.clock.sleep(0.1)
    cell.device.faults.drop_next = 5
    cell.gripper.keep_grip()
    kept = cell.gripper._servos.goals.last
    ticks(cell, 1.0)
    assert cell.gripper._servos.goals.last is kept
    assert cell.force_n == pytest.approx(force_n, abs=0.8)
    assert cell.gripper.release().opened == (1, 2)


def test_a_stop_while_the_force_falls_does_not_raise_it_again(make_cell) -> None:
    cell = make_cell(rate_hz=200.0, noise_n=0.1, stiffness_n_m=8_000.0)
    cell.hold_part(RAMP)
    with pytest.raises(GraspStopped):
        cell.gripper.hold_at(4.0, 0.0, lambda c: c.setpoint_n < 5.0 and cell.gripper.request_stop())
    stopped_n, cell.peak_n = cell.force_n, 0.0
    cell.clock.sleep(0.5)
    assert cell.peak_n < stopped_n + 0.3


def test_keep_grip_ends_a_push_before_it_waits_for_lost_answers(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.hold_at(8.0)
    goals, state = cell.gripper._servos.goals, cell.gripper.tick().state
    goals.write([goal._replace(current_a=0.8, rest=goal.lasting) for goal in goals.last], state)
    cell.peak_n = 0.0
    cell.device.faults.drop_next = 3
    cell.gripper.keep_grip()
    assert cell.peak_n < 9.0


@pytest.mark.parametrize(("gain", "valid_s"), [(0.0, 1.0), (0.0, 0.015), (0.3, 0.03), (0.2, 1.0)])
def test_pads_that_fail_as_a_carry_begins_let_nothing_go(make_cell, gain, valid_s) -> None:
    cell = make_cell(rate_hz=200.0, noise_n=0.1)
    cell.hold_part(RAMP)
    cell.gripper.hold_at(4.0, 0.2)
    cell.least_n, cell.sensor.gain = 99.0, gain
    with suppress(GripperError):
        ticks(cell, valid_s)
        cell.sensor.valid = False
        ticks(cell, 1.0)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    assert cell.least_n > 3.5


def test_pads_that_read_little_for_a_moment_change_no_grip(make_cell) -> None:
    cell = make_cell(rate_hz=200.0, noise_n=0.1)
    cell.hold_part(RAMP)
    cell.gripper.hold_at(4.0, 0.2)
    cell.least_n, cell.sensor.gain = 99.0, 0.2
    ticks(cell, 0.03)
    cell.sensor.gain = 1.0
    ticks(cell, 0.5)
    assert (cell.gripper.phase, cell.least_n > 3.5) == (GripperPhase.HOLDING, True)


@pytest.mark.parametrize(("wider_m", "rate_hz"), [(0.0006, 50.0), (0.0004, 200.0)])
def test_a_part_that_moves_the_fingers_in_a_pause_is_held_on(make_cell, wider_m, rate_hz) -> None:
    cell = make_cell(rate_hz=rate_hz, noise_n=0.1)
    cell.hold_part(RAMP)
    cell.gripper.hold(0.1)
    cell.part.width_m += wider_m
    ticks(cell, 0.06)
    cell.least_n = 99.0
    cell.gripper.hold_at(8.0)
    ticks(cell, 0.3)
    assert cell.least_n > 6.0


def test_a_carried_part_that_grows_pushes_the_fingers_open_against_their_friction(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.hold_at(4.0, 0.2)
    ticks(cell, 2.0)
    cell.gripper.hold_at(4.0, 0.2)  # the same force: it is still carried
    ticks(cell, 2.0, creep_m_s=-2e-4)
    assert 3.5 < cell.force_n < 6.5
    assert cell.gripper.release().opened == (1, 2)


@pytest.mark.parametrize("frozen", [False, True])
def test_a_part_held_by_a_servo_that_is_too_warm_is_kept_with_a_fault(cell, frozen: bool) -> None:
    cell.hold_part(RAMP)
    cell.gripper.hold_at(4.0, 0.2)
    if frozen:
        cell.gripper.keep_grip()
    known = dict(cell.gripper.mechanics.drives.newest)
    usual_c, too_warm_c = cell.motors[0].temperature_c, cell.settings.temperature_max_c + 2.0
    for temperature_c in (too_warm_c, usual_c, too_warm_c):
        cell.motors[0].temperature_c = temperature_c
        ticks(cell, cell.settings.period_s)  # one wrong reading ends nothing
    with pytest.raises(LimitExceeded, match=r"servo 1 has 6.*: take out a part that is held"):
        ticks(cell, 1.0)
    cell.clock.sleep(1.0)
    assert cell.force_n == pytest.approx(4.0, abs=0.7)
    cell.gripper.clear_fault()
    assert cell.gripper.mechanics.drives.newest == known
    assert cell.gripper.release().opened == (1, 2)


def test_a_stop_at_the_contact_leaves_no_force_to_control(started) -> None:
    def stop(cycle: Cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            started.gripper.request_stop()

    with pytest.raises(GraspStopped):
        started.gripper.grasp(RAMP, stop)
    assert started.gripper.phase is GripperPhase.HELD_AFTER_FAULT


@pytest.mark.slow
def test_a_part_is_squeezed_again_in_the_same_grip(started) -> None:
    with pytest.raises(GripperStateError):
        started.gripper.squeeze(RAMP)
    started.gripper.grasp(RAMP)
    with pytest.raises(LimitExceeded, match="carry the part with less force first"):
        started.gripper.squeeze(RAMP)
    drives, known = started.gripper.mechanics.drives, started.gripper.read_drives().drives
    for servo_id, drive in known.items():  # weak servos, which could not press so much again
        drives.put(servo_id, replace(drive, rising_a_nm=2.0))
    started.gripper.hold_at(2.0, observer=lambda _: drives.newest.update(known))
    started.least_n = 99.0
    setpoints_n: list[float] = []
    outcome = started.gripper.squeeze(RAMP, lambda c: setpoints_n.append(c.setpoint_n))
    assert outcome.result is GraspResult.FORCE_REACHED
    assert outcome.final_force_n == pytest.approx(8.0, abs=0.6)
    assert setpoints_n[0] == pytest.approx(2.0, abs=0.1)
    assert setpoints_n == sorted(setpoints_n)
    assert started.least_n > 1.0
    assert started.gripper.phase is GripperPhase.HOLDING


def test_a_ramp_or_an_opening_beyond_a_limit_is_refused_before_anything_moves(started) -> None:
    with pytest.raises(LimitExceeded, match="could not hold"):
        started.gripper.grasp(ForceRamp.linear(0.2, 5.0))
    with pytest.raises(LimitExceeded, match="aperture_m"):
        started.gripper.open(0.2)
    assert started.torques == [0, 0]


@pytest.mark.parametrize("current_max_a", [0.5, 2.0])
def test_the_largest_ramp_is_the_last_one_that_is_allowed(make_cell, current_max_a: float) -> None:
    cell = make_cell(current_max_a=current_max_a)
    most_n = largest_ramp_n(cell.gripper.mechanics)
    cell.gripper.check_ramp(ForceRamp.linear(most_n, 5.0))
    with pytest.raises(LimitExceeded, match=r"at most 45\.45 N|current_max_a is 0\.5 A"):
        cell.gripper.check_ramp(ForceRamp.linear(1.001 * most_n, 5.0))


@pytest.mark.slow
def test_commands_out_of_turn_are_refused(started) -> None:
    with pytest.raises(GripperStateError, match="hold is not possible in the state OFF"):
        started.gripper.hold(1.0)
    with pytest.raises(GripperStateError, match="measure_load is not possible in the state OFF"):
        started.gripper.measure_load()

    def reenter(_: Cycle) -> None:
        with pytest.raises(GripperStateError, match="another command runs"):
            started.gripper.release()
        with pytest.raises(GripperStateError):
            started.gripper.clear_fault()

    started.gripper.request_stop()  # An old request ends no new command.
    started.gripper.open(observer=reenter)
    started.gripper.grasp(RAMP)
    gripper = started.gripper
    empty = ((gripper.open,), (gripper.measure_friction,), (gripper.press_pads_together, RAMP))
    for command, *given in (*empty, (gripper.grasp, RAMP)):
        with pytest.raises(GripperStateError, match=f"{command.__name__} .*release the part first"):
            command(*given)
    with pytest.raises(LimitExceeded, match="duration_s"):
        started.gripper.hold(0.0)
    with pytest.raises(LimitExceeded, match="duration_s is nan"):
        started.gripper.hold_at(2.0, float("nan"))


def test_torque_found_on_in_another_mode_changes_nothing_before_the_release(cell) -> None:
    for servo_id in (1, 2):
        cell.bus.write(servo_id, TORQUE_ENABLE, 1)
    assert {row.item for row in cell.gripper.start().failed} == {"operating_mode", D_GAIN}
    assert cell.register(0, "operating_mode") == 3
    assert cell.register(0, "torque_enable") == 1
    cell.gripper.release()
    assert cell.register(0, "operating_mode") == 5
    assert cell.gripper.phase is GripperPhase.IDLE


@pytest.mark.slow
def test_ticks_feed_the_watchdog_and_without_a_part_the_next_command_restarts_it(started) -> None:
    started.gripper.tick()
    started.gripper.open()
    started.clock.sleep(1.0)
    assert started.register(0, "bus_watchdog") == -1
    started.gripper.tick()
    assert started.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED
    for _ in range(20):
        started.clock.sleep(0.1)
        started.gripper.tick()
    assert started.register(0, "bus_watchdog") == 10
    assert started.force_n == pytest.approx(8.0, abs=0.5)
    started.gripper.keep_grip()
    assert started.register(0, "bus_watchdog") == 0
    began_s = started.clock.monotonic()
    started.gripper.hold(0.5)
    assert started.clock.monotonic() - began_s == pytest.approx(0.5, abs=0.02)
    assert started.register(0, "bus_watchdog") == 10


SERVO = ServoSettings(servo_id=1)
DRIVE = DriveCharacteristic.catalogue(SERVO.servo_model)


@pytest.mark.parametrize(
    ("settings", "change", "says"),
    [
        (GripperSettings(), {"force_max_n": 51.0}, "force_max_n"),
        (GripperSettings(), {"force_max_n": float("nan")}, "force_max_n"),
        (GripperSettings(), {"aperture_min_m": 0.05}, "aperture_min_m"),
        (GripperSettings(), {"watchdog_s": 0.001}, "watchdog_s"),
        (GripperSettings(), {"servos": (SERVO, SERVO)}, r"\[1, 1\]"),
        (
            GripperSettings(current_max_a=1.99, servos=(ServoSettings(servo_id=1),)),
            {"servos": (ServoSettings(servo_id=1, model="RH-P12-RN(A)"),)},
            r"1 \(RH-P12-RN\(A\)\) makes at most 1\.984 A",
        ),
        (SERVO, {"model": "XL430-W250"}, "no Goal Current"),
        (SERVO, {"model": "xm430-w35O"}, "not known: use one of XM430-W350"),
        (SERVO, {"model": "servo"}, "'servo' is not known: use one of XM430-W350, "),
        (SERVO, {"direction": 0}, "direction"),
        (SERVO, {"servo_id": 253}, "servo_id"),
        (DRIVE, {"coulomb_a": 0.0}, "coulomb_a is 0.0, must be above 0"),
        (DRIVE, {"friction_sd": -0.1}, "friction_sd"),
        (DRIVE, {"load_sd": -0.1}, "load_sd"),
        (DRIVE, {"viscous_a_s": float("nan")}, "viscous_a_s is nan, must be finite"),
        (DRIVE, {"temperature_c": float("inf")}, "temperature_c"),
        (SERVO, {"zero_raw": 4096}, "zero_raw"),
    ],
)
def test_settings_out_of_range_cannot_exist(settings, change, says) -> None:
    with pytest.raises(LimitExceeded, match=says):
        replace(settings, **change)


class NoPads:
    def latest_force(self) -> None:
        return None


def opened(line: Any, *args: Any) -> Gripper:
    return open_gripper(line, *args, force_sensor=NoPads())


def gripped_n(sim: SimulatedCell) -> float:
    return min(sim.world.contact_force_n())


@pytest.mark.slow
def test_an_error_in_the_block_closes_the_port_and_keeps_the_part() -> None:
    with simulated_cell("box") as sim, open_sensor(sim.can_bus) as sensor:
        sensor.tare()
        line, force = sim.servo_port, GripForce(sensor, ForceSample)
        with suppress(KeyError), open_gripper(line, force_sensor=force) as gripper:
            gripper.open()
            gripper.grasp(ForceRamp.linear(5.0, 10.0))
            raise KeyError
        assert line.closed
        sim.clock.sleep(3.0)
        assert gripped_n(sim) > 4.0
        with opened(sim.servo_port) as gripper:
            assert gripper.phase is GripperPhase.HELD_AFTER_FAULT
            assert gripped_n(sim) > 4.0
            gripper.release()
            assert gripped_n(sim) == 0.0
        assert not any(servo.torque_on for servo in sim.devices.servo_bus.servos)


def test_a_gripper_that_cannot_be_or_does_not_match_leaves_no_port_open() -> None:
    with simulated_cell() as sim:
        line = sim.servo_port
        sim.inject("servos.off")
        with pytest.raises(VerificationFailed), opened(line):
            pass
        assert line.closed
        line = sim.open_servo_port()
        with pytest.raises(LimitExceeded, match="driven by 1 servos, the settings name 2"):
            opened(line, GripperSettings(), RackPinion(pinion_radius_m=0.012))
        assert line.closed
    with pytest.raises(PortLost, match="cannot open serial port /dev/nowhere"):
        opened("/dev/nowhere")
    with pytest.raises(LimitExceeded, match="250000"):
        open_line("/dev/nowhere", 250_000)


@pytest.mark.parametrize(
    ("knob", "result"), [("drop", COMM_RX_TIMEOUT), ("bit_flip", COMM_RX_CORRUPT)]
)
def test_the_groups_of_the_sdk_have_no_value_of_an_answer_that_is_lost(knob, result) -> None:
    with simulated_cell() as sim:
        port, place = SdkPort(*open_line(sim.servo_port, 1_000_000)), (132, 4)
        group = GroupSyncRead(port, CheckedPacketHandler(), *place)
        assert all(group.addParam(servo_id) for servo_id in (1, 2))
        setattr(sim.devices.faults.servo_wire, knob, 1.0)
        assert group.txRxPacket() == result
        assert not group.isAvailable(2, *place)

"""Drives of servos that differ from their catalogue: measured while the gripper works."""

from dataclasses import replace
from typing import Any

import pytest

from benchmarks.performance.force_ramps import PARTS, Rig
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import XM430_W350
from gripper.errors import ServoFault
from gripper.force.ramp import ForceRamp
from gripper.mechanics.transmission import Drives
from gripper.settings import ServoSettings
from gripper.values.outcome import GraspResult
from tests.gripper.conftest import STICKING, STICKING_DRIVE
from tests.marks import LONG

NEVER = (0.7, 0.15)
"""Uncertainties of servos that nobody has measured."""
RAMP = ForceRamp.linear(6.0, 8.0, 0.5)
PRESSED = (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED)
_CATALOGUE = 0.09 / 0.2214
"""Friction of the catalogue over that of the simulated data sheet."""


def drives(cell: Any) -> list[DriveCharacteristic]:
    return list(cell.gripper.read_drives().drives.values())


def check_friction(cell: Any, rel: float = 0.1, abs_a: float | None = None) -> None:
    """Check that the friction of each servo is known."""
    known_a = [drive.breakaway_a for drive in drives(cell)]
    true_a = [motor.friction_nm() / motor.kt_nm_a for motor in cell.motors]
    assert known_a == pytest.approx(true_a, rel=rel, abs=abs_a)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [(0.5, 0.5), (3.0, 1.0), LONG((3.0, 2.0)), LONG((1.0, 0.5))])
def test_a_gripper_that_never_measured_finds_the_friction_of_servos(make_started, friction) -> None:
    cell = make_started(drive_sds=NEVER, aperture_m=0.03)
    for motor, factor in zip(cell.motors, friction, strict=True):
        motor.friction_factor *= factor
    cell.gripper.open()
    assert cell.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED
    assert cell.force_n == pytest.approx(6.0, abs=0.6)
    assert cell.peak_n < cell.settings.force_max_n
    assert all(drive.measured for drive in drives(cell))
    check_friction(cell)
    cell.gripper.release()
    # From now on it is known: the second approach takes no longer than another gripper's.
    began_s = cell.clock.monotonic()
    # The law leaves half of a push: with three times the friction that is 0.7 N.
    assert cell.gripper.grasp(RAMP).final_force_n == pytest.approx(6.0, abs=0.8)
    assert cell.clock.monotonic() - began_s < 3.0


@pytest.mark.parametrize("frictions_kts", [((3.0, 0.7), (3.0, 0.7)), ((1.0, 0.7), (1.0, 1.3))])
def test_stiff_or_unlike_servos_that_nobody_measured_open_at_their_start(
    make_started, frictions_kts
) -> None:
    """Friction takes up to four times the current of the catalogue."""
    cell = make_started(drive_sds=NEVER, aperture_m=0.012, present=False)
    for motor, (friction, kt) in zip(cell.motors, frictions_kts, strict=True):
        motor.friction_factor *= friction
        motor.kt_factor = kt
    cell.gripper.open()
    assert cell.gripper._servos.read_patiently().aperture_m == pytest.approx(0.03, abs=0.001)
    check_friction(cell, abs_a=0.012)


@pytest.mark.slow
def test_one_finger_after_the_other_shows_its_torque(make_started) -> None:
    cell = make_started(drive_sds=NEVER)
    for motor, factor in zip(cell.motors, (0.75, 1.2), strict=True):
        motor.kt_factor = factor
        # The stronger finger pushes the other one aside where friction does not hold it.
        motor.friction_factor = 1.0
    cell.gripper.open()
    cell.gripper.grasp(ForceRamp.linear(8.0, 8.0, 0.5))
    cell.gripper.measure_load()
    cell.gripper.release()
    for motor, drive in zip(cell.motors, drives(cell), strict=True):
        assert drive.rising_a_nm == pytest.approx(1.0 / motor.kt_nm_a, rel=0.1)
        assert drive.falling_a_nm == pytest.approx(1.0 / motor.kt_nm_a, rel=0.1)
        assert drive.load_sd < 0.1
    check_friction(cell)


def test_a_closing_finger_whose_friction_is_more_than_was_measured_moves(make_started) -> None:
    cell = make_started(aperture_m=0.03, present=False, approach_force_n=0.3)
    for servo in cell.settings.servos:
        drive = cell.drives.of(servo)
        cell.drives.put(servo.servo_id, drive.with_friction(0.25))
    cell.gripper.measure_friction()
    assert cell.gripper._servos.read_patiently().aperture_m == pytest.approx(0.03, abs=0.001)
    check_friction(cell)
    for motor, drive in zip(cell.motors, drives(cell), strict=True):
        assert drive.temperature_c == pytest.approx(motor.temperature_c, abs=1.0)


@pytest.mark.slow
def test_ordinary_grasps_follow_grease_that_warms(make_started) -> None:
    """The travel of a grasp is short and accelerates throughout."""
    cell = make_started(noise_n=0.02, rate_hz=200.0)
    for n_grasps in range(8):
        for motor in cell.motors:
            motor.friction_factor = _CATALOGUE * 1.3 * 0.96**n_grasps
        assert cell.gripper.grasp(ForceRamp.linear(4.0, 20.0)).result in PRESSED
        cell.gripper.release()
    check_friction(cell, rel=0.08)
    assert not cell.gripper.read_drives().notes


def test_an_approach_of_two_millimetres_shows_a_friction_that_nobody_measured(make_started) -> None:
    cell = make_started(drive_sds=NEVER, aperture_m=0.0165)
    for motor in cell.motors:
        motor.friction_factor *= 2.0
    cell.gripper.grasp(ForceRamp.linear(2.0, 20.0))
    check_friction(cell, rel=0.3)


@pytest.mark.slow
def test_a_sudden_change_is_noted_with_its_cause_and_measured_anew(make_started) -> None:
    cell = make_started(present=False)
    cell.gripper.open()
    assert not cell.gripper.read_drives().notes
    cell.motors[1].friction_factor *= 1.6
    cell.gripper.measure_friction()
    (note, *_) = cell.gripper.read_drives().notes
    assert "servo 2: its free motion takes 1." in note
    assert "a cable drags, or it is worn or cold. It is measured anew" in note
    assert not cell.gripper.read_drives().notes
    check_friction(cell)


@pytest.mark.slow
def test_friction_that_no_sound_servo_has_is_a_fault_with_a_way_out(make_started) -> None:
    cell = make_started(drive_sds=NEVER, present=False, current_max_a=1.2)
    cell.motors[0].friction_factor *= 3.0
    cell.gripper.open()

    def wear() -> None:
        for _ in range(4):
            cell.motors[0].friction_factor *= 1.39
            cell.gripper.measure_friction()

    with pytest.raises(ServoFault, match=r"servo 1.* a cable drags, or it is worn"):
        wear()
    cell.motors[0].friction_factor = _CATALOGUE
    cell.gripper.clear_fault()
    assert not any(drive.measured for drive in drives(cell))
    cell.gripper.release()
    cell.gripper.measure_friction()
    check_friction(cell)


@pytest.mark.slow
def test_pads_that_read_far_too_little_are_noted_and_the_cap_holds(make_started) -> None:
    cell = make_started(drive_sds=NEVER, force_max_n=12.0)
    cell.sensor.gain = 0.6
    cell.gripper.open()
    cell.gripper.grasp(ForceRamp.linear(6.0, 8.0, 0.5))
    cell.gripper.measure_load()
    notes = cell.gripper.read_drives().notes
    assert all("the law of the pads" in note for note in notes)
    shares = [float(note.partition("makes ")[2].split()[0]) for note in notes]
    assert shares == pytest.approx([0.6, 0.6], rel=0.1)
    cell.gripper.release()
    # Up to the cap by these pads: what the motors make counts too.
    cell.gripper.grasp(ForceRamp.linear(0.9 * cell.settings.force_max_n, 8.0, 0.5))
    assert cell.peak_n < cell.settings.force_max_n


def test_a_drive_that_was_measured_on_a_bench_counts() -> None:
    catalogue = DriveCharacteristic.catalogue(XM430_W350)
    bench = replace(catalogue, rising_a_nm=0.7, kt_nm_a=1.0 / 0.7, friction_sd=0.1)
    assert Drives().of(ServoSettings(servo_id=1, measured=bench)) is bench
    assert ServoSettings(servo_id=1).drive == catalogue


@pytest.mark.slow
@pytest.mark.parametrize("factors", [(2.0, 0.7), LONG((1.0, 1.0)), LONG((3.0, 1.0))])
def test_the_load_of_a_gearing_that_sticks_is_measured_with_its_losses(factors) -> None:
    part = PARTS["steel ball, 200 N/mm"]
    # Without a load up to four times the current of the catalogue is plausible.
    factors = (_CATALOGUE * factors[0], factors[1])
    settings = {"figures": STICKING, "factors": factors, "current_max_a": 1.6}
    measured = Rig(part, 0.2, servos=None, seed=11, rate_hz=200.0, **settings).measure_servos()
    true_a_nm = STICKING_DRIVE.rising_a_nm / factors[1]
    for drive in measured.values():
        assert drive.rising_a_nm == pytest.approx(true_a_nm, rel=0.15)
        assert abs(drive.rising_a_nm / true_a_nm - 1.0) <= 2.0 * drive.load_sd

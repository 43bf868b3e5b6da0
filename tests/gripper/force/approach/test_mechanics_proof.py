"""Wrong direction, zero and linkage: told at rest, by the first motion, or where fingers meet."""

import pytest

from gripper.dynamixel.models import XL330_M288
from gripper.errors import (
    GripContradicted,
    LimitExceeded,
    MechanicsContradicted,
    PositionContradicted,
    ServoFault,
    VerificationFailed,
    fingers_left,
)
from gripper.force.approach.mechanics_proof import POSITION_ITEM, standing_rows
from gripper.force.ramp import ForceRamp
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from tests.marks import LONG

RAMP = ForceRamp.linear(4.0, rate_n_s=10.0)
KEYS = r"gripper.servos\[\].direction \(.*zero_pulse \(.*gripper.linkage \(link_mm"
LARGEST_N = 2.0
"""Force in N, by the current at a stop, that a first motion with wrong settings may make."""


def stopped_n(cell) -> list[float]:
    """Return the list that gets the force in N by current of fingers that stand."""
    forces_n, since_s = [0.0], [0.0]

    def look(now_s: float) -> None:
        if any(motor.velocity_rad_s for motor in cell.motors):
            since_s[0] = now_s
        elif now_s - since_s[0] > 0.02:
            forces_n.append(cell.pressed_n)

    cell.clock.on_advance.append(look)
    return forces_n


def stands_right(cell) -> bool:
    rows = [row for row in cell.gripper.inspect().rows if row.item == POSITION_ITEM]
    assert len(rows) == len(cell.servos)
    return all(row.ok for row in rows)


def told_by_motion(cell) -> str:
    assert stands_right(cell)
    cell.gripper.start()
    forces_n = stopped_n(cell)
    began_s = cell.clock.monotonic()
    with pytest.raises(MechanicsContradicted, match=KEYS) as told:
        cell.gripper.open()
    assert cell.clock.monotonic() - began_s < 1.5
    assert cell.torques == [0, 0]
    assert max(forces_n) < LARGEST_N
    assert "nothing is held" not in fingers_left(told.value)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    return str(told.value)


@pytest.mark.parametrize(
    ("turned", "aperture_m", "changes"),
    [
        ((0, 1), 0.0, {}),
        ((0, 1), 0.0035, {}),
        LONG((0, 1), 0.0005, {"friction_error": -0.2}),
        LONG((0, 1), 0.0035, {"friction_error": 0.2}),
        # A low cap of the current leaves room for the way back.
        ((0, 1), 0.0, {"current_max_a": 0.3}),
        ((0,), 0.009, {}),
        ((1,), 0.0, {}),
        LONG((1,), 0.004, {}),
    ],
)
def test_a_wrong_direction_near_closed_is_told_by_the_first_motion(
    make_cell, turned, aperture_m, changes
) -> None:
    cell = make_cell(turned=turned, aperture_m=aperture_m, present=False, **changes)
    text = told_by_motion(cell)
    if len(turned) == 1:
        assert f"servo {turned[0] + 1}: it is blocked" in text


@pytest.mark.parametrize(("index", "aperture_m"), [(0, 0.012), (1, 0.018), (0, 0.03)])
def test_a_wrong_direction_is_refused_where_its_finger_is_beyond_the_middle(
    make_cell, index, aperture_m
) -> None:
    cell = make_cell(turned=(index,), aperture_m=aperture_m, present=False)
    assert not stands_right(cell)
    keys = r"gripper.servos\[[01]\].direction -?1, zero_pulse \d+, gripper.linkage link_mm 60"
    with pytest.raises(VerificationFailed, match=keys) as refused:
        cell.gripper.start()
    assert cell.torques == [0, 0]
    assert f"servo {index + 1} present_position" in str(refused.value)
    assert f"servo {2 - index} present_position" not in str(refused.value)


@pytest.mark.parametrize(
    ("halves_mm", "right"),
    [
        ((-4.5, 9.0), (True, True)),
        ((-5.5, 9.0), (False, True)),
        # Nearer than pads can be that meet: then no finger may be beyond the middle.
        ((-5.5, 1.0), (False, True)),
        ((-4.5, -0.5), (False, False)),
    ],
)
def test_a_finger_may_stand_beyond_the_middle_where_the_other_makes_room(halves_mm, right) -> None:
    mechanics = Mechanics(GripperSettings(), ParallelLinkage(link_m=0.06))
    positions_raw = []
    for servo, half_mm in zip(mechanics.settings.servos, halves_mm, strict=True):
        angle_rad = mechanics.linkage.angles_rad(2e-3 * half_mm)[0]
        pulses = servo.direction * angle_rad / servo.servo_model.rad_per_pulse
        positions_raw.append(servo.zero_raw + round(pulses))
    assert tuple(row.ok for row in standing_rows(mechanics, positions_raw)) == right


@pytest.mark.parametrize(("linkage", "aperture_m"), [("parallel", 0.0), ("rack", 0.002)])
def test_a_wrong_direction_of_one_servo_that_drives_both_is_told(
    make_started, linkage, aperture_m
) -> None:
    cell = make_started(
        n_servos=1, linkage=linkage, turned=(0,), aperture_m=aperture_m, present=False
    )
    with pytest.raises(MechanicsContradicted, match="free on its way back"):
        cell.gripper.open()
    assert cell.torques == [0]


def test_a_zero_that_reads_too_open_by_less_is_met_as_an_obstruction(make_started) -> None:
    cell = make_started(zero_off=(100, 100), aperture_m=0.018, present=False, force_max_n=8.0)
    forces_n = stopped_n(cell)
    cell.gripper.open(0.03)
    with pytest.raises(GripContradicted, match=r"at an opening of 1[789]\.\d mm, .*zero_pulse"):
        cell.gripper.grasp(RAMP)
    assert max(forces_n) < 8.0


@pytest.mark.slow
@pytest.mark.parametrize("aperture_m", [0.0, 0.052])
def test_a_pinion_opens_from_each_part_of_its_turn_and_grips_wide_parts(
    make_started, aperture_m
) -> None:
    cell = make_started(
        **{"n_servos": 1, "linkage": "rack", "pinion_radius_m": 0.008, "model": XL330_M288},
        **{"zero_raw": 700, "aperture_open_m": 0.065, "force_max_n": 15.0, "loop_rate_hz": 100.0},
        kt_error=-0.392,  # The torque of the catalogue.
        aperture_m=aperture_m,
        width_m=0.06,
        present=False,
    )
    assert cell.gripper.open().aperture_m == pytest.approx(0.065, abs=2e-4)
    cell.part.present = True
    assert cell.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED


def test_two_stiff_fingers_that_stand_too_open_both_get_more_current(make_started) -> None:
    """Both reach the limit of their current in the same period or in two that follow."""
    cell = make_started(aperture_m=0.031, friction_error=0.6, present=False)
    assert cell.gripper.open(0.03).aperture_m == pytest.approx(0.03, abs=4e-4)


def test_a_finger_that_is_blocked_on_its_way_is_no_stiff_gearing(make_started) -> None:
    """A part on the outside: here an open stop that comes before the opening."""
    cell = make_started(aperture_m=0.02, present=False)
    cell.mechanics._upper_rad = cell.linkage.angles_rad(0.025)[0]
    with pytest.raises(MechanicsContradicted, match=r"25\.\d mm on its way to 30\.0 mm"):
        cell.gripper.open()


@pytest.mark.parametrize(("aperture_m", "most_n"), [(0.002, 2.0), (0.0, 5.0)])
def test_a_release_after_it_goes_limp_again(make_cell, aperture_m, most_n) -> None:
    cell = make_cell(turned=(0, 1), aperture_m=aperture_m, present=False)
    told_by_motion(cell)
    cell.gripper.clear_fault()
    cell.mechanics.drive_to(aperture_m)
    forces_n = stopped_n(cell)
    for gripper in (cell.gripper, cell.new_gripper()):
        with pytest.raises(MechanicsContradicted, match=KEYS):
            gripper.release()
        assert cell.torques == [0, 0]
    assert max(forces_n) < most_n


@pytest.mark.slow
def test_a_time_that_ends_before_the_empty_fingers_meet_is_told_as_that(make_started) -> None:
    cell = make_started(present=False, approach_speed_m_s=0.004, contact_timeout_s=1.0)
    with pytest.raises(LimitExceeded, match=r"after 3 s they have closed .*contact_timeout_s"):
        cell.gripper.press_pads_together(ForceRamp.linear(3.0, 5.0))
    assert cell.torques == [1, 1]


def test_pads_that_are_pressed_more_and_more_end_a_release(make_cell) -> None:
    """Settings that were changed while a part was held by an earlier run."""
    cell = make_cell(aperture_m=0.02)
    cell.hold_part(ForceRamp.linear(1.5, rate_n_s=5.0))
    cell.gripper.close()
    cell.settings = make_cell(turned=(0, 1)).settings
    gripper = cell.new_gripper()
    with pytest.raises((PositionContradicted, ServoFault), match=KEYS):
        gripper.release()
    assert cell.torques == [1, 1]
    assert cell.peak_n < 8.0
    assert gripper.phase is GripperPhase.HELD_AFTER_FAULT

"""The gripper on simulated servos with friction, inertia and an elastic part, in virtual time."""

import itertools
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType

import pytest

from gripper.dynamixel import models
from gripper.dynamixel.control_table import BUS_WATCHDOG, TORQUE_ENABLE
from gripper.dynamixel.models import XL330_M288, XM430_W350
from gripper.errors import GripContradicted, GripperStateError, LimitExceeded, VerificationFailed
from gripper.force.ramp import ForceRamp, largest_ramp_n
from gripper.gripper import Gripper
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from tests.marks import LONG

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)
MOST_CALLS = 900
"""Largest number of calls of functions by the gripper in a period of a hold; 800 were counted."""


def test_start_corrects_the_mode_and_moves_nothing(cell) -> None:
    before_m = cell.mechanics.aperture_m
    report = cell.gripper.start()
    assert report.ok
    assert {(r.item, r.corrected) for r in report.rows if r.servo_id == 1} >= {
        ("operating_mode", True),
        ("return_delay_time", False),
        ("model_number", False),
    }
    assert cell.gripper.phase is GripperPhase.OFF
    assert cell.mechanics.aperture_m == before_m
    assert cell.register(0, "torque_enable") == 0
    assert cell.register(1, "operating_mode") == 5
    assert not any(row.corrected for row in cell.gripper.start().rows)


def test_inspecting_reports_what_start_would_correct_and_writes_nothing(cell) -> None:
    report = cell.gripper.inspect()
    # The gains follow the mode.
    items = ("operating_mode", "position_d_gain")
    assert [(row.servo_id, row.item) for row in report.failed] == [
        (servo_id, item) for servo_id in (1, 2) for item in items
    ]
    assert cell.register(1, "operating_mode") == 3
    assert cell.gripper.phase is GripperPhase.OFF


def test_another_model_is_named_and_nothing_of_it_is_rewritten(make_cell) -> None:
    cell = make_cell(model=XL330_M288, current_max_a=0.3, temperature_max_c=60.0)
    settings = GripperSettings(
        servos=tuple(ServoSettings(servo_id=i) for i in (1, 2)), current_max_a=0.3
    )
    gripper = Gripper(
        cell.bus, ParallelLinkage(link_m=0.06), settings, clock=cell.clock, force_sensor=cell.sensor
    )
    with pytest.raises(VerificationFailed, match="model_number: expected 1020, found 1200"):
        gripper.start()
    assert cell.register(0, "operating_mode") == 3


@pytest.mark.slow
@pytest.mark.parametrize("n_servos", [1, 2])
def test_one_grasp_from_start_to_close(make_cell, n_servos: int) -> None:
    cell = make_cell(n_servos=n_servos)
    gripper = cell.gripper
    gripper.start()
    opened = gripper.open()
    assert opened.aperture_m == pytest.approx(0.03, abs=0.0008)
    assert gripper.phase is GripperPhase.IDLE
    assert cell.register(0, "bus_watchdog") == 10
    cycles: list[Cycle] = []
    outcome = gripper.grasp(RAMP, cycles.append)
    assert outcome.result is GraspResult.FORCE_REACHED
    assert outcome.contact_aperture_m == pytest.approx(0.012, abs=0.0006)
    assert outcome.final_force_n == pytest.approx(8.0, abs=0.6)
    assert cell.force_n == pytest.approx(8.0, abs=0.5)
    assert gripper.phase is GripperPhase.HOLDING
    phases = [c.phase for c in cycles]
    assert phases == sorted(phases, key=[GripperPhase.APPROACHING, GripperPhase.RAMPING].index)
    setpoints = [c.setpoint_n for c in cycles if c.phase is GripperPhase.RAMPING]
    assert setpoints == sorted(setpoints)
    assert setpoints[-1] == 8.0
    assert cycles[-1].level == 0
    gripper.hold(0.5)
    released = gripper.release().state
    assert released.aperture_m == pytest.approx(0.03, abs=0.0008)
    assert gripper.phase is GripperPhase.IDLE
    gripper.close()
    gripper.close()
    assert gripper.phase is GripperPhase.OFF
    assert cell.register(0, "torque_enable") == 0
    assert cell.register(0, "bus_watchdog") == 0
    assert gripper.statistics.late == 0


@pytest.mark.slow
@pytest.mark.parametrize("stiffness_n_m", [5e3, LONG(2e4), 5e4])
@pytest.mark.parametrize("rate_n_s", [LONG(1.0), 3.0, 10.0])
def test_the_ramp_ends_without_overshoot_and_settles(make_started, stiffness_n_m, rate_n_s) -> None:
    cell = make_started(stiffness_n_m=stiffness_n_m, noise_n=0.3, approach_speed_m_s=0.01)
    true_n: list[tuple[float, float]] = []
    cell.gripper.grasp(
        ForceRamp.linear(8.0, rate_n_s, hold_s=1.0),
        lambda c: true_n.append((c.setpoint_n, cell.force_n)),
    )
    tolerance_n = 0.8
    held = [force_n for setpoint_n, force_n in true_n if setpoint_n == 8.0]
    assert cell.peak_n <= 8.0 + tolerance_n
    assert all(abs(force_n - 8.0) <= tolerance_n for force_n in held[60:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kt_error", "friction_error"), [(0.1, -0.2), (0.1, 0.2), (-0.1, -0.2), (-0.1, 0.2)]
)
def test_wrong_torque_figures_are_made_up_for_by_the_sensor(
    make_cell, kt_error, friction_error
) -> None:
    cell = make_cell(kt_error=kt_error, friction_error=friction_error, approach_speed_m_s=0.01)
    cell.hold_part(RAMP)
    cell.gripper.hold(0.5)
    assert cell.force_n == pytest.approx(8.0, abs=0.45)
    assert cell.peak_n <= 8.5


@pytest.mark.slow
def test_the_loop_keeps_its_rate_and_the_observer_sees_what_was_written(started) -> None:
    started.gripper.open()
    cycles: list[Cycle] = []
    written: list[int] = []

    def observe(cycle: Cycle) -> None:
        cycles.append(cycle)
        written.append(started.register(0, "goal_current"))

    started.gripper.grasp(RAMP, observe)
    steps = [b.t_s - a.t_s for a, b in itertools.pairwise(cycles)]
    assert max(abs(step_s - 0.005) for step_s in steps) < 0.003
    assert sum(steps) / len(steps) == pytest.approx(0.005, rel=0.01)
    for cycle, raw in zip(cycles, written, strict=True):
        if cycle.phase is GripperPhase.APPROACHING:
            assert raw == round(cycle.goal_current_a / 0.00269)


@pytest.mark.slow
def test_holding_does_not_hunt_and_takes_the_current_of_the_force(cell) -> None:
    cell.hold_part(RAMP)
    cell.peak_n, cell.least_n = 0.0, 99.0
    goals_a: list[float] = []
    cell.gripper.hold(5.0, lambda c: goals_a.append(c.goal_current_a))
    assert cell.peak_n - cell.least_n < 0.6
    assert goals_a[-1] == pytest.approx(8.0 * 0.06 / 1.8, rel=0.15)


def test_a_period_takes_few_calls(make_cell) -> None:
    """Each call costs processor time, on the controller of a real cell too."""
    cell, calls = make_cell(rate_hz=200.0, noise_n=0.1), 0
    cell.hold_part(ForceRamp.linear(4.0, rate_n_s=10.0))
    folder = str(Path(models.__file__).parent.parent)

    def count(frame: FrameType, event: str, _what: object) -> None:
        nonlocal calls
        calls += event.endswith("call") and frame.f_code.co_filename.startswith(folder)

    sys.setprofile(count)
    try:
        cell.gripper.hold(0.5)
    finally:
        sys.setprofile(None)
    assert 0 < calls / (0.5 / cell.settings.period_s) < MOST_CALLS


def ticks(cell, seconds: float, creep_m_s: float = 0.0) -> None:
    end_s = cell.clock.monotonic() + seconds
    while cell.clock.monotonic() < end_s:
        cell.clock.sleep(cell.gripper.settings.period_s)
        cell.part.width_m -= creep_m_s * cell.gripper.settings.period_s
        cell.gripper.tick()


@pytest.mark.slow
@pytest.mark.parametrize("force_n", [4.0, 10.0])
def test_a_carried_part_is_controlled_by_each_tick(cell, force_n: float) -> None:
    cell.hold_part(RAMP)
    cell.least_n = 99.0
    cell.gripper.hold_at(force_n, 0.2)
    assert cell.least_n > min(force_n, 8.0) - 1.0
    assert cell.gripper.phase is GripperPhase.HOLDING
    assert cell.register(0, "bus_watchdog") == 0
    ticks(cell, 3.0, creep_m_s=2e-4)
    assert cell.force_n == pytest.approx(force_n, abs=0.6)
    cell.gripper.keep_grip()
    ticks(cell, 1.0)
    assert cell.force_n == pytest.approx(force_n, abs=0.8)
    assert cell.gripper.release().opened == (1, 2)


@pytest.mark.slow
def test_a_request_to_stop_does_not_end_a_carry(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.hold_at(4.0)
    cell.gripper.request_stop()
    ticks(cell, 0.5)
    assert cell.force_n == pytest.approx(4.0, abs=0.6)


def test_a_part_that_a_hard_touch_compressed_may_open_the_fingers_again(make_started) -> None:
    cell = make_started(n_servos=1, linkage="rack")
    touched = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=10.0))
    cell.gripper.hold_at(2.0, 0.5)
    assert touched.contact_aperture_m < cell.mechanics.aperture_m - 0.5e-3
    assert cell.force_n > 1.0


@pytest.mark.slow
def test_a_part_is_squeezed_again_in_the_same_grip(started) -> None:
    with pytest.raises(GripperStateError):
        started.gripper.squeeze(RAMP)
    started.gripper.grasp(RAMP)
    with pytest.raises(LimitExceeded, match="carry it with less force first"):
        started.gripper.squeeze(RAMP)
    started.gripper.hold_at(2.0)
    started.least_n = 99.0
    setpoints_n: list[float] = []
    outcome = started.gripper.squeeze(RAMP, lambda c: setpoints_n.append(c.setpoint_n))
    assert outcome.result is GraspResult.FORCE_REACHED
    assert outcome.final_force_n == pytest.approx(8.0, abs=0.6)
    assert setpoints_n[0] == pytest.approx(2.0, abs=0.1)
    assert setpoints_n == sorted(setpoints_n)
    assert started.least_n > 1.0
    assert started.gripper.phase is GripperPhase.HOLDING


def test_nothing_between_the_fingers_is_a_result(make_started) -> None:
    cell = make_started(present=False, aperture_min_m=0.004)
    outcome = cell.gripper.grasp(RAMP)
    assert outcome.result is GraspResult.NO_CONTACT
    assert outcome.contact_t_s is None
    assert 0.003 < outcome.final_aperture_m <= 0.004
    assert cell.gripper.phase is GripperPhase.IDLE
    cell.gripper.open()


def test_a_hard_stop_beside_the_pads_is_an_obstruction(make_started) -> None:
    cell = make_started(stiffness_n_m=50_000.0)
    cell.sensor.gain = 0.0
    with pytest.raises(GripContradicted, match="the pads show no force"):
        cell.gripper.grasp(RAMP)
    assert 0.5 < cell.peak_n < 8.0
    cell.clock.sleep(1.0)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    cell.gripper.clear_fault()
    cell.gripper.release()


def test_a_ramp_beyond_a_limit_is_refused_before_anything_moves(make_started) -> None:
    cell = make_started(force_max_n=11.0, current_max_a=0.35)
    with pytest.raises(LimitExceeded, match=r"12.* the limit is 10"):
        cell.gripper.grasp(ForceRamp.linear(12.0, 5.0))
    with pytest.raises(LimitExceeded, match="current_max_a"):
        cell.gripper.grasp(ForceRamp.linear(9.5, 5.0))
    with pytest.raises(LimitExceeded, match="could not hold"):
        cell.gripper.grasp(ForceRamp.linear(0.2, 5.0))
    with pytest.raises(LimitExceeded, match="aperture_m"):
        cell.gripper.open(0.2)
    assert cell.register(0, "torque_enable") == 0


def test_a_ramp_so_near_to_the_cap_that_it_may_overshoot_it_is_refused(make_cell) -> None:
    cell = make_cell(force_max_n=15.0)
    with pytest.raises(LimitExceeded, match=r"14\.9 N, the limit is 13\.64 N, so that its over"):
        cell.gripper.check_ramp(ForceRamp.linear(14.9, 5.0))
    assert make_cell(force_max_n=2.0).settings.grasp_force_limit_n == pytest.approx(1.7)


@pytest.mark.parametrize("current_max_a", [0.5, 2.0])
def test_the_largest_ramp_is_the_last_one_that_is_allowed(make_cell, current_max_a: float) -> None:
    cell = make_cell(current_max_a=current_max_a)
    most_n = largest_ramp_n(cell.settings, cell.linkage)
    cell.gripper.check_ramp(ForceRamp.linear(most_n, 5.0))
    with pytest.raises(LimitExceeded, match=r"the limit is 45\.45 N|current_max_a is 0\.5 A"):
        cell.gripper.check_ramp(ForceRamp.linear(1.001 * most_n, 5.0))


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1.0, 0.3])
@pytest.mark.parametrize("friction_error", [0.0, -0.2])
def test_the_drive_alone_keeps_the_true_force_below_the_cap(
    make_started, gain: float, friction_error: float
) -> None:
    cell = make_started(force_max_n=8.0, friction_error=friction_error)
    cell.sensor.gain = gain
    with suppress(LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(7.6, 5.0, hold_s=1.0))
    assert cell.peak_n <= 8.0 * 1.01


def test_an_old_request_to_stop_does_not_end_a_new_command(started) -> None:
    started.gripper.request_stop()
    started.gripper.open()


@pytest.mark.slow
def test_commands_out_of_turn_are_refused(started) -> None:
    with pytest.raises(GripperStateError, match="hold is not possible in the state OFF"):
        started.gripper.hold(1.0)

    def reenter(_: Cycle) -> None:
        with pytest.raises(GripperStateError, match="another command runs"):
            started.gripper.release()
        with pytest.raises(GripperStateError):
            started.gripper.clear_fault()

    started.gripper.open(observer=reenter)
    started.gripper.grasp(RAMP)
    with pytest.raises(GripperStateError, match="release the part first"):
        started.gripper.open()
    with pytest.raises(LimitExceeded, match="duration_s"):
        started.gripper.hold(0.0)


def test_torque_found_on_in_another_mode_changes_nothing_before_the_release(cell) -> None:
    for servo_id in (1, 2):
        cell.bus.write(servo_id, TORQUE_ENABLE, 1)
    report = cell.gripper.start()
    assert {row.item for row in report.failed} == {"operating_mode", "position_d_gain"}
    assert cell.register(0, "operating_mode") == 3
    assert cell.register(0, "torque_enable") == 1
    cell.gripper.release()
    assert cell.register(0, "operating_mode") == 5
    assert cell.gripper.phase is GripperPhase.IDLE


def test_ticks_feed_the_watchdog_between_commands(started) -> None:
    started.gripper.tick()
    started.gripper.grasp(RAMP)
    for _ in range(20):
        started.clock.sleep(0.1)
        started.gripper.tick()
    assert started.register(0, "bus_watchdog") == 10
    assert started.force_n == pytest.approx(8.0, abs=0.5)
    assert started.gripper.read_feedback().aperture_m == pytest.approx(
        started.mechanics.aperture_m, abs=5e-4
    )


@pytest.mark.slow
def test_without_ticks_and_without_a_part_the_next_command_restarts_the_watchdog(started) -> None:
    started.gripper.open()
    started.clock.sleep(1.0)
    assert started.register(0, "bus_watchdog") == -1
    started.gripper.tick()
    outcome = started.gripper.grasp(RAMP)
    assert outcome.result is GraspResult.FORCE_REACHED


def test_a_disarmed_watchdog_is_armed_by_the_next_command(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.keep_grip()
    assert cell.register(0, "bus_watchdog") == 0
    cell.gripper.hold(0.1)
    assert cell.register(0, "bus_watchdog") == 10
    cell.bus.write(1, BUS_WATCHDOG, 0)


def test_settings_and_linkage_must_agree(cell) -> None:
    with pytest.raises(LimitExceeded, match="driven by 1"):
        Gripper(
            cell.bus,
            ParallelLinkage(link_m=0.06, n_servos=1),
            cell.settings,
            clock=cell.clock,
            force_sensor=cell.sensor,
        )


@pytest.mark.slow
def test_zero_position_near_the_end_of_a_turn_does_not_matter(make_started) -> None:
    cell = make_started(zero_raw=10)
    cell.gripper.open()
    assert cell.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED
    assert cell.gripper.release().state.aperture_m == pytest.approx(0.03, abs=0.0008)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("force_max_n", 51.0),
        ("force_max_n", float("nan")),
        ("loop_rate_hz", 5.0),
        ("aperture_min_m", 0.05),
        ("watchdog_s", 3.0),
        ("watchdog_s", 0.001),
        ("current_max_a", 0.0),
        ("settle_tolerance_n", -0.1),
        ("contact_samples", 0),
    ],
)
def test_settings_out_of_range_cannot_exist(name: str, value: float) -> None:
    with pytest.raises(LimitExceeded, match=name[:5]):
        GripperSettings(servos=(ServoSettings(servo_id=1),), **{name: value})


def test_servo_settings_out_of_range_cannot_exist() -> None:
    with pytest.raises(LimitExceeded, match="no Goal Current"):
        ServoSettings(servo_id=1, model="XL430-W250")
    for name in ("XM430W350", "xm430-w350", "XM430-W35O"):
        with pytest.raises(LimitExceeded, match=r"not known: did you mean XM430-W350\?"):
            ServoSettings(servo_id=1, model=name)
    with pytest.raises(LimitExceeded, match="'servo' is not known: use one of XM430-W350, "):
        ServoSettings(servo_id=1, model="servo")
    with pytest.raises(LimitExceeded, match="direction"):
        ServoSettings(servo_id=1, direction=0)
    with pytest.raises(LimitExceeded, match="servo_id"):
        ServoSettings(servo_id=253)
    with pytest.raises(LimitExceeded, match="zero_raw"):
        ServoSettings(servo_id=1, zero_raw=4096)
    with pytest.raises(LimitExceeded, match=r"\[1, 1\]"):
        GripperSettings(servos=(ServoSettings(servo_id=1), ServoSettings(servo_id=1)))


def test_a_servo_with_other_units_is_data(make_cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the counts in a turn, other counts of current, speed and voltage; the same motor."""
    other = replace(
        XM430_W350,
        name="other units",
        number=4321,
        current_unit_a=4.02e-3,
        current_limit_raw=800,
        pulses_per_turn=8192,
        velocity_unit_rad_s=0.01,
        voltage_unit_v=0.2,
        min_voltage_raw=48,
        max_voltage_raw=80,
        position_gains=(2000, 0, 400),
    )
    monkeypatch.setattr(models, "MODELS", {other.name: other})
    cell = make_cell(model=other, zero_raw=4096)
    assert cell.gripper.start().ok
    assert cell.gripper.open(0.02).aperture_m == pytest.approx(0.02, abs=5e-4)
    seen: list[Cycle] = []
    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=10.0, hold_s=0.2), seen.append)
    assert outcome.result is GraspResult.FORCE_REACHED
    assert cell.force_n == pytest.approx(4.0, abs=0.4)
    fastest_m_s = min(cycle.state.aperture_velocity_m_s for cycle in seen)
    assert fastest_m_s == pytest.approx(-cell.settings.approach_speed_m_s, rel=0.3)
    assert seen[-1].state.servos[0].current_a == pytest.approx(cell.motors[0].current_a, abs=0.02)
    cell.gripper.release()

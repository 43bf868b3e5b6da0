"""Goals of a grip: drifting positions, wrong stiffness, fingers that run ahead."""

from contextlib import suppress

import pytest

from benchmarks.performance.force_ramps import PARTS, Rig
from gripper.errors import LimitExceeded
from gripper.force.estimates.grip import StiffnessEstimate
from gripper.force.ramp import ForceRamp
from tests.gripper.conftest import STICKING, STICKING_DRIVE
from tests.marks import LONG


def test_a_stiffness_that_is_far_too_small_drives_no_force_beyond_the_ramp(
    cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pad that showed a force before it touched makes a stiff part look like foam."""
    soft = property(lambda _: 136.0, lambda _, __: None)
    monkeypatch.setattr(StiffnessEstimate, "stiffness_n_m", soft, raising=False)
    cell.gripper.start()
    with suppress(LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.3))
    assert 4.0 < cell.force_n <= cell.peak_n < 1.4 * 6.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, LONG(2), LONG(3)])
def test_a_quiet_hold_with_a_noisy_sensor_shows_no_slip(make_cell, seed) -> None:
    cell = make_cell(noise_n=0.3, seed=seed)
    cell.hold_part(ForceRamp.linear(4.0, rate_n_s=5.0))
    cell.gripper.hold(6.0)
    assert cell.force_n == pytest.approx(4.0, abs=0.3)


@pytest.mark.slow
def test_a_force_on_foam_that_creeps_stays_within_its_aim_for_a_long_hold() -> None:
    quality = Rig(PARTS["cork, 5 N/mm"], 0.2, servos=7, seed=103, rate_hz=200.0).grasp(4.0, 3.0)
    assert not quality.lost
    assert max(quality.holding_n, quality.overshoot_n) <= 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "ramp", "seed", "rate_hz"),
    [
        LONG("steel ball, 200 N/mm", (8.0, 3.0), 103, 200.0),
        LONG("cork, 5 N/mm", (8.0, 1.0), 203, 200.0),
        ("foam ball, 0.2 N/mm", (4.0, 1.0), 103, 200.0),  # a contact by noise, at 0.03 N
        LONG("steel ball, 200 N/mm", (8.0, 10.0), 72, None),
        ("cork, 5 N/mm", (8.0, 3.0), 72, None),
        ("foam ball, 0.2 N/mm", (2.0, 40.0), 72, None),  # moving fingers long after the ramp
        LONG("foam ball, 0.2 N/mm", (4.0, 20.0), 103, None),
    ],
)
def test_a_ramp_does_not_jump_where_the_gearing_sticks(part, ramp, seed, rate_hz) -> None:
    rig = Rig(PARTS[part], 0.2, servos=None, seed=seed, rate_hz=rate_hz, figures=STICKING)
    quality = rig.grasp(*ramp, {1: STICKING_DRIVE, 2: STICKING_DRIVE})
    assert not quality.lost
    # The aim of all ramps; frames alone reach less.
    assert quality.overshoot_n <= (max(0.3, 0.1 * ramp[0]) if rate_hz else 1.3)
    assert quality.holding_n <= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("factors", [(2.0, 0.7), LONG((0.5, 1.3))])
def test_a_slow_ramp_of_servos_that_were_never_measured_keeps_the_aim_of_overshoot(factors) -> None:
    part = PARTS["steel ball, 200 N/mm"]
    rig = Rig(part, 0.2, servos=None, seed=501, rate_hz=200.0, factors=factors, current_max_a=1.2)
    quality = rig.grasp(8.0, 1.0)
    assert not quality.lost
    assert quality.overshoot_n <= 0.1 * 8.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, LONG(2), LONG(5)])
def test_a_correction_downwards_does_not_shoot_beyond_where_friction_is_less_than_known(
    make_cell, seed
) -> None:
    cell = make_cell(rate_hz=200.0, kt_error=0.09, friction_error=-0.15, seed=seed)
    cell.hold_part(ForceRamp.linear(6.0, rate_n_s=20.0))
    cell.gripper.hold(0.5)
    cell.sensor.gain = 1.06
    corrected_n = 6.0 / cell.sensor.gain
    cell.least_n = 6.0
    cell.gripper.hold(1.5)
    # Against the direction of the ramp the law leaves 0.3 N of the force that it estimates.
    assert cell.force_n == pytest.approx(corrected_n, abs=0.35)
    assert cell.least_n > corrected_n - 0.4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_part_met_with_more_than_the_ramp_asks_is_pressed_no_harder(make_started, seed) -> None:
    cell = make_started(
        rate_hz=200.0,
        kt_error=0.09,
        friction_error=-0.15,
        seed=seed,
        noise_n=0.1,
        approach_speed_m_s=0.06,
        approach_force_n=4.0,
    )
    forces_n: list[float] = []
    ramp = ForceRamp.linear(0.8, rate_n_s=10.0)
    cell.gripper.grasp(ramp, lambda c: forces_n.append(cell.force_n) if c.setpoint_n else None)
    assert 0.9 < forces_n[0] == pytest.approx(max(forces_n), abs=0.02)

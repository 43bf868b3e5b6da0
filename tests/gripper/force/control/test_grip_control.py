"""Goals of a grip: drifting positions, wrong stiffness, fingers that run ahead."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

import pytest

from benchmarks.performance.force_ramps import PARTS, Rig
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import ForceSensorStale, GripperError, LimitExceeded
from gripper.force.estimates.grip import StiffnessEstimate
from gripper.force.ramp import ForceRamp
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.state import GripperPhase
from tests.gripper.conftest import STICKING
from tests.gripper.force.pads import WrongPads
from tests.marks import LONG


def test_a_stiffness_that_is_far_too_small_drives_no_force_beyond_the_ramp(
    cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pad that showed a force before it touched makes a stiff part look like foam."""
    monkeypatch.setattr(StiffnessEstimate, "stiffness_n_m", 136.0)
    cell.gripper.start()
    with suppress(LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.3))
    assert 4.0 < cell.force_n <= cell.peak_n < 8.0


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.5, 2.0])
def test_pads_that_report_too_much_do_not_open_the_fingers_beyond_the_touch(
    make_started, factor
) -> None:
    """A light grip: the loop backs off from a force that is not there."""
    cell = make_started(stiffness_n_m=2000.0, approach_speed_m_s=0.02)
    pads = WrongPads(
        cell, lambda it: replace(it, force_n=tuple(factor * n + 1.0 for n in it.force_n))
    )
    least_n: list[float] = []

    def observe(cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            pads.began_s = pads.began_s or cycle.t_s
            least_n.append(cell.force_n)

    with suppress(LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(0.7, rate_n_s=20.0, hold_s=1.5), observe)
    assert min(least_n) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("loop_rate_hz", [100.0, 200.0])
@pytest.mark.parametrize("stiffness_n_m", [3e3, 1e4, 5e4])
@pytest.mark.parametrize("wrong", [(5.3, False), (13.0, True), (13.4, True)])
def test_pads_that_report_too_little_let_no_force_above_the_cap(
    make_started, loop_rate_hz, stiffness_n_m, wrong
) -> None:
    """Only the current bounds the force then, and inertia adds to what it makes."""
    at_n, invalid = wrong
    cell = make_started(
        width_m=0.03,
        stiffness_n_m=stiffness_n_m,
        aperture_m=0.034,
        aperture_open_m=0.036,
        force_max_n=15.0,
        loop_rate_hz=loop_rate_hz,
    )

    def too_little(sample):
        valid = not invalid or sample.t_s < pads.began_s + 0.03
        return replace(sample, force_n=tuple(0.4 * n for n in sample.force_n), valid=valid)

    pads = WrongPads(cell, too_little)

    def observe(cycle) -> None:
        if pads.began_s is None and cycle.setpoint_n > at_n:
            pads.began_s = cycle.t_s

    with pytest.raises(ForceSensorStale if invalid else LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.5), observe)
    assert pads.began_s is not None
    assert 12.0 < cell.peak_n < 15.1


LIES = {
    "stand still": lambda it, first: replace(it, force_n=first.force_n),
    "half": lambda it, _: replace(it, force_n=tuple(0.5 * n for n in it.force_n)),
}
"""Samples that show too little force, made of the newest one and of the first wrong one."""


@pytest.mark.slow
@pytest.mark.parametrize("rate_n_s", [3.0, 10.0, 40.0])
@pytest.mark.parametrize("lie", LIES)
def test_no_wrong_sample_makes_far_more_force_than_is_asked_for(
    make_started, lie, rate_n_s
) -> None:
    """Torque constant and friction are off as far as they may be: the current alone decides."""
    cell = make_started(
        stiffness_n_m=5e3, kt_error=0.1, friction_error=-0.15, force_max_n=15.0, rate_hz=200.0
    )
    first: list[ForceSample] = []

    def wrong(sample: ForceSample) -> ForceSample:
        first[:] = first or [sample]
        return LIES[lie](sample, first[0])

    pads = WrongPads(cell, wrong)

    def observe(cycle) -> None:
        if pads.began_s is None and cycle.setpoint_n > 2.0:
            pads.began_s = cycle.t_s

    with suppress(GripperError):
        cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=rate_n_s, hold_s=0.3), observe)
    cell.clock.sleep(0.5)
    assert pads.began_s is not None
    # A fifth more, and the band of friction of these servos at 60 mm.
    assert cell.peak_n < 1.2 * 6.0 + 3.7


RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


SETTINGS = GripperSettings(servos=(ServoSettings(servo_id=1),))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, LONG(2), LONG(3)])
def test_a_quiet_hold_with_a_noisy_sensor_shows_no_slip(make_cell, seed) -> None:
    cell = make_cell(noise_n=0.3, seed=seed)
    cell.hold_part(RAMP)
    cell.gripper.hold(6.0)
    assert cell.force_n == pytest.approx(4.0, abs=0.3)


@pytest.mark.slow
def test_a_force_on_foam_that_creeps_stays_within_its_aim_for_a_long_hold() -> None:
    quality = Rig(PARTS["cork, 5 N/mm"], 0.2, servos=7, seed=103, rate_hz=200.0).grasp(4.0, 3.0)
    assert not quality.lost
    assert max(quality.holding_n, quality.overshoot_n) <= 0.3


def sticking(part: str, seed: int, rate_hz: float | None = None) -> Rig:
    """Return a rig whose gearing sticks."""
    return Rig(PARTS[part], 0.2, servos=None, seed=seed, rate_hz=rate_hz, gearing=STICKING)


@pytest.fixture(scope="module")
def by_messages() -> Mapping[int, DriveCharacteristic]:
    """Return the drives of `sticking`, measured with messages, for all parts."""
    return sticking("cork, 5 N/mm", 103, 200.0).measure_servos()


@pytest.fixture(scope="module")
def by_frames() -> Mapping[int, DriveCharacteristic]:
    """Return the drives of `sticking`, measured with frames, for all parts."""
    return sticking("cork, 5 N/mm", 103).measure_servos()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "final_n", "rate_n_s", "seed"),
    [
        LONG("steel ball, 200 N/mm", 8.0, 3.0, 103),
        LONG("cork, 5 N/mm", 8.0, 1.0, 203),
        ("foam ball, 0.2 N/mm", 4.0, 1.0, 103),  # a contact by noise, at 0.03 N
    ],
)
def test_a_slow_ramp_does_not_jump_where_the_gearing_sticks(
    part, final_n, rate_n_s, seed, by_messages
) -> None:
    quality = sticking(part, seed, 200.0).grasp(final_n, rate_n_s, by_messages)
    assert not quality.lost
    assert quality.overshoot_n <= max(0.3, 0.1 * final_n)  # the aim of all ramps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "final_n", "rate_n_s"),
    [
        LONG("steel ball, 200 N/mm", 8.0, 10.0),
        ("cork, 5 N/mm", 8.0, 3.0),
        ("foam ball, 0.2 N/mm", 2.0, 40.0),  # the fingers still move long after the ramp
        LONG("foam ball, 0.2 N/mm", 4.0, 20.0),
    ],
)
@pytest.mark.parametrize("seed", [72, LONG(103)])
def test_frames_alone_hold_a_force_where_the_gearing_sticks(
    part, final_n, rate_n_s, seed, by_frames
) -> None:
    quality = sticking(part, seed).grasp(final_n, rate_n_s, by_frames)
    assert not quality.lost
    assert quality.overshoot_n <= 1.2
    assert quality.holding_n <= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("factors", [(2.0, 0.7), LONG((0.5, 1.3))])
def test_a_slow_ramp_of_servos_that_were_never_measured_stays_below_its_set_point(factors) -> None:
    part = PARTS["steel ball, 200 N/mm"]
    rig = Rig(part, 0.2, servos=None, seed=501, rate_hz=200.0, factors=factors, current_max_a=1.2)
    quality = rig.grasp(8.0, 1.0)
    assert not quality.lost
    assert quality.overshoot_n <= 0.3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 5])
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
    assert cell.force_n == pytest.approx(corrected_n, abs=0.3)
    assert cell.least_n > corrected_n - 0.4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_part_met_with_more_than_the_ramp_asks_for_is_pressed_no_harder(
    make_started, seed
) -> None:
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

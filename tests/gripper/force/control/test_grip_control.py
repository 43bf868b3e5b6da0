"""Goals of a grip: drifting positions, wrong stiffness, fingers that run ahead."""

import random
from contextlib import suppress
from dataclasses import replace
from statistics import median

import pytest

from benchmarks.performance.force_ramps import PARTS
from benchmarks.performance.touch import TouchRig
from gripper.errors import (
    ForceAboveCap,
    ForceSensorStale,
    GripContradicted,
    GripperError,
    LimitExceeded,
)
from gripper.force.estimates.stiffness import StiffnessEstimate
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.force_sensor import ForceSample
from gripper.outcome import GraspResult
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import GripperPhase
from tests.values import make_state


def test_a_stiffness_that_is_far_too_small_drives_no_force_beyond_the_ramp(
    cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pad that showed a force before it touched makes a stiff part look like foam."""
    monkeypatch.setattr(StiffnessEstimate, "stiffness_n_m", 136.0)
    cell.gripper.start()
    outcome = cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.3))
    assert outcome.result is GraspResult.FORCE_REACHED
    assert cell.peak_n < 7.0


class WrongPads:
    """Pads that report another force from a moment on.

    Parameters
    ----------
    cell
        Its sensor is replaced.
    report
        Returns the sample that the pads give in place of the right one.
    """

    def __init__(self, cell, report) -> None:
        self.began_s: float | None = None
        self._latest_force = cell.sensor.latest_force
        self._report = report
        cell.sensor.latest_force = self.latest_force

    def latest_force(self):
        sample = self._latest_force()
        if sample is None or self.began_s is None:
            return sample
        return self._report(sample)


@pytest.mark.parametrize("factor", [1.5, 2.0])
def test_pads_that_report_too_much_do_not_open_the_fingers_beyond_the_touch(
    make_cell, make_part, factor
) -> None:
    """A light grip: the loop backs off from a force that is not there."""
    cell = make_cell(part=make_part(stiffness_n_m=2000.0), approach_speed_m_s=0.02)
    pads = WrongPads(
        cell, lambda it: replace(it, force_n=tuple(factor * n + 1.0 for n in it.force_n))
    )
    cell.gripper.start()
    least_n: list[float] = []

    def observe(cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            pads.began_s = pads.began_s or cycle.t_s
            least_n.append(cell.force_n)

    with suppress(LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(0.7, rate_n_s=20.0, hold_s=1.5), observe)
    assert min(least_n) > 0.05


def test_friction_that_breaks_on_a_short_lever_is_no_jump_of_the_zero(make_cell, make_part) -> None:
    part = make_part(stiffness_n_m=3000.0)
    cell = make_cell(linkage="rack", part=part, rate_hz=200.0, noise_n=0.05, delay_s=0.005)
    cell.gripper.start()
    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=1.0, hold_s=0.5))
    assert outcome.result is GraspResult.FORCE_REACHED


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("final_n", [0.7, 4.0])
@pytest.mark.parametrize("moment", ["ramp", "hold"])
def test_pads_whose_zero_jumps_on_a_part_do_not_let_it_go(
    make_cell, rate_hz, final_n, moment
) -> None:
    """The fingers stand and press as before: it is no force that there is too much of."""
    cell = make_cell(rate_hz=rate_hz)
    pads = WrongPads(cell, lambda it: replace(it, force_n=tuple(n + 4.0 for n in it.force_n)))
    cell.gripper.start()
    least_n: list[float] = []

    def observe(cycle) -> None:
        if cycle.setpoint_n > 0.0 and (moment == "ramp" or cycle.level is not None):
            pads.began_s = pads.began_s or cycle.t_s
            least_n.append(cell.force_n)

    with pytest.raises(LimitExceeded, match="their zero has jumped") as error:
        cell.gripper.grasp(ForceRamp.linear(final_n, rate_n_s=20.0, hold_s=1.5), observe)
    assert "the grip kept" in str(error.value)
    cell.clock.sleep(1.0)
    least_n.append(cell.force_n)
    assert min(least_n) > 0.8 * least_n[0] > 0.3


@pytest.mark.parametrize("rate_hz", [None, 500.0])
def test_a_force_that_jumps_above_the_cap_is_told_as_that(make_cell, rate_hz) -> None:
    """It may be less above the cap than noise alone may be: the jump shows that it is none."""
    cell = make_cell(rate_hz=rate_hz, noise_n=0.05, force_max_n=7.0, force_noise_n=2.0)

    def jumped(sample: ForceSample) -> ForceSample:
        shift_n = 4.0 if sample.t_s > pads.began_s else 0.0
        return replace(sample, force_n=tuple(n + shift_n for n in sample.force_n))

    pads = WrongPads(cell, jumped)
    cell.hold_part(ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2))

    def observe(cycle) -> None:
        pads.began_s = pads.began_s or cycle.t_s

    with pytest.raises(ForceAboveCap, match="force_max_n is 7"):
        cell.gripper.hold(1.5, observe)


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("final_n", [1.0, 4.0, 8.0])
@pytest.mark.parametrize("moment", ["ramp", "hold"])
def test_pads_that_show_nothing_any_more_do_not_let_a_part_go(
    make_cell, rate_hz, final_n, moment
) -> None:
    """Nothing but the fingers, which do not close, shows the part then."""
    cell = make_cell(rate_hz=rate_hz, slip_drop_n=20.0)
    pads = WrongPads(cell, lambda it: replace(it, force_n=tuple(0.0 * n for n in it.force_n)))
    cell.gripper.start()
    least_n: list[float] = []

    def observe(cycle) -> None:
        late = cycle.setpoint_n > 0.6 * final_n if moment == "ramp" else cycle.level is not None
        if late or pads.began_s is not None:
            pads.began_s = pads.began_s or cycle.t_s
            least_n.append(cell.force_n)

    with pytest.raises(GripContradicted, match="the fingers stand at an opening of"):
        cell.gripper.grasp(ForceRamp.linear(final_n, rate_n_s=10.0, hold_s=1.5), observe)
    cell.clock.sleep(1.0)
    least_n.append(cell.force_n)
    assert min(least_n) > 0.7 * least_n[0] > 0.3
    assert max(least_n) < final_n + 2.0


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("level_n", [0.8, 1.5])
def test_a_light_part_that_is_taken_is_lost_though_no_finger_runs(
    make_cell, rate_hz, level_n
) -> None:
    """Friction holds the fingers where the part was: they close only when they try to."""
    cell = make_cell(rate_hz=rate_hz, slip_drop_n=20.0)
    cell.gripper.start()

    def take(cycle) -> None:
        if cycle.level is not None:
            cell.part.present = False

    outcome = cell.gripper.grasp(ForceRamp.linear(level_n, rate_n_s=4.0, hold_s=1.5), take)
    assert outcome.result is GraspResult.PART_LOST


@pytest.mark.parametrize("loop_rate_hz", [100.0, 200.0])
@pytest.mark.parametrize("stiffness_n_m", [3e3, 1e4, 5e4])
@pytest.mark.parametrize("wrong", [(5.3, False), (13.5, True), (13.9, True)])
def test_pads_that_report_too_little_let_no_force_above_the_cap(
    make_cell, make_part, loop_rate_hz, stiffness_n_m, wrong
) -> None:
    """Only the current bounds the force then, and inertia adds to what it makes."""
    at_n, invalid = wrong
    cell = make_cell(
        part=make_part(width_m=0.03, stiffness_n_m=stiffness_n_m),
        aperture_m=0.034,
        aperture_open_m=0.036,
        force_max_n=15.0,
        loop_rate_hz=loop_rate_hz,
    )

    def too_little(sample):
        valid = not invalid or sample.t_s < pads.began_s + 0.03
        return replace(sample, force_n=tuple(0.4 * n for n in sample.force_n), valid=valid)

    pads = WrongPads(cell, too_little)
    cell.gripper.start()

    def observe(cycle) -> None:
        if pads.began_s is None and cycle.setpoint_n > at_n:
            pads.began_s = cycle.t_s

    with suppress(ForceSensorStale):
        cell.gripper.grasp(ForceRamp.linear(14.2, rate_n_s=20.0, hold_s=0.5), observe)
    assert pads.began_s is not None
    assert 12.0 < cell.peak_n < 15.1


LIES = {
    "stand still": lambda it, first: replace(it, force_n=first.force_n),
    "half": lambda it, _: replace(it, force_n=tuple(0.5 * n for n in it.force_n)),
}
"""Samples that show too little force, made of the newest one and of the first wrong one."""


@pytest.mark.parametrize("rate_n_s", [10.0, 40.0])
@pytest.mark.parametrize("lie", LIES)
def test_no_wrong_sample_makes_far_more_force_than_is_asked_for(
    make_cell, make_part, lie, rate_n_s
) -> None:
    """Torque constant and friction are off as far as they may be: the current alone decides."""
    cell = make_cell(
        part=make_part(stiffness_n_m=5e3),
        kt_error=0.1,
        friction_error=-0.15,
        force_max_n=15.0,
        rate_hz=200.0,
    )
    first: list[ForceSample] = []

    def wrong(sample: ForceSample) -> ForceSample:
        first[:] = first or [sample]
        return LIES[lie](sample, first[0])

    pads = WrongPads(cell, wrong)
    cell.gripper.start()

    def observe(cycle) -> None:
        if pads.began_s is None and cycle.setpoint_n > 2.0:
            pads.began_s = cycle.t_s

    with suppress(GripperError):
        cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=rate_n_s, hold_s=0.3), observe)
    cell.clock.sleep(0.5)
    assert pads.began_s is not None
    # A fifth more, and the band of friction of these servos at 60 mm.
    assert cell.peak_n < 1.2 * 6.0 + 3.7


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("early", [True, False], ids=["before the approach", "in the approach"])
def test_fingers_that_pads_send_through_the_air_stop_before_they_hit_the_part(
    make_cell, make_part, early, rate_hz
) -> None:
    """A zero that jumps shows a contact where there is none, and nothing resists the ramp."""
    cell = make_cell(
        part=make_part(width_m=0.008), aperture_m=0.03, force_max_n=15.0, rate_hz=rate_hz
    )
    pads = WrongPads(cell, lambda it: replace(it, force_n=tuple(n + 7.0 for n in it.force_n)))
    cell.gripper.start()

    def observe(cycle) -> None:
        near = cycle.state.aperture_m < 0.025
        if cycle.phase is GripperPhase.APPROACHING and (early or near):
            pads.began_s = pads.began_s or cycle.t_s

    with pytest.raises(GripContradicted, match="ended without a part"):
        cell.gripper.grasp(ForceRamp.linear(14.2, rate_n_s=20.0, hold_s=0.3), observe)
    cell.clock.sleep(1.0)
    assert cell.peak_n == 0.0
    assert cell.mechanics.aperture_m > 0.015


@pytest.mark.parametrize("believed_n_m", [700.0, 4600.0])
def test_a_soft_part_that_yields_fast_is_not_lost(
    make_cell, make_part, monkeypatch, believed_n_m
) -> None:
    """The first samples make foam look stiff; the pads show that it is there."""

    def first_wrong(estimate: StiffnessEstimate) -> float | None:
        small = estimate._anchor is None or estimate._anchor[0] < 2.0
        return believed_n_m if small else estimate._stiffness_n_m

    monkeypatch.setattr(StiffnessEstimate, "stiffness_n_m", property(first_wrong))
    cell = make_cell(
        part=make_part(width_m=0.05, stiffness_n_m=400.0),
        aperture_m=0.055,
        aperture_open_m=0.055,
        slip_travel_m=0.05,
    )
    cell.gripper.start()
    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=10.0, hold_s=0.3))
    assert outcome.result is GraspResult.FORCE_REACHED
    assert cell.force_n == pytest.approx(4.0, abs=0.5)


def test_a_soft_part_that_noise_shows_early_is_not_lost_before_it_is_held() -> None:
    """The approach ends at 0.07 N; the pads are empty for the first tenth of a second."""
    rig = TouchRig(PARTS["foam ball, 0.2 N/mm"], 200.0, 5033, approach_speed_m_s=0.012)
    rig.gripper.start()
    outcome = rig.gripper.grasp(ForceRamp.linear(3.0, rate_n_s=3.0))
    assert outcome.result is GraspResult.FORCE_REACHED


def test_a_soft_part_that_is_taken_in_the_ramp_is_lost(make_cell, make_part) -> None:
    cell = make_cell(
        part=make_part(width_m=0.05, stiffness_n_m=400.0), aperture_m=0.055, aperture_open_m=0.055
    )
    cell.gripper.start()
    taken_s: list[float] = []
    ramping_s: list[float] = []

    def take(cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            ramping_s.append(cycle.t_s)
        if not taken_s and cycle.setpoint_n > 2.5:
            cell.part.present = False
            taken_s.append(cycle.t_s)

    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=10.0, hold_s=0.3), take)
    assert outcome.result is GraspResult.PART_LOST
    assert ramping_s[-1] - taken_s[0] < 0.1


def slope_n_m(rate_hz: float, noise_n: float, seed: int = 0) -> float:
    """Return the stiffness found over 6 mm of a part of 200 N/m, from noisy samples."""
    state = make_state(aperture_velocity_m_s=-0.012)
    estimate = StiffnessEstimate(GripperSettings(servos=(ServoSettings(servo_id=1),)))
    generator = random.Random(seed)
    for i in range(100):
        now_s = 0.005 * i
        if i % round(200.0 / rate_hz) == 0:
            grip_n = 200.0 * 0.012 * now_s + generator.gauss(0.0, noise_n)
            sample = ForceSample(t_s=now_s, force_n=(grip_n, grip_n), lag_s=0.0)
        moving = replace(state, t_s=now_s, aperture_m=0.05 - 0.012 * now_s)
        estimate.push(Moment(now_s=now_s, dt_s=0.005, state=moving, sample=sample))
    assert estimate.stiffness_n_m is not None
    return estimate.stiffness_n_m


def test_the_noise_of_fast_samples_is_no_stiffness() -> None:
    assert slope_n_m(50.0, 0.0) == pytest.approx(200.0, rel=0.05)
    found_n_m = median(slope_n_m(200.0, 0.15, seed) for seed in range(7))
    assert found_n_m == pytest.approx(200.0, rel=0.35)

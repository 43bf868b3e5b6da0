"""Pads whose zero jumps on a part, and friction that breaks, which is no such jump."""

from dataclasses import replace

import pytest

from gripper.errors import ForceAboveCap, LimitExceeded
from gripper.force.ramp import ForceRamp
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from tests.gripper.force.pads import WrongPads


@pytest.mark.slow
def test_friction_that_breaks_on_a_short_lever_is_no_jump_of_the_zero(make_started) -> None:
    cell = make_started(
        linkage="rack", stiffness_n_m=3000.0, rate_hz=200.0, noise_n=0.05, delay_s=0.005
    )
    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=1.0, hold_s=0.5))
    assert outcome.result is GraspResult.FORCE_REACHED


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("final_n", [0.7, 4.0])
@pytest.mark.parametrize("moment", ["ramp", "hold"])
def test_pads_whose_zero_jumps_on_a_part_do_not_let_it_go(
    make_started, rate_hz, final_n, moment
) -> None:
    """The fingers stand and press as before: it is no force that there is too much of."""
    # A slow touch adds no force, which would have to fall first.
    cell = make_started(rate_hz=rate_hz, approach_speed_m_s=0.008)
    pads = WrongPads(cell, lambda it: replace(it, force_n=tuple(n + 4.0 for n in it.force_n)))
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

"""Confirmation that nothing is held, before the fingers open by themselves."""

from dataclasses import replace

import pytest

from gripper.errors import GripContradicted
from gripper.force.ramp import ForceRamp
from gripper.values.state import GripperPhase
from tests.gripper.force.pads import WrongPads


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("early", [True, False], ids=["before the approach", "in the approach"])
def test_fingers_that_pads_send_through_the_air_stop_before_they_hit_the_part(
    make_started, early, rate_hz
) -> None:
    """A zero that jumps shows a contact where there is none, and nothing resists the ramp."""
    cell = make_started(width_m=0.008, aperture_m=0.03, force_max_n=15.0, rate_hz=rate_hz)
    pads = WrongPads(cell, lambda it: replace(it, force_n=tuple(n + 7.0 for n in it.force_n)))

    def observe(cycle) -> None:
        near = cycle.state.aperture_m < 0.025
        if cycle.phase is GripperPhase.APPROACHING and (early or near):
            pads.began_s = pads.began_s or cycle.t_s

    with pytest.raises(GripContradicted, match="ended without a part"):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.3), observe)
    cell.clock.sleep(1.0)
    assert cell.peak_n == 0.0
    assert cell.mechanics.aperture_m > 0.012


def test_closed_fingers_that_feel_a_little_name_a_small_part(make_started) -> None:
    cell = make_started(width_m=0.0014, stiffness_n_m=2000.0, noise_n=0.02, aperture_m=0.01)
    with pytest.raises(
        GripContradicted, match=r"a part is too small to be held, or the pads press"
    ):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=20.0))
    assert cell.torques == [1, 1]

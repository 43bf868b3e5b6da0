"""Pads that report another force than there is: the part stays, and the cap too."""

import pytest

from gripper.errors import (
    ForceAboveCap,
    ForceImbalance,
    ForceSensorStale,
    GripContradicted,
    LimitExceeded,
)
from gripper.force.ramp import ForceRamp
from gripper.values.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


@pytest.mark.parametrize(
    ("in_s", "final_n", "rate_hz"),
    [(0.0, 0.7, None), (0.0, 4.0, 500.0), (2.0, 0.7, 500.0), (2.0, 4.0, None)],
    ids=["ramp", "ramp, messages", "hold, messages", "hold"],
)
def test_pads_whose_zero_jumps_on_a_part_do_not_let_it_go(
    make_started, in_s, final_n, rate_hz
) -> None:
    """The fingers stand and press as before: it is no force that there is too much of."""
    # A slow touch adds no force, which would have to fall first.
    cell = make_started(rate_hz=rate_hz, approach_speed_m_s=0.008)
    held_n: list[float] = []

    def jump() -> None:
        cell.sensor.offset_n, cell.least_n = 4.0, cell.force_n
        held_n.append(cell.force_n)

    observe = cell.once(jump, at_n=0.1, in_s=in_s)
    with pytest.raises(LimitExceeded, match=r"their zero has jumped, or .* the grip kept"):
        cell.gripper.grasp(ForceRamp.linear(final_n, rate_n_s=20.0, hold_s=1.5), observe)
    cell.clock.sleep(1.0)
    assert cell.least_n > 0.8 * held_n[0] > 0.3


@pytest.mark.parametrize("rate_hz", [None, 500.0])
def test_a_force_that_jumps_above_the_cap_is_told_as_that(make_cell, rate_hz) -> None:
    """It may be less above the cap than noise alone may be: the jump shows that it is none."""
    cell = make_cell(rate_hz=rate_hz, noise_n=0.05, force_max_n=7.0, force_noise_n=2.0)
    cell.hold_part(RAMP)
    cell.sensor.offset_n = 4.0
    with pytest.raises(ForceAboveCap, match="force_max_n is 7"):
        cell.gripper.hold(1.5)


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("in_s", [0.0, 0.4], ids=["before the approach", "in the approach"])
def test_fingers_that_pads_send_through_the_air_stop_before_they_hit_the_part(
    make_started, in_s, rate_hz
) -> None:
    """A zero that jumps shows a contact where there is none, and nothing resists the ramp."""
    cell = make_started(width_m=0.008, aperture_m=0.03, force_max_n=15.0, rate_hz=rate_hz)
    jump = cell.once(lambda: setattr(cell.sensor, "offset_n", 7.0), in_s=in_s)
    with pytest.raises(GripContradicted, match="ended without a part"):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.3), jump)
    cell.clock.sleep(1.0)
    assert cell.peak_n == 0.0
    assert cell.mechanics.aperture_m > 0.012


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop_rate_hz", "stiffness_n_m", "at_n", "valid"),
    [(100.0, 5e4, 5.3, True), (200.0, 3e3, 13.0, False), (100.0, 1e4, 13.4, False)],
)
def test_pads_that_report_too_little_let_no_force_above_the_cap(
    make_started, loop_rate_hz, stiffness_n_m, at_n, valid
) -> None:
    """Only the current bounds the force then, and inertia adds to what it makes."""
    cell = make_started(
        width_m=0.03,
        stiffness_n_m=stiffness_n_m,
        aperture_m=0.034,
        aperture_open_m=0.036,
        force_max_n=15.0,
        loop_rate_hz=loop_rate_hz,
    )

    def fail() -> None:
        cell.sensor.gain, cell.sensor.valid = 0.4, valid

    with pytest.raises(LimitExceeded if valid else ForceSensorStale):
        cell.gripper.grasp(
            ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.5), cell.once(fail, at_n=at_n)
        )
    assert 12.0 < cell.peak_n < 15.1


def test_closed_fingers_that_feel_a_little_name_a_small_part(make_started) -> None:
    cell = make_started(width_m=0.0014, stiffness_n_m=2000.0, noise_n=0.02, aperture_m=0.01)
    with pytest.raises(GripContradicted, match="part is too small to be held, or the pads press"):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=20.0))
    assert cell.torques == [1, 1]


def test_a_finger_that_pushes_alone_freezes_both(cell) -> None:
    cell.hold_part(RAMP)
    measure, begun_s = cell.sensor.measure, cell.clock.monotonic()
    cell.sensor.measure = lambda now_s, force_n: measure(now_s, (force_n[0], 0.2))
    with pytest.raises(ForceImbalance, match="both are frozen"):
        cell.gripper.hold(2.0)
    assert cell.clock.monotonic() - begun_s < 0.5
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    assert cell.force_n > 3.0

"""Pads that report another force than there is: the part stays, and the cap too."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from gripper.errors import (
    ForceAboveCap,
    ForceImbalance,
    ForceSensorStale,
    GripContradicted,
    LimitExceeded,
)
from gripper.force.ramp import ForceRamp
from gripper.values.force_sensor import ForceSample
from gripper.values.state import Cycle, GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


class WrongPads:
    """Pads of a cell that report another force from the first cycle on that is due.

    ``report`` returns a wrong sample for a right one and the time since then in s.
    """

    def __init__(self, cell, due: Callable[[Cycle], bool], report) -> None:
        self.began_s: float | None = None
        self.least_n: list[float] = []
        self._cell, self._due, self._report = cell, due, report
        self._latest_force = cell.sensor.latest_force
        cell.sensor.latest_force = self.latest_force

    def latest_force(self) -> ForceSample | None:
        sample = self._latest_force()
        if sample is None or self.began_s is None:
            return sample
        return self._report(sample, sample.t_s - self.began_s)

    def observe(self, cycle: Cycle) -> None:
        """Begin where it is due; keep the true forces from then on."""
        if self.began_s is None and self._due(cycle):
            self.began_s = cycle.t_s
        if self.began_s is not None:
            self.least_n.append(self._cell.force_n)


def more(shift_n: float) -> Callable[[ForceSample, float], ForceSample]:
    """Return a report of more force on both pads."""
    return lambda it, _s: replace(it, force_n=tuple(n + shift_n for n in it.force_n))


@pytest.mark.parametrize(
    ("moment", "final_n", "rate_hz"),
    [("ramp", 0.7, None), ("ramp", 4.0, 500.0), ("hold", 0.7, 500.0), ("hold", 4.0, None)],
)
def test_pads_whose_zero_jumps_on_a_part_do_not_let_it_go(
    make_started, moment, final_n, rate_hz
) -> None:
    """The fingers stand and press as before: it is no force that there is too much of."""
    # A slow touch adds no force, which would have to fall first.
    cell = make_started(rate_hz=rate_hz, approach_speed_m_s=0.008)
    due = (lambda c: c.setpoint_n > 0.0) if moment == "ramp" else (lambda c: c.level is not None)
    pads = WrongPads(cell, due, more(4.0))
    with pytest.raises(LimitExceeded, match=r"their zero has jumped, or .* the grip kept"):
        cell.gripper.grasp(ForceRamp.linear(final_n, rate_n_s=20.0, hold_s=1.5), pads.observe)
    cell.clock.sleep(1.0)
    assert min(*pads.least_n, cell.force_n) > 0.8 * pads.least_n[0] > 0.3


@pytest.mark.parametrize("rate_hz", [None, 500.0])
def test_a_force_that_jumps_above_the_cap_is_told_as_that(make_cell, rate_hz) -> None:
    """It may be less above the cap than noise alone may be: the jump shows that it is none."""
    cell = make_cell(rate_hz=rate_hz, noise_n=0.05, force_max_n=7.0, force_noise_n=2.0)
    pads = WrongPads(
        cell, lambda _: True, lambda it, since_s: more(4.0)(it, 0.0) if since_s > 0.0 else it
    )
    cell.hold_part(RAMP)
    with pytest.raises(ForceAboveCap, match="force_max_n is 7"):
        cell.gripper.hold(1.5, pads.observe)


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("below_m", [1.0, 0.025], ids=["before the approach", "in the approach"])
def test_fingers_that_pads_send_through_the_air_stop_before_they_hit_the_part(
    make_started, below_m, rate_hz
) -> None:
    """A zero that jumps shows a contact where there is none, and nothing resists the ramp."""
    cell = make_started(width_m=0.008, aperture_m=0.03, force_max_n=15.0, rate_hz=rate_hz)
    pads = WrongPads(cell, lambda c: c.state.aperture_m < below_m, more(7.0))
    with pytest.raises(GripContradicted, match="ended without a part"):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.3), pads.observe)
    cell.clock.sleep(1.0)
    assert cell.peak_n == 0.0
    assert cell.mechanics.aperture_m > 0.012


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop_rate_hz", "stiffness_n_m", "at_n", "invalid"),
    [(100.0, 5e4, 5.3, False), (200.0, 3e3, 13.0, True), (100.0, 1e4, 13.4, True)],
)
def test_pads_that_report_too_little_let_no_force_above_the_cap(
    make_started, loop_rate_hz, stiffness_n_m, at_n, invalid
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

    def too_little(sample: ForceSample, since_s: float) -> ForceSample:
        valid = not invalid or since_s < 0.03
        return replace(sample, force_n=tuple(0.4 * n for n in sample.force_n), valid=valid)

    pads = WrongPads(cell, lambda c: c.setpoint_n > at_n, too_little)
    with pytest.raises(ForceSensorStale if invalid else LimitExceeded):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.5), pads.observe)
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

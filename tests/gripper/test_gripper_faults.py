"""Faults: the grip is kept, the fault latched, nothing is pushed on with."""

import pytest

from gripper.errors import BusTimeout, ForceSensorStale, MechanicsContradicted, ServoFault
from gripper.force.ramp import ForceRamp

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)


def test_silent_servos_do_not_hold_up_the_report_of_another_fault(make_started) -> None:
    """A supply that fails takes pads and servos at once; the pads are named first."""
    cell = make_started(bus_loss_s=0.5)

    def fail() -> None:
        cell.sensor.dead = True
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    asked_s = cell.clock.monotonic()
    with pytest.raises(BusTimeout):
        cell.gripper.keep_grip()
    assert cell.clock.monotonic() - asked_s < 0.02


def test_a_tick_finds_a_tripped_watchdog_too(cell) -> None:
    cell.hold_part(RAMP)
    cell.clock.sleep(1.0)

    def tick_for_a_while() -> None:
        for _ in range(4):
            cell.gripper.tick()

    with pytest.raises(ServoFault, match="watchdog"):
        tick_for_a_while()
    cell.gripper.tick()
    assert cell.force_n > 3.0


@pytest.mark.parametrize("first", [True, False])
def test_a_stuck_finger_is_reported(started, monkeypatch, first) -> None:
    if not first:
        started.gripper.open(0.025)
    monkeypatch.setattr(type(started.mechanics), "step", lambda *_, **__: None)
    with pytest.raises(
        MechanicsContradicted if first else ServoFault,
        match="blocked on its way" if first else r"stuck.*gripper.linkage",
    ):
        started.gripper.open()

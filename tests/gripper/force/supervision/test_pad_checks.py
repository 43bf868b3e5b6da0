"""Loaded pads against the position of the fingers, and against each other."""

import pytest

from gripper.errors import ForceImbalance
from gripper.force.ramp import ForceRamp
from gripper.values.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


def test_a_finger_that_pushes_alone_freezes_both(cell, monkeypatch) -> None:
    cell.hold_part(RAMP)
    measure = cell.sensor.measure
    monkeypatch.setattr(
        cell.sensor, "measure", lambda now_s, force_n: measure(now_s, (force_n[0], 0.2))
    )
    begun_s = cell.clock.monotonic()
    with pytest.raises(ForceImbalance, match="both are frozen"):
        cell.gripper.hold(2.0)
    assert cell.clock.monotonic() - begun_s < 0.5
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    assert cell.force_n > 3.0

"""The loop: stalls, silence of pads and servos, and the bus that counts as lost."""

import itertools
from math import inf

import pytest

from gripper.errors import BusTimeout, BusUnreliable, ForceAboveCap, ForceSensorStale
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from simulator.servo.faults import Chatter

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)


@pytest.mark.parametrize("dies", [False, True])
def test_a_stall_of_the_loop_is_no_silence_of_the_pads(make_started, dies) -> None:
    cell = make_started(stall_max_s=0.2)
    newest = cell.sensor.latest_force

    def stall() -> None:
        old, end_s = newest(), cell.clock.monotonic() + (inf if dies else 0.1)
        # What receives stands still, too.
        cell.sensor.latest_force = lambda: old if cell.clock.monotonic() < end_s else newest()
        cell.clock.sleep(0.09)

    observe = cell.once(stall, at_n=5.0)
    if not dies:
        assert cell.gripper.grasp(RAMP, observe).result is GraspResult.FORCE_REACHED
        return
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, observe)
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.1 + 0.09 + 0.01


def test_no_sensor_no_approach(cell) -> None:
    cell.sensor.dead = True
    cell.gripper.start()
    before_m = cell.mechanics.aperture_m
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP)
    assert before_m - cell.mechanics.aperture_m < 0.003


def test_a_dead_bus_is_given_up_in_bounded_time_and_the_grip_stays(started) -> None:
    silence = started.once(lambda: started.device.faults.silent.update({1, 2}), at_n=5.0)
    with pytest.raises(BusTimeout, match=r"a part may still be gripped.*no answer"):
        started.gripper.grasp(RAMP, silence)
    assert 0.06 < started.clock.monotonic() - started.acted_s[0] < 0.1
    assert started.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    started.clock.sleep(2.0)
    assert started.force_n > 1.4
    transactions = started.bus.statistics.transactions
    started.gripper.keep_grip()
    assert started.bus.statistics.transactions == transactions
    with pytest.raises(BusTimeout):
        started.gripper.clear_fault()
    started.gripper.close()
    assert started.force_n > 1.4


def test_a_pause_before_three_lost_answers_is_no_lost_bus(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.tick()
    cell.clock.sleep(0.09)
    cell.device.faults.drop_next = 9
    for _ in range(6):
        cell.gripper.tick()
    assert cell.gripper.fault is None
    assert cell.gripper.statistics.missed_reads >= 3


@pytest.mark.parametrize(
    ("knob", "value", "error"), [("gain", 3.0, ForceAboveCap), ("dead", True, ForceSensorStale)]
)
def test_pads_are_watched_while_the_servos_are_not_understood(
    make_started, knob, value, error
) -> None:
    cell = make_started(bus_loss_s=2.0, force_max_n=9.0)

    def fail() -> None:
        cell.device.faults.chatter = Chatter(data=b"\xa5", every_s=0.0003)
        setattr(cell.sensor, knob, value)

    with pytest.raises(error):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.2
    assert cell.gripper.statistics.missed_reads > 5


def test_single_answers_that_are_lost_too_often_end_a_hold(cell) -> None:
    cell.hold_part(RAMP)
    periods = itertools.count()

    def lose(_cycle) -> None:
        if next(periods) % 5 == 0:
            cell.device.faults.drop_next = 3

    with pytest.raises(BusUnreliable, match="had no feedback of the servos"):
        cell.gripper.hold(3.0, lose)
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT

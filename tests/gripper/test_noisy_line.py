"""A servo line on which something else speaks, or too much is lost, while a part is held."""

import itertools

import pytest

from gripper.dynamixel.control_table import PRESENT_POSITION, RegisterBlock
from gripper.errors import (
    BusCorrupt,
    BusTimeout,
    BusUnreliable,
    ForceAboveCap,
    ForceSensorStale,
)
from gripper.force.ramp import ForceRamp
from gripper.state import Cycle, GraspResult, GripperPhase
from simulator.servo.faults import Chatter

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=2.0)
DENSE = Chatter(data=b"\xa5", every_s=0.0003)


def when_held(cell, act) -> object:
    """Return an observer that acts once, when the set-point is 5 N."""
    done: list[bool] = []

    def observe(cycle: Cycle) -> None:
        if cycle.setpoint_n >= 5.0 and not done:
            done.append(True)
            cell.began_s = cell.clock.monotonic()
            act()

    return observe


def looks_s(cell) -> list[float]:
    """Return the list that gets the times at which the force sensor is asked."""
    times: list[float] = []
    latest_force = cell.sensor.latest_force

    def asked():
        times.append(cell.clock.monotonic())
        return latest_force()

    cell.sensor.latest_force = asked
    return times


SENTENCE = b"$GPGGA,092751.000,5321.6802,N,00630.3371,W,1,8,1.03,61.7,M\r\n"
PATTERNS = {
    "dense": DENSE,
    "bursts": Chatter(data=bytes(range(0x80, 0xA8)), every_s=0.0006),
    "sentences": Chatter(data=SENTENCE, every_s=0.0004),
}
SLOW = {
    "a byte each ms": Chatter(data=b"\xa5", every_s=0.001),
    "40 bytes each 10 ms": Chatter(data=bytes(range(0x80, 0xA8)), every_s=0.01),
    "a sentence each 30 ms": Chatter(data=SENTENCE, every_s=0.03),
}


@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS)
def test_noise_ends_the_grasp_in_time_with_the_line_as_the_cause(make_cell, pattern) -> None:
    cell = make_cell(bus_loss_s=0.5, feedback_loss_max_share=0.5)
    cell.gripper.start()
    times = looks_s(cell)

    def begin() -> None:
        cell.device.faults.chatter = pattern

    with pytest.raises((BusCorrupt, BusUnreliable), match=r"heard were .* no packet"):
        cell.gripper.grasp(RAMP, when_held(cell, begin))
    assert cell.clock.monotonic() - cell.began_s < 1.3
    pauses_s = [b - a for a, b in itertools.pairwise(times)]
    assert max(pauses_s) < 0.02, "pads and CAN were not looked at meanwhile"
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT
    cell.clock.sleep(2.0)
    assert cell.force_n > 3.0


@pytest.mark.parametrize(
    ("knob", "value", "error"),
    [("gain", 3.0, ForceAboveCap), ("dead", True, ForceSensorStale)],
)
def test_pads_are_watched_while_the_servos_are_not_understood(
    make_cell, knob, value, error
) -> None:
    cell = make_cell(bus_loss_s=2.0, force_max_n=9.0)
    cell.gripper.start()

    def fail() -> None:
        cell.device.faults.chatter = DENSE
        setattr(cell.sensor, knob, value)

    with pytest.raises(error):
        cell.gripper.grasp(RAMP, when_held(cell, fail))
    assert cell.clock.monotonic() - cell.began_s < 0.2
    assert cell.gripper.statistics.missed_reads > 5


@pytest.mark.parametrize("lost_of_100", [3, 20])
def test_the_share_of_lost_feedback_is_limited(make_cell, lost_of_100) -> None:
    cell = make_cell()
    cell.gripper.start()
    asked = 0
    read = cell.gripper._servos.read

    def now_and_then():
        nonlocal asked
        asked += 1
        if asked % 100 in range(0, 5 * lost_of_100, 5):
            raise BusCorrupt("the answer was damaged")
        return read()

    cell.gripper._servos.read = now_and_then
    if lost_of_100 == 3:
        assert cell.gripper.grasp(RAMP).result is GraspResult.FORCE_REACHED
        return
    with pytest.raises(BusUnreliable, match=r"feedback_loss_max_share is 5%.*was damaged"):
        cell.gripper.grasp(RAMP)
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT


@pytest.mark.parametrize(("knob", "value"), [("lag", True), ("repeat_s", 0.0095)])
@pytest.mark.parametrize("bus_loss_s", [0.07, 0.5])
def test_answers_that_are_always_old_are_no_feedback(make_cell, knob, value, bus_loss_s) -> None:
    cell = make_cell(bus_loss_s=bus_loss_s)
    cell.gripper.start()
    seen: list[float] = []

    def begin() -> None:
        setattr(cell.device.faults, knob, value)
        seen.clear()

    observe = when_held(cell, begin)

    def watch(cycle: Cycle) -> None:
        observe(cycle)
        seen.append(cycle.t_s)

    with pytest.raises(BusCorrupt, match="old answer"):
        cell.gripper.grasp(RAMP, watch)
    assert cell.clock.monotonic() - cell.began_s < bus_loss_s + 0.04
    assert len(seen) <= 3
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT


@pytest.mark.parametrize("pattern", (PATTERNS | SLOW).values(), ids=PATTERNS | SLOW)
def test_each_transaction_ends_whatever_chatters(cell, pattern) -> None:
    cell.device.faults.silent.update({1, 2})
    with pytest.raises(BusTimeout):
        cell.bus.read(1, PRESENT_POSITION)
    cell.device.faults.chatter = pattern
    for _ in range(5):
        began_s = cell.clock.monotonic()
        with pytest.raises(BusCorrupt, match=r"the servo line did not fall quiet.* no packet"):
            cell.bus.read(1, PRESENT_POSITION)
        assert cell.clock.monotonic() - began_s < 0.6
    with cell.bus.in_loop():
        for _ in range(200):
            began_s = cell.clock.monotonic()
            with pytest.raises((BusCorrupt, BusTimeout)):
                cell.bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))
            assert cell.clock.monotonic() - began_s < 0.02
            cell.clock.sleep(0.005)
    cell.device.faults.silent.clear()
    cell.device.faults.chatter = None
    assert cell.bus.read(1, PRESENT_POSITION) > 0


@pytest.mark.parametrize("pattern", (PATTERNS | SLOW).values(), ids=PATTERNS | SLOW)
def test_a_start_on_a_line_of_another_device_names_what_was_heard(cell, pattern) -> None:
    cell.device.faults.silent.update({1, 2})
    cell.device.faults.chatter = pattern
    with pytest.raises(BusCorrupt, match=r"the servo line did not fall quiet.* no packet"):
        cell.gripper.start()
    assert cell.clock.monotonic() < 2.0

"""A servo line on which something else speaks, or too much is lost, while a part is held."""

import pytest

from gripper.dynamixel.control_table import PRESENT_POSITION, RegisterBlock
from gripper.errors import BusCorrupt, BusTimeout, ForceAboveCap, ForceSensorStale
from gripper.force.ramp import ForceRamp
from simulator.servo.faults import Chatter

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=2.0)
DENSE = Chatter(data=b"\xa5", every_s=0.0003)


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


@pytest.mark.parametrize(
    ("knob", "value", "error"), [("gain", 3.0, ForceAboveCap), ("dead", True, ForceSensorStale)]
)
def test_pads_are_watched_while_the_servos_are_not_understood(
    make_started, knob, value, error
) -> None:
    cell = make_started(bus_loss_s=2.0, force_max_n=9.0)

    def fail() -> None:
        cell.device.faults.chatter = DENSE
        setattr(cell.sensor, knob, value)

    with pytest.raises(error):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.2
    assert cell.gripper.statistics.missed_reads > 5


@pytest.mark.slow
@pytest.mark.parametrize("pattern", (PATTERNS | SLOW).values(), ids=PATTERNS | SLOW)
def test_each_transaction_ends_whatever_chatters(cell, pattern) -> None:
    cell.device.faults.silent.update({1, 2})
    with pytest.raises(BusTimeout):
        cell.bus.read(1, PRESENT_POSITION)
    cell.device.faults.chatter = pattern
    for _ in range(5):
        began_s = cell.clock.monotonic()
        with pytest.raises(BusCorrupt, match=r"the servo line did not become quiet.* no packet"):
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
    with pytest.raises(BusCorrupt, match=r"the servo line did not become quiet.* no packet"):
        cell.gripper.start()
    assert cell.clock.monotonic() < 2.0

"""The stream in memory: it waits on the injected clock and fails when the cable is out."""

from collections.abc import Callable

import pytest

from simulator.errors import PortUnplugged
from simulator.servo.bus import MemoryServoStream
from simulator.servo.protocol2 import Instruction, encode_instruction

PING = encode_instruction(1, Instruction.PING)


@pytest.fixture
def bench(servo_bench: Callable):
    return servo_bench()


def test_read_returns_what_is_there_and_keeps_the_rest(bench):
    bench.stream.write(PING)
    assert len(bench.stream.read(4, 1.0)) == 4
    before_s = bench.clock.monotonic()
    assert len(bench.stream.read(100, 1.0)) == 10
    assert bench.clock.monotonic() == before_s


def test_a_time_out_takes_exactly_its_time(bench):
    before_s = bench.clock.monotonic()
    assert bench.stream.read(10, 0.034) == b""
    assert bench.clock.monotonic() - before_s == pytest.approx(0.034, abs=1e-6)
    assert bench.stream.read(10, 0.0) == b""


def test_drop_input_drops_what_has_arrived_only(bench):
    bench.stream.write(PING)
    bench.clock.sleep(0.001)
    bench.stream.write(encode_instruction(2, Instruction.PING))
    bench.stream.drop_input()
    assert bench.stream.read(64, 0.01)[4] == 2


def test_unplugged_and_plugged_in_again(bench):
    bench.device.faults.unplugged = True
    for use in (
        lambda: bench.stream.write(PING),
        lambda: bench.stream.read(1, 0.1),
        bench.stream.drop_input,
    ):
        with pytest.raises(PortUnplugged, match="cable"):
            use()
    bench.device.receive(PING, bench.clock.monotonic())
    assert bench.device.transmit(bench.clock.monotonic() + 1.0) == b""
    bench.device.faults.unplugged = False
    with pytest.raises(PortUnplugged, match="open the port again"):
        bench.stream.write(PING)
    bench.stream = MemoryServoStream(bench.device, bench.clock)
    assert len(bench.exchange(PING)) == 14


def test_unplugging_ends_a_read_that_waits(bench):
    def unplug(now_s: float) -> None:
        bench.device.faults.unplugged = now_s > 0.005

    bench.clock.on_advance.append(unplug)
    bench.device.faults.delay.next_packets = 1
    bench.stream.write(PING)
    with pytest.raises(PortUnplugged):
        bench.stream.read(10, 0.1)
    assert bench.clock.monotonic() < 0.05

import itertools
import math
import random
import struct

import can
import pytest

from simulator.can.faults import CanLinkFaults
from simulator.can.link import CanLink
from simulator.can.memory_bus import InMemoryCanBus
from simulator.can.wire import Burst, CanWire, mean_bits
from simulator.clock import VirtualClock
from simulator.errors import SimulatorStateError
from tests.simulator.can.conftest import Echo

TPDO_ID = 0x185


def message(can_id: int, *data: int) -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data)


def echo_bus(faults: CanLinkFaults | None = None) -> tuple[Echo, InMemoryCanBus, VirtualClock]:
    echo, clock = Echo(), VirtualClock(start_s=10.0)
    return echo, InMemoryCanBus(echo, clock, faults=faults), clock


def drain(bus: InMemoryCanBus) -> list[can.Message]:
    found = []
    while (one := bus.recv(0.01)) is not None:
        found.append(one)
    return found


def exact_bits(can_id: int, data: bytes) -> int:
    """Return the bits of an 11-bit data frame with stuff bits and interframe space."""
    fields = ((0, 1), (can_id, 11), (len(data), 7), (int.from_bytes(data, "big"), 8 * len(data)))
    bits = "".join(f"{value:0{size}b}" for value, size in fields if size)
    crc = 0
    for bit in bits:
        crc = (crc << 1 & 0x7FFF) ^ (0x4599 if int(bit) ^ (crc >> 14) else 0)
    stuffed, run, last = 0, 0, ""
    for bit in f"{bits}{crc:015b}":
        run, last = run + 1 if bit == last else 1, bit
        if run == 5:
            stuffed, run, last = stuffed + 1, 1, "10"[int(bit)]
    return len(bits) + 15 + stuffed + 13


@pytest.mark.parametrize(
    ("low", "high", "mean"), [(0, 255, 113.8), (0, 0, 122.9), (255, 255, 122.9), (1, 20, 116.4)]
)
def test_the_estimate_is_the_mean_of_the_exact_count(low: int, high: int, mean: float) -> None:
    rng = random.Random(7)
    frames = [
        bytes((rng.randrange(256), *(rng.randint(low, high) for _ in range(7))))
        for _ in range(2000)
    ]
    exact = sum(exact_bits(TPDO_ID, data) for data in frames) / len(frames)
    estimate = sum(map(mean_bits, frames)) / len(frames)
    assert exact == pytest.approx(mean, rel=0.02)
    assert estimate == pytest.approx(exact, rel=0.03)


def waiting(ready_s: float, can_id: int, *data: bytes, extended: bool = False) -> Burst:
    return Burst(ready_s, can_id, data, extended, None)


def test_messages_wait_for_each_other_on_the_wire() -> None:
    wire = CanWire(500_000)
    data = bytes(range(1, 9))
    length_s = mean_bits(data) / 500e3
    wire.put(waiting(1.0, TPDO_ID, data, data))
    wire.put(waiting(2.0, TPDO_ID << 18, data, extended=True))
    assert wire.end_s(1.0, TPDO_ID) == pytest.approx(1.0 + 2 * length_s)
    assert wire.end_s(1.0, TPDO_ID - 1) == 1.0
    ends_s = [end_s for burst_ends_s, *_ in wire.take(3.0) for end_s in burst_ends_s]
    assert ends_s == pytest.approx([1.0 + length_s, 1.0 + 2 * length_s, 2.0 + length_s + 4e-5])
    assert wire.n_waiting == 0
    assert math.isinf(wire.next_end_s())


def test_the_lowest_identifier_goes_first_but_never_interrupts_one_on_the_wire() -> None:
    wire = CanWire(1_000_000)
    data = bytes(range(1, 9))
    wire.put(waiting(1.0, 0x385, data, data, data))
    wire.put(waiting(1.0001, 0x285, data))  # while the first of the burst is on the wire
    wire.put(waiting(1.0001, 0x285, data, extended=True))  # base identifier 0: before the burst
    order = [(burst.can_id, burst.extended) for ends_s, burst, _ in wire.take(2.0) for _ in ends_s]
    assert order == [
        (0x385, False), (0x285, True), (0x285, False), (0x385, False), (0x385, False)
    ]  # fmt: skip


def test_waiting_moves_the_clock_to_the_time_out_and_no_further() -> None:
    echo, bus, clock = echo_bus()
    assert bus.recv(0.25) is None
    assert clock.monotonic() == 10.25
    assert bus.recv(-1.0) is None
    assert clock.monotonic() == 10.25
    echo.due_s = 10.5
    heartbeat = bus.recv(5.0)
    assert heartbeat.timestamp == clock.monotonic() == pytest.approx(10.5, abs=1e-4)
    with pytest.raises(SimulatorStateError, match="without a time-out"):
        bus.recv()


def test_all_that_has_arrived_is_taken_at_once_as_one_by_one() -> None:
    echo, bus, clock = echo_bus()
    data = bytes(range(1, 9))
    step_s = mean_bits(data) * 1e-6
    echo.send(10.0, 0x185, [data] * 5)
    clock.sleep(2.5 * step_s)
    assert [one.timestamp for one in bus.recv_all(9)] == pytest.approx(
        [10 + step_s, 10 + 2 * step_s]
    )
    assert bus.recv_all(9) == []
    clock.sleep(1.0)
    assert len(bus.recv_all(2)) == 2
    assert len(bus.recv_all(2)) == 1
    bus.set_filters([{"can_id": 0x700, "can_mask": 0x780}])
    echo.send(12.0, 0x185, [data])
    echo.send(12.0, 0x705, [b"\x05"])
    clock.sleep(2.0)
    assert [one.arbitration_id for one in bus.recv_all(9)] == [0x705]
    echo.send(clock.monotonic(), 0x185, [data])
    assert drain(bus) == []
    bus.set_filters(None)
    bus.faults.delay_s = 1.0
    echo.send(clock.monotonic(), 0x185, [data, data])
    clock.sleep(0.5)
    assert bus.recv_all(9) == []
    bus.faults.unplugged = True
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.recv_all(9)


@pytest.mark.parametrize("kind", ["is_remote_frame", "is_error_frame", "is_fd"])
def test_only_classic_data_frames_are_carried(kind: str) -> None:
    _, bus, _ = echo_bus()
    with pytest.raises(can.CanOperationError, match="classic"):
        bus.send(can.Message(arbitration_id=1, is_extended_id=False, **{kind: True}))


def run_with(faults: CanLinkFaults, n: int = 400) -> list[can.Message]:
    echo, bus, _ = echo_bus(faults)
    echo.send(10.0, 0x185, [struct.pack("<Q", i) for i in range(n)])
    return drain(bus)


def numbers(messages: list[can.Message]) -> list[int]:
    return [int.from_bytes(m.data, "little") for m in messages]


def test_messages_can_be_lost_by_chance_or_by_number() -> None:
    assert len(run_with(CanLinkFaults(drop_rate=0.1))) == pytest.approx(360, abs=25)
    faults = CanLinkFaults(drop_next=3)
    assert numbers(run_with(faults, 10)) == list(range(3, 10))
    assert faults.drop_next == 0


def test_messages_can_come_twice_or_after_their_successor() -> None:
    twice = numbers(run_with(CanLinkFaults(duplicate_rate=0.1)))
    assert len(twice) == pytest.approx(440, abs=25)
    assert sorted(set(twice)) == list(range(400))
    swapped = numbers(run_with(CanLinkFaults(swap_rate=0.1)))
    assert sorted(swapped) == list(range(400))
    moved = sum(a > b for a, b in itertools.pairwise(swapped))
    assert 15 < moved < 70


def test_messages_can_come_late_with_one_bit_turned_or_cut_off() -> None:
    late, usual = run_with(CanLinkFaults(delay_s=0.004), 3), run_with(CanLinkFaults(), 3)
    for a, b in zip(late, usual, strict=True):
        assert a.timestamp - b.timestamp == pytest.approx(0.004)
    turned = numbers(run_with(CanLinkFaults(corrupt_rate=1.0)))
    assert [(a ^ b).bit_count() for a, b in enumerate(turned)] == [1] * 400
    short = run_with(CanLinkFaults(truncate_rate=1.0), 50)
    assert len(short) == 50
    assert all(m.dlc == 8 and len(m.data) < 8 for m in short)


def test_a_flood_comes_at_its_rate_until_it_is_switched_off() -> None:
    faults = CanLinkFaults()
    _, bus, clock = echo_bus(faults)
    faults.flood_hz = 1000.0
    clock.sleep(0.1)
    faults.flood_hz = 0.0
    flood = drain(bus)
    assert len(flood) == pytest.approx(100, abs=2)
    assert {m.arbitration_id for m in flood} == {0x6FF}
    clock.sleep(0.1)
    assert bus.recv(0) is None


def test_the_controller_reports_its_state_once() -> None:
    faults = CanLinkFaults(error_passive=True)
    _, bus, _ = echo_bus(faults)
    [passive] = drain(bus)
    assert passive.is_error_frame
    assert (passive.arbitration_id, passive.data[1]) == (0x04, 0x30)
    faults.error_passive = False
    [active] = drain(bus)
    assert (active.arbitration_id, active.data[1]) == (0x04, 0x40)
    faults.bus_off = True
    [off] = drain(bus)
    assert (off.is_error_frame, off.arbitration_id) == (True, 0x40)


def test_bus_off_lets_nothing_pass() -> None:
    faults = CanLinkFaults(bus_off=True)
    echo, bus, _ = echo_bus(faults)
    drain(bus)
    echo.send(10.0, 0x705, [b"\x05"])
    assert drain(bus) == []
    with pytest.raises(can.CanOperationError, match="bus-off"):
        bus.send(message(1))
    assert echo.heard == []


def test_an_adapter_that_is_gone_fails() -> None:
    faults = CanLinkFaults(unplugged=True)
    echo, bus, clock = echo_bus(faults)
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.recv(0)
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.send(message(1))
    faults.unplugged = False
    with pytest.raises(can.CanOperationError, match="open it again"):
        bus.recv(0)
    with InMemoryCanBus(echo, clock, faults=faults) as opened:
        assert opened.recv(0) is None


def test_everything_on_the_wire_is_captured() -> None:
    echo, bus, clock = echo_bus(CanLinkFaults(drop_rate=0.5))
    heard: list[tuple[float, int, bytes]] = []
    bus.capture.append(lambda *one: heard.append(one))
    bus.send(message(0x80))
    echo.send(clock.monotonic(), TPDO_ID, [b"\1"] * 59)
    echo.send(clock.monotonic(), 0x585, [b"\2"])
    bus.send(message(0x605))
    drain(bus)
    assert [can_id for _, can_id, _ in heard] == [0x80, 0x605] + [TPDO_ID] * 59 + [0x585]
    times = [t_s for t_s, _, _ in heard]
    assert times == sorted(times)


def test_an_adapter_that_nobody_reads_loses_messages_and_counts_them() -> None:
    echo = Echo()
    link = CanLink(echo, bitrate=1_000_000)
    for _ in range(11):
        echo.send(0.0, 0x185, [bytes(8)] * 10_000)
    assert link.lost == 0
    echo.send(0.0, 0x185, [bytes(8)] * 7)
    assert link.lost == 7
    link.clear()
    assert link.next_event_s() == math.inf

"""The simulated wire, its faults, and its two ends: a bus in memory and a serial adapter."""

import itertools
import math
import random
import struct

import can
import pytest
from hypothesis import given, settings, strategies as st

from simulator.can.faults import CanLinkFaults
from simulator.can.link import CanLink, CanWire, InMemoryCanBus, mean_bits
from simulator.can.node import SendBurst
from simulator.can.slcan import SlcanAdapter
from simulator.clock import VirtualClock
from simulator.errors import SimulatorStateError

TPDO_ID = 0x185


class Echo:
    """Keeps what it hears, and sends what the test gives to `send`."""

    send: SendBurst

    def __init__(self) -> None:
        self.heard: list[tuple[float, int, bytes]] = []
        self.due_s = math.inf
        """When it sends a heartbeat by itself."""

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        self.heard.append((now_s, can_id, data))

    def advance(self, now_s: float) -> None:
        if now_s >= self.due_s:
            due_s, self.due_s = self.due_s, math.inf
            self.send(due_s, 0x705, [b"\x05"])

    def next_event_s(self) -> float:
        return self.due_s


def echo_bus(faults: CanLinkFaults | None = None) -> tuple[Echo, InMemoryCanBus, VirtualClock]:
    echo, clock = Echo(), VirtualClock(start_s=10.0)
    return echo, InMemoryCanBus(CanLink(echo, faults=faults), clock), clock


def drain(bus: InMemoryCanBus) -> list[can.Message]:
    received = []
    while (one := bus.recv(0.01)) is not None:
        received.append(one)
    return received


@pytest.mark.parametrize(
    ("low", "high", "mean"), [(0, 255, 113.8), (0, 0, 122.9), (255, 255, 122.9), (1, 20, 116.4)]
)
def test_the_estimate_is_the_mean_of_the_exact_count(low: int, high: int, mean: float) -> None:
    """The exact count is that of CAN 2.0: fields, CRC, stuff bits and interframe space."""
    rng = random.Random(7)
    frames = [
        bytes((rng.randrange(256), *(rng.randint(low, high) for _ in range(7))))
        for _ in range(2000)
    ]
    assert sum(map(mean_bits, frames)) / len(frames) == pytest.approx(mean, rel=0.03)


def test_messages_wait_for_each_other_on_the_wire() -> None:
    wire, data = CanWire(500_000), bytes(range(1, 9))
    length_s = mean_bits(data) / 500e3
    for ready_s, can_id in ((1.0, TPDO_ID), (1.0, TPDO_ID), (2.0, TPDO_ID + 1)):
        wire.put(ready_s, can_id, [data])
    assert wire.end_s(1.0, TPDO_ID) == pytest.approx(1.0 + 2 * length_s)
    assert wire.end_s(1.0, TPDO_ID - 1) == 1.0
    ends_s = [end_s for end_s, *_ in wire.take(3.0)]
    assert ends_s == pytest.approx([1.0 + length_s, 1.0 + 2 * length_s, 2.0 + length_s])
    assert wire.n_waiting == 0
    assert math.isinf(wire.next_end_s())


def test_the_lowest_identifier_goes_first_but_never_interrupts_one_on_the_wire() -> None:
    wire, data = CanWire(1_000_000), bytes(range(1, 9))
    wire.put(1.0, 0x385, 3 * [data])
    wire.put(1.0001, 0x285, [data])  # while the first of the burst is on the wire
    assert [can_id for _, can_id, *_ in wire.take(2.0)] == [0x385, 0x285, 0x385, 0x385]


def test_no_device_takes_an_identifier_of_29_bits_a_remote_frame_or_can_fd() -> None:
    echo, bus, _ = echo_bus()
    for other in ({"is_extended_id": True}, {"is_remote_frame": True}, {"is_fd": True}, {}):
        bus.send(can.Message(**{"arbitration_id": 0x605, "is_extended_id": False} | other))
    assert [can_id for _, can_id, _ in echo.heard] == [0x605]


def test_waiting_moves_the_clock_to_the_time_out_and_no_further() -> None:
    echo, bus, clock = echo_bus()
    assert bus.recv(0.25) is None
    assert clock.monotonic() == 10.25
    assert bus.recv(-1.0) is None
    assert clock.monotonic() == 10.25
    echo.due_s = 10.5
    assert bus.recv(5.0).timestamp == clock.monotonic() == pytest.approx(10.5, abs=1e-4)
    with pytest.raises(SimulatorStateError, match="without a time-out"):
        bus.recv()


def test_all_that_has_arrived_is_taken_at_once_as_one_by_one() -> None:
    echo, bus, clock = echo_bus()
    data = bytes(range(1, 9))
    step_s = mean_bits(data) * 1e-6
    echo.send(10.0, 0x185, [data] * 5)
    clock.sleep(2.5 * step_s)
    arrived_s = [message.timestamp for message in bus.recv_all(9)]
    assert arrived_s == pytest.approx([10 + step_s, 10 + 2 * step_s])
    assert bus.recv_all(9) == []
    clock.sleep(1.0)
    assert len(bus.recv_all(2)) == 2
    assert len(bus.recv_all(2)) == 1
    bus.faults.delay_s = 1.0
    echo.send(clock.monotonic(), 0x185, [data, data])
    clock.sleep(0.5)
    assert bus.recv_all(9) == []
    bus.faults.unplugged = True
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.recv_all(9)


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
    assert 15 < sum(a > b for a, b in itertools.pairwise(swapped)) < 70


def test_messages_can_come_late_with_one_bit_turned_or_cut_off() -> None:
    late, usual = run_with(CanLinkFaults(delay_s=0.004), 3), run_with(CanLinkFaults(), 3)
    for a, b in zip(late, usual, strict=True):
        assert a.timestamp - b.timestamp == pytest.approx(0.004)
    turned = numbers(run_with(CanLinkFaults(corrupt_rate=1.0)))
    assert [(a ^ b).bit_count() for a, b in enumerate(turned)] == [1] * 400
    short = run_with(CanLinkFaults(truncate_rate=1.0), 50)
    assert len(short) == 50
    assert all(m.dlc == 8 and len(m.data) < 8 for m in short)


def test_a_flood_fills_the_bus_and_ends_with_its_fault() -> None:
    link = CanLink(Echo(), faults=(faults := CanLinkFaults(flood_hz=20_000.0)))
    for now_ms in range(500):
        link.advance(1e-3 * now_ms)
    faults.flood_hz = 0.0
    arrived_s = [message.timestamp for message in link.take(9.0)]
    assert len(arrived_s) > 3500
    assert arrived_s[-1] < 0.53


def test_an_adapter_that_nobody_reads_loses_messages(monkeypatch) -> None:
    monkeypatch.setattr("simulator.can.link._INBOX_LIMIT", 100)
    echo = Echo()
    link = CanLink(echo)
    assert echo.send(0.0, 0x185, [bytes(8)] * 101) > 0.0
    assert echo.send(0.0, 0x185, [bytes(8)] * 7) == 0.0
    link.clear()
    assert link.next_event_s() == math.inf


class Line:
    def __init__(self, *setup: bytes) -> None:
        self.device = Echo()
        self.faults = CanLinkFaults()
        self.adapter = SlcanAdapter(CanLink(self.device, faults=self.faults))
        for command in setup:
            assert self.say(command + b"\r") == b"\r"

    @property
    def heard(self) -> list[tuple[int, bytes]]:
        """Identifier and data of what the device heard."""
        return [(can_id, data) for _, can_id, data in self.device.heard]

    def say(self, data: bytes, now_s: float = 1.0) -> bytes:
        self.adapter.receive(data, now_s)
        return self.adapter.transmit(now_s)


def test_a_client_opens_with_the_commands_of_python_can() -> None:
    line = Line()
    # Close, bit rate, no data rate, open, open again: what it sends; what is refused does no harm.
    assert line.say(b"C\rS8\r\rO\rO\r") == b"\a\r\r\a"
    assert line.say(b"t1232AABB\r") == b"z\r"
    assert line.heard == [(0x123, b"\xaa\xbb")]


def test_more_messages_than_the_adapter_holds_are_refused() -> None:
    assert Line(b"O").say(b"t0800\r" * 101) == b"z\r" * 100 + b"\a"


def test_messages_come_as_lines_when_they_are_through() -> None:
    line = Line(b"O")
    line.device.send(1.0, 0x185, [bytes(range(8))])
    line.device.send(1.0, 0x185, [b""])
    assert line.say(b"", 1.0) == b""
    assert line.adapter.next_event_s() == pytest.approx(1.000115, abs=1e-5)
    assert line.say(b"", 1.00014) == b"t18580001020304050607\r"
    assert line.say(b"", 1.001) == b"t1850\r"


def test_another_bit_rate_reaches_nobody() -> None:
    line = Line(b"S6", b"O")
    assert line.say(b"t1230\r") == b"z\r"
    assert line.heard == []
    line.device.send(1.0, 0x185, [bytes(8)])
    assert line.say(b"", 2.0) == b""


ANSWERS = ({b"V": b"V1013\r"}, {b"V": b"V1013\r", b"F": b"F00\r"})
"""Commands to a closed and to an open adapter, and their answers."""
REFUSED = (
    b"S9|S|S88|F|C|s0014",
    b"S8|x|V1|t12|t8000|t1239001122334455667788|t1232AA|t1231A|t1231AABB|t123x|t1_31AA|t 231AA"
    b"|T000001230|r1230|\xff\xfe",
)
"""Commands that they refuse."""


@pytest.mark.parametrize("is_open", [False, True])
def test_answers_of_a_closed_and_an_open_adapter(is_open: bool) -> None:
    refused = dict.fromkeys(REFUSED[is_open].split(b"|"), b"\a")
    for command, answer in (ANSWERS[is_open] | refused).items():
        line = Line(*[b"O"] * is_open)
        assert line.say(command + b"\r") == answer, command
        assert line.heard == [], command


def test_the_flags_tell_the_state_of_the_controller() -> None:
    line = Line(b"O")
    line.faults.error_passive = True
    assert line.say(b"F\r") == b"F20\r"


def test_losing_power_closes_the_channel() -> None:
    line = Line(b"S6", b"O")
    line.say(b"t12")
    line.adapter.drop_pending()
    assert line.say(b"V\r") == b"V1013\r"
    assert line.say(b"O\rt1230\r") == b"\rz\r"
    assert line.heard == [(0x123, b"")]


@given(can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8), lower=st.booleans())
@settings(max_examples=100)
def test_what_is_sent_in_text_arrives(can_id: int, data: bytes, lower: bool) -> None:
    line = Line(b"O")
    text = f"{can_id:03X}{len(data)}{data.hex().upper()}"
    assert line.say(b"t" + (text.lower() if lower else text).encode() + b"\r") == b"z\r"
    assert line.heard == [(can_id, data)]
    line.device.send(1.0, can_id, [data])
    assert line.say(b"", 2.0) == f"t{text}\r".encode()


def test_syncs_that_waited_do_not_come_into_the_burst_of_the_one_before():
    line, burst_s = Line(b"O"), []

    def answer(_can_id: int, _data: bytes, now_s: float) -> None:
        burst_s.append((now_s, line.device.send(now_s, 0x185, [bytes(8)] * 59)))

    line.device.receive = answer
    line.adapter.receive(b"t0800\r" * 4, 1.04, sent_after_s=1.0)
    assert all(end_s <= next_s for (_, end_s), (next_s, _) in itertools.pairwise(burst_s))
    assert (burst_s[0][0], burst_s[-1][0]) == (1.0, pytest.approx(1.023, abs=0.002))

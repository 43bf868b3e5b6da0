from random import Random

import pytest
from hypothesis import given, settings, strategies as st

from simulator.can.faults import CanLinkFaults
from simulator.can.link import CanLink
from simulator.can.slcan import OUTPUT_LIMIT, SlcanAdapter
from simulator.devices import CellDevices
from simulator.settings import SimulatorSettings
from tests.simulator.can.conftest import Echo


class Line:
    def __init__(self, *setup: bytes) -> None:
        self.device = Echo()
        self.faults = CanLinkFaults()
        self.adapter = SlcanAdapter(
            CanLink(self.device, bitrate=1_000_000, faults=self.faults), bitrate=1_000_000
        )
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


def test_messages_come_as_lines_when_they_are_through() -> None:
    line = Line(b"O")
    line.device.send(1.0, 0x185, [bytes(range(8)), b""])
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


def test_time_stamps_are_milliseconds_of_a_minute() -> None:
    line = Line(b"Z1", b"O")
    line.device.send(61.2345, 0x705, [b"\x05"])
    assert line.say(b"", 70.0) == b"t70510504D2\r"


ANSWERS = (
    {b"s0014": b"\r", b"M00000000": b"\r"},
    {b"V": b"V1013\r", b"v": b"V1013\r", b"N": b"NSIM1\r", b"F": b"F00\r"}
    | {b"T000001231FF": b"Z\r", b"r1230": b"z\r", b"R000001238": b"Z\r"},
)
"""Commands to a closed and to an open adapter, and their answers."""
REFUSED = (
    b"S9|S|S88|Z2|F|C",
    b"S8|x|V1|t12|t8000|t1239001122334455667788|t1232AA|t1231A|t1231AABB|t123x|t1_31AA|t 231AA"
    b"|T200000000|r1231FF|\xff\xfe",
)
"""Commands that they refuse."""


@pytest.mark.parametrize("is_open", [False, True])
def test_answers_of_a_closed_and_an_open_adapter(is_open: bool) -> None:
    refused = dict.fromkeys(REFUSED[is_open].split(b"|"), b"\a")
    for command, answer in (ANSWERS[is_open] | refused).items():
        assert Line(*[b"O"] * is_open).say(command + b"\r") == answer, command


def test_a_client_that_does_not_read_loses_messages_and_is_told() -> None:
    line = Line(b"O")
    text = b"t1858" + b"00" * 8 + b"\r"
    line.adapter.put_back(b"x" * (OUTPUT_LIMIT - len(text)))
    line.device.send(1.0, 0x185, [bytes(8), bytes(8)])
    output = line.say(b"", 2.0)
    assert output.endswith(b"x" + text)
    assert len(output) == OUTPUT_LIMIT
    assert line.say(b"F\r") == b"F01\r"
    assert line.say(b"F\r") == b"F00\r"


def test_the_flags_tell_the_state_of_the_controller() -> None:
    line = Line(b"O")
    line.faults.error_passive = True
    assert line.say(b"F\r") == b"F20\r"
    line.faults.bus_off = True
    assert line.say(b"F\r") == b"FA0\r"


def test_losing_power_closes_the_channel() -> None:
    line = Line(b"S6", b"O")
    line.say(b"t12")
    line.adapter.reset()
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


def test_syncs_that_waited_are_spread_over_the_time_in_which_they_were_sent():
    line = Line(b"O")
    line.adapter.receive(b"t0800\rt0800\r", 1.06, sent_after_s=1.02)
    assert [heard_s for heard_s, *_ in line.device.heard] == pytest.approx([1.03, 1.05])


def test_a_simulator_that_stalls_takes_no_sync_for_one_within_a_burst() -> None:
    devices = CellDevices(SimulatorSettings())
    link = CanLink(devices.can_devices, bitrate=1_000_000)
    adapter = SlcanAdapter(link, bitrate=1_000_000)
    random, emergency = Random(7), f"t{0x80 + devices.settings.node_id:03X}".encode()
    adapter.receive(b"O\r", 0.0)
    polled_s = 1.0
    adapter.transmit(polled_s)
    waiting = [(polled_s + 0.001, b"t0002%02X%02X\r" % (1, devices.settings.node_id))]
    sync_s, told = polled_s + 0.02, b""
    for _ in range(3000):
        # Mostly it comes in time, sometimes it stalls for up to 30 ms.
        now_s = polled_s + random.choice((0.001, 0.001, 0.001, random.uniform(0.001, 0.03)))
        while sync_s <= now_s:
            waiting.append((sync_s, b"t0800\r"))
            sync_s += random.choice((0.018, 0.02, 0.022))
        lines = b"".join(line for sent_s, line in waiting if sent_s <= now_s)
        waiting = [(sent_s, line) for sent_s, line in waiting if sent_s > now_s]
        if lines:
            adapter.receive(lines, now_s, sent_after_s=polled_s)
        told += adapter.transmit(now_s)
        polled_s = now_s
    assert told.count(b"t%03X" % (0x180 + devices.settings.node_id)) > 10_000
    assert emergency not in told

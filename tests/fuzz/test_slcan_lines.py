"""Bad lines between a serial CAN adapter and its client, at both ends."""

import contextlib
import os
import re
from collections.abc import Iterator

import pytest
from hypothesis import strategies as st

from simulator.can.faults import CanLinkFaults
from simulator.can.slcan import OUTPUT_LIMIT, SlcanAdapter
from tactile.can.bus import BulkSlcanBus
from tests.fuzz.harness import bad_input, damages, pieces, spoilt

_DATA = re.compile(
    rb"(?:t(?P<id>[0-7][0-9A-Fa-f]{2})|T(?P<xid>[01][0-9A-Fa-f]{7}))"
    rb"(?P<n>[0-8])(?P<data>(?:[0-9A-Fa-f]{2})*)(?P<stamp>[0-9A-Fa-f]{4})?"
)
"""What a line of data is, by the manual of the LAWICEL CANUSB; written apart from the parsers."""

Message = tuple[int, bool, bytes]
"""Identifier, whether it is an extended one, data."""


def expected(line: bytes, *, stamps: bool) -> Message | None:
    """Return the message that a line is, if it is one; a time stamp may follow the data."""
    match = _DATA.fullmatch(line)
    if match is None:
        return None
    extended = match["xid"] is not None
    digits = line[10:] if extended else line[5:]
    size = 2 * int(match["n"])
    if len(digits) != size and not (stamps and len(digits) == size + 4):
        return None
    return int(match["xid"] or match["id"], 16), extended, bytes.fromhex(digits[:size].decode())


def line_of(can_id: int, extended: bool, data: bytes) -> bytes:
    head = b"T%08X" % can_id if extended else b"t%03X" % (can_id & 0x7FF)
    return head + b"%d" % len(data) + data.hex().upper().encode()


REPLIES = (b"", b"z", b"F00", b"F20", b"V1013", b"r1238", b"d1231FF")
COMMANDS = (b"O", b"C", b"S8", b"L", b"Z1", b"F", b"V", b"N", b"s031C", b"M00000000", b"X1")
ALPHABET = b"tTrRdDbB0123456789ABCDEF+-_ .\r\a"


def streams(others: tuple[bytes, ...]) -> st.SearchStrategy[bytes]:
    """Return the strategy of lines of data and others, and of bytes that only look like some."""
    data = st.builds(line_of, st.integers(0, (1 << 29) - 1), st.booleans(), st.binary(max_size=8))
    lines = st.lists(data | st.sampled_from(others), min_size=1, max_size=5).map(b"\r".join)
    return lines | st.lists(st.sampled_from(ALPHABET), max_size=40).map(bytes)


piece = st.integers(1, 60)


@pytest.fixture
def terminal() -> Iterator[tuple[int, BulkSlcanBus]]:
    """The adapter's end of a pseudo-terminal, and the driver behind the other."""
    master, slave = os.openpty()
    bus = BulkSlcanBus(os.ttyname(slave), bitrate=1_000_000, tty_baudrate=1_000_000)
    os.set_blocking(master, False)
    try:
        yield master, bus
    finally:
        bus.shutdown()
        os.close(slave)
        os.close(master)


def received(master: int, bus: BulkSlcanBus, parts: list[bytes]) -> list[Message]:
    """Return the messages that the driver takes out of bytes that come in these parts."""
    found = []
    for part in parts:
        os.write(master, part)
        while (message := bus.recv(0)) is not None:
            assert len(found) < 1000
            if not (message.is_remote_frame or message.is_fd or message.is_error_frame):
                assert len(message.data) == message.dlc
                found.append((message.arbitration_id, message.is_extended_id, bytes(message.data)))
    with contextlib.suppress(BlockingIOError):
        os.read(master, 4096)  # questions for the adapter's flags
    return found


@bad_input(stream=streams(REPLIES), harm=damages(), piece=piece, examples=120)
def test_the_driver_takes_whole_lines_only(terminal, stream, harm, piece):
    # The end of a line, so that nothing of this input belongs to the next one.
    wire = spoilt(stream, harm) + b"\r"
    lines = wire.replace(b"\a", b"\r").split(b"\r")
    messages = [message for line in lines if (message := expected(line, stamps=True))]
    assert received(*terminal, pieces(wire, piece)) == messages
    return "whole lines" if messages else "dropped"


class Wire:
    """Takes what the adapter puts on the bus."""

    def __init__(self) -> None:
        self.sent: list[Message] = []
        self.faults = CanLinkFaults()

    def send(self, can_id: int, data: bytes, now_s: float, *, extended: bool = False) -> None:
        self.sent.append((can_id, extended, data))

    def deaf(self, bitrate: int) -> bool:
        return False

    def take(self, now_s: float) -> None:
        return None

    def advance(self, now_s: float) -> None: ...

    def clear(self, now_s: float) -> None: ...


def sent_by_adapter(parts: list[bytes]) -> list[Message]:
    """Return what an open adapter sends for bytes that come in these parts."""
    wire = Wire()
    adapter = SlcanAdapter(wire, bitrate=1_000_000)  # type: ignore[arg-type]
    adapter.receive(b"O\r", 0.0)
    for part in parts:
        adapter.receive(part, 0.0)
    assert len(adapter.transmit(0.0)) <= OUTPUT_LIMIT
    return wire.sent


@bad_input(stream=streams(COMMANDS), harm=damages(), piece=piece, examples=120)
def test_the_simulated_adapter_sends_whole_lines_only(stream, harm, piece):
    wire = spoilt(stream, harm) + b"\r"
    sent = sent_by_adapter(pieces(wire, piece))
    allowed = [message for line in wire.split(b"\r") if (message := expected(line, stamps=False))]
    rest = iter(allowed)
    assert all(message in rest for message in sent)
    return "whole lines" if sent else "dropped"


@pytest.mark.parametrize(
    "line",
    [b"t1818112233", b"t1_0211AA", b"t+181 0", b"tFFF0", b"TFFFFFFFF0", b"t1811AABB", b"d1810"],
)
def test_a_line_that_is_not_whole_is_no_message(terminal, line) -> None:
    assert received(*terminal, [line + b"\rt1811AA\r"]) == [(0x181, False, b"\xaa")]
    assert terminal[1].bad_lines == 1


def test_the_end_of_an_overlong_line_is_no_message(terminal) -> None:
    parts = [b"x" * 40, b"t1811AA\r", b"t1821BB\r"]
    assert received(*terminal, parts) == [(0x182, False, b"\xbb")]
    assert terminal[1].bad_lines == 1


def test_the_adapter_takes_no_end_of_an_overlong_line() -> None:
    parts = [b"9" * 40, b"9" * 40, b"t1811AA\r", b"t1821BB\r"]
    assert sent_by_adapter(parts) == [(0x182, False, b"\xbb")]

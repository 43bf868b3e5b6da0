"""Bad lines from a serial CAN adapter to its driver."""

import contextlib
import os
import re
from collections.abc import Iterator

import pytest
from hypothesis import strategies as st

from tactile.can.bus import BulkSlcanBus
from tests.fuzz.harness import bad_input, damages, pieces, spoilt

_DATA = re.compile(
    rb"(?:t(?P<id>[0-7][0-9A-Fa-f]{2})|T(?P<xid>[01][0-9A-Fa-f]{7}))"
    rb"(?P<n>[0-8])(?P<data>(?:[0-9A-Fa-f]{2})*)(?P<stamp>[0-9A-Fa-f]{4})?"
)
"""What a line of data is, by the manual of the LAWICEL CANUSB; written apart from the parser."""

Message = tuple[int, bool, bytes]
"""Identifier, whether it is an extended one, data."""


def expected(line: bytes) -> Message | None:
    """Return the message that a line is, if it is one; a time stamp may follow the data."""
    match = _DATA.fullmatch(line)
    if match is None:
        return None
    extended = match["xid"] is not None
    digits = line[10:] if extended else line[5:]
    size = 2 * int(match["n"])
    if len(digits) not in (size, size + 4):
        return None
    return int(match["xid"] or match["id"], 16), extended, bytes.fromhex(digits[:size].decode())


def line_of(can_id: int, extended: bool, data: bytes) -> bytes:
    head = b"T%08X" % can_id if extended else b"t%03X" % (can_id & 0x7FF)
    return head + b"%d" % len(data) + data.hex().upper().encode()


REPLIES = (b"", b"z", b"F00", b"F20", b"V1013", b"r1238", b"d1231FF")
ALPHABET = b"tTrRdDbB0123456789ABCDEF+-_ .\r\a"


data_lines = st.builds(line_of, st.integers(0, (1 << 29) - 1), st.booleans(), st.binary(max_size=8))
streams = st.lists(data_lines | st.sampled_from(REPLIES), min_size=1, max_size=5).map(
    b"\r".join
) | st.lists(st.sampled_from(ALPHABET), max_size=40).map(bytes)
"""Lines of data and replies, and bytes that only look like some."""


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


@bad_input(stream=streams, harm=damages(), piece=st.integers(1, 60))
def test_the_driver_takes_whole_lines_only(terminal, stream, harm, piece):
    # The end of a line, so that nothing of this input belongs to the next one.
    wire = spoilt(stream, harm) + b"\r"
    lines = wire.replace(b"\a", b"\r").split(b"\r")
    messages = [message for line in lines if (message := expected(line))]
    assert received(*terminal, pieces(wire, piece)) == messages
    return "whole lines" if messages else "dropped"


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

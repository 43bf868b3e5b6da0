"""Bad bytes on the lines: CAN messages, a serial CAN adapter, the servo bus, Modbus."""

import contextlib
import os
import re
import struct
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import strategies as st

from cell.interfaces.modbus.protocol import ModbusError, answer
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    CURRENT_LIMIT,
    FIRMWARE_VERSION,
    HOMING_OFFSET,
    VELOCITY_LIMIT,
)
from gripper.dynamixel.protocol2 import CheckedPacketHandler, StatusPacket
from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import GripperError
from simulator.can.scanner import BurstFormat
from simulator.clock import VirtualClock
from simulator.servo.protocol2 import Instruction, crc16, encode_status
from tactile.can.bus import BulkSlcanBus
from tactile.frames import FrameAssembler, FrameFormat
from tactile.layout import paper_layout
from tactile.source import TactileFrame
from tests.fuzz.harness import bad_input, damages, disturbed, pieces, spoilt
from tests.gripper.conftest import ScriptedStream

NODE = 5
SMALL = FrameFormat(n_taxels=8, sample_bytes=2)
PAPER = FrameFormat.of(paper_layout())


def sent_as(frame_format: FrameFormat) -> BurstFormat:
    return BurstFormat(frame_format.n_taxels, frame_format.sample_bytes)


def burst(frame_format: FrameFormat, counter: int) -> list[bytes]:
    counts = np.arange(frame_format.n_taxels) * (counter + 1) % 256
    return sent_as(frame_format).burst(counts, counter & 0xFFFF, counter & 0xFF)


@bad_input(
    size=st.sampled_from((SMALL, SMALL, SMALL, PAPER)),
    first=st.sampled_from((0, 7, 0xFFFE)),
    steps=st.lists(st.sampled_from((1, 1, 1, 0, 2, 4)), max_size=3),
    harm=damages(),
    lengths=st.dictionaries(st.integers(0, 20), st.integers(0, 7), max_size=2),
    examples=80,
)
def test_frames_are_made_of_what_came_and_never_go_back(*, size, first, steps, harm, lengths):
    counters = [first + sum(steps[:n]) for n in range(len(steps) + 1)]
    messages = disturbed([data for counter in counters for data in burst(size, counter)], harm)
    assembler = FrameAssembler(size)
    frames: list[TactileFrame] = []
    for number, data in enumerate(messages):
        frame = assembler.push(data[: lengths.get(number)], 0.0)
        if frame is not None:
            parts = sent_as(size).burst(frame.counts, frame.counter, frame.status)
            assert set(parts) <= set(messages)
            assert not frames or 0 < (frame.counter - frames[-1].counter) % 0x10000 < 0x8000
            frames.append(frame)
    assert assembler.counts.complete == len(frames)
    return "whole frames" if frames else "dropped"


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
    bus = BulkSlcanBus(os.ttyname(slave), bitrate=1_000_000)
    os.set_blocking(master, False)
    try:
        yield master, bus
    finally:
        bus.shutdown()
        os.close(slave)
        os.close(master)


def received(master: int, bus: BulkSlcanBus, parts: list[bytes]) -> list[Message]:
    """Return the messages that the driver takes out of bytes that come in these parts."""
    messages = []
    for part in parts:
        os.write(master, part)
        while (message := bus.recv(0)) is not None:
            assert len(messages) < 1000
            if not (message.is_remote_frame or message.is_fd or message.is_error_frame):
                assert len(message.data) == message.dlc
                can_id, extended = message.arbitration_id, message.is_extended_id
                messages.append((can_id, extended, bytes(message.data)))
    with contextlib.suppress(BlockingIOError):
        os.read(master, 4096)  # questions for the adapter's flags
    return messages


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
    [
        *(
            b"t1818112233",
            b"t1_0211AA",
            b"t+181 0",
            b"tFFF0",
            b"TFFFFFFFF0",
            b"t1811AABB",
            b"d1810",
        ),
        b"?" * 40 + b"t1811AA",  # the end of an overlong line, which comes by itself
    ],
)
def test_a_line_that_is_not_whole_is_no_message(terminal, line) -> None:
    assert received(*terminal, pieces(line + b"\rt1821BB\r", 40)) == [(0x182, False, b"\xbb")]
    assert terminal[1].bad_lines == 1


# -- The servo bus: status packets at the host, instructions at the simulated servo ----------------


BAUD = 1_000_000
QUIET = bytes(8)
"""Before the last packet: one that lost its last bytes, both FF, would take them from a header."""
START = b"\xff\xff\xfd\0"
STUFFED = (b"\xff", b"\xff\xfd", b"\xff\xff\xfd", b"\0", b"\xfd", b"\x55")
"""Parameters that have to be stuffed, or nearly."""
REGISTERS = (CURRENT_LIMIT, FIRMWARE_VERSION, HOMING_OFFSET, VELOCITY_LIMIT)


class Line(ScriptedStream):
    """A serial line on which bytes arrive at their times, and the host's receiver behind it."""

    def __init__(self) -> None:
        super().__init__(VirtualClock())
        self.answer = lambda request: None
        self.handler = CheckedPacketHandler()
        self.port = SdkPort(self, self.clock, baudrate=BAUD, return_delay_s=0.0, allowance_s=0.0)

    def arrive(self, data: bytes, at_s: float = 0.0) -> None:
        if data:
            before_s = self.arriving[-1][0] if self.arriving else 0.0
            self.arriving.append((max(at_s, before_s), data))

    def write(self, data: bytes, /) -> None:
        self.answer(data)

    def receive(self) -> StatusPacket | None:
        self.port.start_timeout(0.001)
        return self.handler.receive(self.port)


def whole_packets(wire: bytes) -> Iterator[tuple[int, int, tuple[int, bytes]]]:
    """Return start, end, servo ID and body of whatever is a packet by length and checksum.

    So is one damaged packet in 65536: a checksum of 16 bits is right by chance.
    """
    at = wire.find(START)
    while at >= 0:
        end = at + 7 + int.from_bytes(wire[at + 5 : at + 7], "little")
        checksum = int.from_bytes(wire[end - 2 : end], "little")
        if at + 10 <= end <= len(wire) and crc16(wire[at : end - 2]) == checksum:
            body = wire[at + 7 : end - 2].replace(START[:3] + b"\xfd", START[:3])
            yield at, end, (wire[at + 4], body)
        at = wire.find(START, at + 1)


ids = st.integers(0, 252)
errors = st.sampled_from((0, 0, 0x80, 4))
parameters = st.binary(max_size=24) | st.lists(st.sampled_from(STUFFED), max_size=8).map(b"".join)
statuses = st.builds(encode_status, ids, errors, parameters)
false = st.binary(max_size=20).map(
    lambda data: START + data + crc16(START + data).to_bytes(2, "little")
)
"""Other bytes, or wrong lengths, under a right checksum."""
servo_streams = st.lists(statuses | st.binary(max_size=14) | false, max_size=4).map(b"".join)
piece = st.integers(1, 40)


@bad_input(stream=servo_streams, harm=damages(), last=statuses, piece=piece)
def test_status_packets_behind_any_bytes_are_found_and_nothing_else(stream, harm, last, piece):
    line, wire = Line(), spoilt(stream, harm) + QUIET + last
    for part in pieces(wire, piece):
        line.arrive(part)
    packets = iter(line.receive, None)
    bodies = [(s.servo_id, bytes((0x55, s.error | 0x80 * s.alert)) + s.data) for s in packets]
    whole = list(whole_packets(wire))
    assert set(bodies) <= {packet for _, _, packet in whole}
    start = len(wire) - len(last)
    if not any(begin < start < end for begin, end, _ in whole):
        assert bodies[-1:] == [whole[-1][2]]
    return "several found" if len(bodies) > 1 else "the last found"


answers = st.tuples(
    st.sampled_from((0.0003, 0.0003, 0.0003, 0.01, 0.03)),
    st.sampled_from((1, 1, 1, 2)),
    errors,
    damages(at_most=2),
)
"""Delay in s, ID of the servo that answers, its error byte, damage."""


@bad_input(
    register=st.sampled_from(REGISTERS),
    data=st.binary(min_size=4, max_size=4),
    script=st.lists(answers, max_size=8),
)
def test_a_register_is_read_as_it_was_sent_or_not_at_all(register, data, script):
    line, rest, wire = Line(), iter(script), bytearray()

    def answer(request: bytes) -> None:
        late_s, servo_id, error, harm = next(rest, (0.0003, 1, 0, []))
        body = b"\xfc\x03\x2d" if request[7] == Instruction.PING else data[: register.size]
        packet = spoilt(encode_status(servo_id, error, body), harm)
        wire.extend(packet)
        line.arrive(packet, line.clock.monotonic() + late_s)

    line.answer = answer
    try:
        value = ServoBus(line, baudrate=BAUD, clock=line.clock).read(1, register)
    except GripperError:
        return "refused"
    sent = {body[2:] for _, _, (servo_id, body) in whole_packets(bytes(wire)) if servo_id == 1}
    assert value in {register.decode(body) for body in sent if len(body) == register.size}
    return "read"


def test_what_followed_an_answer_is_forgotten_with_the_next_request() -> None:
    line, first = Line(), bytearray(encode_status(1, 0, b"ab"))
    first[5] = 40  # a damaged length
    line.arrive(bytes(first) + encode_status(2, 0, b"cd") + encode_status(2, 0, b"old"))
    assert line.receive() is not None
    line.handler.send(line.port, 2, Instruction.READ, b"\0\0\4\0")
    assert line.receive() is None


# -- Modbus: every request gets one answer, and writes all or nothing ------------------------------


N = 64


class Memory:
    """Registers with their number as value; what is written is kept."""

    def __init__(self) -> None:
        self.values = list(range(N))
        self.written: list[tuple[int, Sequence[int]]] = []

    def read(self, _function: int, address: int, count: int) -> Sequence[int]:
        if address + count > N:
            raise ModbusError(2)
        return self.values[address : address + count]

    def write(self, address: int, values: Sequence[int]) -> None:
        if address + len(values) > N:
            raise ModbusError(2)
        self.written.append((address, tuple(values)))

    def disconnected(self) -> None:
        pass


def write_of(address: int, values: Sequence[int]) -> bytes:
    count = len(values)
    return struct.pack(f">BHHB{count}H", 16, address, count, 2 * count, *values)


good = (
    st.builds(struct.pack, st.just(">BHH"), st.sampled_from([3, 4, 6]), *2 * [st.integers(0, 70)])
    | st.builds(write_of, st.integers(0, 70), st.lists(st.integers(0, 0xFFFF), max_size=124))
    | st.builds(
        lambda read, write: b"\x17" + read + write[1:],
        st.builds(struct.pack, st.just(">HH"), *2 * [st.integers(0, 130)]),
        st.builds(write_of, st.integers(0, 70), st.lists(st.integers(0, 0xFFFF), max_size=122)),
    )
)
requests = st.builds(spoilt, good, damages(at_most=2)) | st.binary(max_size=253)


@bad_input(request=requests, examples=150)
def test_every_request_gets_an_answer_of_its_function_or_an_exception(request):
    memory = Memory()
    reply = answer(request, memory)
    function = request[0] if request else 0
    assert 2 <= len(reply) <= 253
    if reply[0] & 0x80:
        assert (reply[0], len(reply)) == (function | 0x80, 2)
        assert reply[1] in (1, 2, 3)
        assert memory.written == []
        return "refused"
    assert reply[0] == function
    assert len(memory.written) == (function in (6, 16, 23))
    for address, values in memory.written:
        assert 0 <= address < N
        # What is written stands in the request as it was sent: no half, no swapped value.
        assert struct.pack(f">{len(values)}H", *values) in request
    return f"function {function}"

"""Bad bytes on the servo bus: status packets at the host, instructions at the simulated servo."""

from collections import deque
from collections.abc import Iterator

from hypothesis import strategies as st

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    CURRENT_LIMIT,
    FIRMWARE_VERSION,
    HOMING_OFFSET,
    VELOCITY_LIMIT,
)
from gripper.dynamixel.protocol2 import CheckedPacketHandler, StatusPacket, unstuff
from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import GripperError
from simulator.servo.protocol2 import (
    Instruction,
    PacketParser,
    crc16,
    encode_instruction,
    encode_status,
)
from tests.fuzz.harness import Clock, bad_input, damages, pieces, spoilt

BAUD = 1_000_000
QUIET = bytes(8)
"""Before the last packet: one that lost its last bytes, both FF, would take them from a header."""
START = b"\xff\xff\xfd\0"
STUFFED = (b"\xff", b"\xff\xfd", b"\xff\xff\xfd", b"\0", b"\xfd", b"\x55")
"""Parameters that have to be stuffed, or nearly."""
REGISTERS = (CURRENT_LIMIT, FIRMWARE_VERSION, HOMING_OFFSET, VELOCITY_LIMIT)


class Line:
    """A serial line on which bytes arrive at their times, and the host's receiver behind it."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.queue: deque[tuple[float, bytes]] = deque()
        self.answer = lambda request: None
        self.handler = CheckedPacketHandler()
        self.port = SdkPort(self, self.clock, baudrate=BAUD, return_delay_s=0.0, allowance_s=0.0)

    def arrive(self, data: bytes, at_s: float = 0.0) -> None:
        if data:
            self.queue.append((max(at_s, self.queue[-1][0] if self.queue else 0.0), data))

    def write(self, data: bytes, /) -> None:
        self.answer(data)

    def read(self, size: int, timeout_s: float, /) -> bytes:
        if not self.queue or self.queue[0][0] > self.clock.now_s + timeout_s:
            self.clock.now_s += timeout_s
            return b""
        at_s, data = self.queue.popleft()
        self.clock.now_s = max(self.clock.now_s, at_s)
        if len(data) > size:
            self.queue.appendleft((at_s, data[size:]))
        return data[:size]

    def drop_input(self) -> None:
        while self.queue and self.queue[0][0] <= self.clock.now_s:
            self.queue.popleft()

    def receive(self) -> StatusPacket | None:
        self.port.setPacketTimeoutMillis(1.0)
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
            yield at, end, (wire[at + 4], unstuff(wire[at + 7 : end - 2]))
        at = wire.find(START, at + 1)


def check(wire: bytes, found: list[tuple[int, bytes]], last: bytes) -> str:
    """Assert that whole packets only were found, and the last one among them."""
    whole = list(whole_packets(wire))
    assert set(found) <= {packet for _, _, packet in whole}
    start = len(wire) - len(last)
    if not any(begin < start < end for begin, end, _ in whole):
        assert found[-1:] == [whole[-1][2]]
    return "several found" if len(found) > 1 else "the last found"


def with_checksum(start: bytes) -> bytes:
    return start + crc16(start).to_bytes(2, "little")


def streams(packets: st.SearchStrategy[bytes]) -> st.SearchStrategy[bytes]:
    """Return the strategy of packets, and of false ones: other bytes, or wrong lengths under a
    right checksum."""
    false = st.binary(max_size=20).map(lambda data: with_checksum(START + data))
    return st.lists(packets | st.binary(max_size=14) | false, max_size=4).map(b"".join)


ids = st.integers(0, 252)
errors = st.sampled_from((0, 0, 0x80, 4))
parameters = st.binary(max_size=24) | st.lists(st.sampled_from(STUFFED), max_size=8).map(b"".join)
statuses = st.builds(encode_status, ids, errors, parameters)
orders = st.builds(encode_instruction, ids, st.sampled_from(Instruction), parameters)
piece = st.integers(1, 40)


@bad_input(stream=streams(statuses), harm=damages(), last=statuses, piece=piece)
def test_status_packets_behind_any_bytes_are_found_and_nothing_else(stream, harm, last, piece):
    line = Line()
    wire = spoilt(stream, harm) + QUIET + last
    for part in pieces(wire, piece):
        line.arrive(part)
    found = iter(line.receive, None)
    bodies = [(s.servo_id, bytes((0x55, s.error | 0x80 * s.alert)) + s.data) for s in found]
    return check(wire, bodies, last)


@bad_input(stream=streams(orders), harm=damages(), last=orders, piece=piece)
def test_instructions_behind_any_bytes_are_found_and_nothing_else(stream, harm, last, piece):
    wire = spoilt(stream, harm) + QUIET + last
    parser = PacketParser()
    found = [packet for part in pieces(wire, piece) for packet in parser.push(part)]
    intact = [(p.packet_id, bytes((p.instruction,)) + p.parameters) for p in found if p.intact]
    return check(wire, intact, last)


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
        line.arrive(packet, line.clock.now_s + late_s)

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

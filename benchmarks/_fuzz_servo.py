"""Fuzz targets of the servo bus: status packets on the host's side, instructions on the other."""

import random
from collections import deque

from benchmarks._fuzz_engine import BY_CHANCE, Broken, Target
from benchmarks._fuzz_mutate import mutated, pieces
from gripper.bus import ServoBus
from gripper.errors import GripperError
from gripper.packet_handler import CheckedPacketHandler
from gripper.port import SdkPort
from gripper.registers import CURRENT_LIMIT, FIRMWARE_VERSION, HOMING_OFFSET, VELOCITY_LIMIT
from simulator.protocol2 import (
    Instruction,
    PacketParser,
    encode_instruction,
    encode_status,
)

_BAUD = 1_000_000
_QUIET = bytes(8)
"""Before the last packet: one that lost its last bytes, both FF, would take them from a header."""
_HEADERS = b"\xff\xff\xfd\x00\x01\xfd\xff\x55\x80"
_READABLE = {r.name: r for r in (CURRENT_LIMIT, FIRMWARE_VERSION, HOMING_OFFSET, VELOCITY_LIMIT)}

Answers = list[tuple[float, bytes, bytes]]
"""Delay in s, answer to a read, answer to a ping, for each request."""


class Clock:
    """Time that passes in waiting only."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.now_s += seconds


class Line:
    """A serial line on which bytes arrive at their times."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.queue: deque[tuple[float, bytes]] = deque()
        self.reads = 0
        self.answer = lambda data: None

    def arrive(self, data: bytes, at_s: float) -> None:
        if data:
            at_s = max(at_s, self.queue[-1][0] if self.queue else 0.0)
            self.queue.append((at_s, data))

    def write(self, data: bytes, /) -> None:
        self.answer(data)

    def read(self, size: int, timeout_s: float, /) -> bytes:
        self.reads += 1
        if self.reads > 20_000:
            raise Broken("more than 20000 reads for one input")
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

    def close(self) -> None:
        self.queue.clear()


def _parameters(rng: random.Random, longest: int = 24) -> bytes:
    size = rng.randint(0, longest)
    if rng.random() < 0.5:
        return rng.randbytes(size)
    return bytes(rng.choices(_HEADERS, k=size))


class StatusTrial:
    """Streams of status packets, damaged; the last packet is whole and must be found."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.handler = CheckedPacketHandler()

    def generate(self, rng: random.Random) -> tuple[bytes, list[bytes], bool]:
        sent = [
            (rng.randint(0, 252), rng.choice((0, 0, 0x80, 1, 7, 0x84)), _parameters(rng))
            for _ in range(rng.randint(1, 3))
        ]
        self.sent = {(i, e & 0x7F, bool(e & 0x80), d) for i, e, d in sent}
        packets = [encode_status(*packet) for packet in sent]
        wire = mutated(rng, b"".join(packets), packets)
        self.last = None
        if rng.random() < 0.5:
            self.last = (rng.randint(0, 252), 0, False, _parameters(rng))
            self.sent.add(self.last)
            wire += _QUIET + encode_status(self.last[0], 0, self.last[3])
        return wire, pieces(rng, wire), self.last is not None

    def check(self, item: tuple[bytes, list[bytes], bool]) -> str:
        line = Line(self.clock)
        port = SdkPort(line, self.clock, baudrate=_BAUD, return_delay_s=0.0005, allowance_s=0.001)
        for piece in item[1]:
            line.arrive(piece, self.clock.now_s)
        found = []
        while True:
            port.setPacketTimeoutMillis(5.0)
            status = self.handler.receive(port)
            if status is None:
                break
            found.append((status.servo_id, status.error, status.alert, status.data))
        if any(status not in self.sent for status in found):
            return BY_CHANCE
        if self.last is not None and self.last not in found:
            raise Broken("a whole packet after damaged bytes was not found")
        return "whole packets only" if found else "dropped"


class BusTrial:
    """Values read through `ServoBus` while answers are damaged, doubled, late or lost."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.line = Line(self.clock)
        self.bus = ServoBus(self.line, baudrate=_BAUD, clock=self.clock)

    def generate(
        self, rng: random.Random
    ) -> tuple[int, str, int, list[tuple[float, bytes, bytes]]]:
        register = rng.choice(list(_READABLE.values()))
        servo_id = rng.randint(1, 3)
        data = rng.randbytes(register.size)
        answers = []
        for _ in range(8):
            bodies = []
            for body in (data, b"\xfc\x03\x2d"):
                packet = encode_status(servo_id, rng.choice((0, 0, 0, 0x80)), body)
                chance = rng.random()
                if chance < 0.5:
                    packet = mutated(rng, packet)
                elif chance < 0.6:
                    packet += packet
                elif chance < 0.7:
                    packet = b""
                elif chance < 0.8:
                    packet = encode_status(servo_id % 3 + 1, rng.randint(0, 255), data)
                bodies.append(packet)
            late_s = rng.random() * 0.03 if rng.random() < 0.2 else 0.0003
            answers.append((late_s, bodies[0], bodies[1]))
        return servo_id, register.name, int.from_bytes(data, "little"), answers

    def check(self, item: tuple[int, str, int, Answers]) -> str:
        servo_id, name, raw, answers = item
        register = _READABLE[name]
        waiting = iter(answers)
        self.line.reads = 0

        def answer(request: bytes) -> None:
            late_s, data, ping = next(waiting, (0.0, b"", b""))
            self.line.arrive(ping if request[7] == 1 else data, self.clock.now_s + late_s)

        self.line.answer = answer
        try:
            value = self.bus.read(servo_id, register)
        except GripperError as error:
            return f"refused: {type(error).__name__}"
        if value != register.decode(raw.to_bytes(register.size, "little")):
            return self._by_chance(answers, servo_id, register.size, value)
        return "the right value"

    @staticmethod
    def _by_chance(answers: Answers, servo_id: int, size: int, value: int) -> str:
        for _, data, _ in answers:
            if data and data[4:5] == bytes((servo_id,)) and len(data) >= 11 + size:
                return BY_CHANCE
        raise Broken(f"read {value}, which nobody sent")


class InstructionTrial:
    """Streams of instructions for the simulated servo's parser."""

    def __init__(self) -> None:
        self.codes = [int(code) for code in Instruction]

    def generate(self, rng: random.Random) -> tuple[list[bytes], bool]:
        sent = [
            (rng.choice((1, 2, 0xFE)), rng.choice(self.codes), _parameters(rng))
            for _ in range(rng.randint(1, 3))
        ]
        packets = [encode_instruction(*packet) for packet in sent]
        wire = mutated(rng, b"".join(packets), packets)
        self.sent = set(sent)
        self.last = None
        if rng.random() < 0.5:
            self.last = (rng.randint(0, 252), 2, _parameters(rng))
            self.sent.add(self.last)
            wire += _QUIET + encode_instruction(*self.last)
        return pieces(rng, wire), self.last is not None

    def check(self, item: tuple[list[bytes], bool]) -> str:
        parser = PacketParser()
        found = []
        for piece in item[0]:
            found += [tuple(p)[:3] for p in parser.push(piece) if p.intact]
        if any(packet not in self.sent for packet in found):
            return BY_CHANCE
        if self.last is not None and self.last not in found:
            raise Broken("a whole instruction after damaged bytes was not found")
        return "whole packets only" if found else "dropped"


TARGETS = (
    Target(
        name="servo-status",
        parser="gripper.packet_handler, gripper.packets",
        inputs="streams of 1 to 4 status packets: bits, bytes, stuffing, lengths, cuts, splices",
        make=StatusTrial,
        crc_tests=4,
    ),
    Target(
        name="servo-bus",
        parser="gripper.bus, gripper.line, gripper.port",
        inputs="register reads whose answers are damaged, doubled, late, lost or another servo's",
        make=BusTrial,
        crc_tests=4,
    ),
    Target(
        name="servo-instruction",
        parser="simulator.protocol2",
        inputs="streams of 1 to 4 instruction packets, damaged and cut into pieces",
        make=InstructionTrial,
        crc_tests=4,
    ),
)

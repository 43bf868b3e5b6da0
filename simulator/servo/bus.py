"""The servos on their half-duplex bus: reception, answers and their times.

A byte takes ten bits on the wire. An answer starts after the instruction and the servo's return
delay. In a group read each servo waits for the answers before its own.
"""

import functools
import heapq
import itertools
import math
import operator
import struct
from collections.abc import Iterable, Sequence
from typing import Protocol

from gripper.dynamixel.control_table import PROTOCOL_TYPE
from simulator.clock import ROUNDING_S, VirtualClock
from simulator.errors import PortUnplugged
from simulator.servo.device import SimulatedServo
from simulator.servo.faults import WireFaults
from simulator.servo.protocol2 import (
    BROADCAST_ID,
    STATUS,
    Instruction,
    Packet,
    PacketParser,
    StatusError,
    encode_status,
)

BITS_PER_BYTE = 10
"""Bits on the line for one byte: start bit, 8 data bits, stop bit."""
_PLACE = struct.Struct("<HH")
"""Address and size in a group instruction."""
_ROUNDING = 1e-6
"""Share of a period by which the time of a burst may be rounded."""
_GROUP_READS = frozenset({Instruction.SYNC_READ, Instruction.BULK_READ})
_GROUP_WRITES = frozenset({Instruction.SYNC_WRITE, Instruction.BULK_WRITE})
"""Instructions to several servos."""


class ServoBusDevice:
    """All servos behind one serial port.

    Parameters
    ----------
    baudrate
        Line rate of the host in baud; a servo with another Baud Rate (8) stays silent.
    """

    def __init__(
        self, servos: Sequence[SimulatedServo], baudrate: int, faults: WireFaults | None = None
    ) -> None:
        self.servos = tuple(servos)
        self.baudrate = baudrate
        """Line rate of the host in baud; an endpoint sets it to the client's rate."""
        self.faults = faults or WireFaults()
        self._parser = PacketParser()
        self._line_free_s = float("-inf")
        self._queue: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        self._burst: int | None = None  # number of the last burst of another device

    @property
    def unplugged(self) -> bool:
        """Whether the cable is out."""
        return self.faults.unplugged

    def advance_to(self, now_s: float) -> None:
        """Run watchdogs and protections; call it once for each step of the mechanics."""
        for servo in self.servos:
            servo.supervise(now_s)

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Take bytes that the host sent.

        Parameters
        ----------
        sent_after_s
            Earliest time in s at which the host may have sent them, if the exact time is not known:
            a watchdog that expired since then was fed in time. None: just now; the caller has
            advanced the servos.
        """
        faults = self.faults
        if faults.unplugged:
            return
        if sent_after_s is not None:
            self.advance_to(min(sent_after_s, now_s))
        end_s = max(now_s, self._line_free_s) + self._wire_s(len(data))
        self._line_free_s = end_s
        if faults.echo:
            self._send_at(end_s, data)
        for packet in self._parser.push(faults.request(data)):
            self._dispatch(packet, end_s)

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by ``now_s``."""
        if self.faults.chatter is not None or self._burst is not None:
            self._hear_chatter(now_s)
        queue = self._queue
        if not queue or queue[0][0] > now_s + ROUNDING_S:
            return b""
        pieces = []
        while queue and queue[0][0] <= now_s + ROUNDING_S:
            pieces.append(heapq.heappop(queue)[2])
        return b"" if self.faults.unplugged else b"".join(pieces)

    def next_event_s(self) -> float:
        """Return when the next bytes reach the host; infinity: none are under way."""
        due_s = self._queue[0][0] if self._queue else math.inf
        if self.faults.chatter is not None and self._burst is not None:
            due_s = min(due_s, (self._burst + 1) * self.faults.chatter.every_s)
        return due_s

    def drop_pending(self) -> None:
        """Drop bytes in transit and incomplete packets, as by an adapter without supply."""
        self._queue.clear()
        self._parser.reset()

    # Dispatch

    def _dispatch(self, packet: Packet, now_s: float) -> None:
        if packet.instruction == STATUS:
            return
        hearing = [servo for servo in self.servos if self._listens(servo, now_s)]
        for servo in hearing if packet.intact else ():
            servo.fed_s = now_s
        if packet.packet_id != BROADCAST_ID:
            same_id = [servo for servo in hearing if servo.servo_id == packet.packet_id]
            self._let_answer(same_id, packet, now_s)
        elif packet.intact:
            self._broadcast(packet, hearing, now_s)

    def _listens(self, servo: SimulatedServo, now_s: float) -> bool:
        """Return whether a servo takes a packet of Protocol 2.0."""
        silent = self.faults.silent
        return (
            servo.registers.data[PROTOCOL_TYPE.address] != 1
            and servo.baudrate == self.baudrate
            and now_s >= servo.silent_until_s
            and not (silent and servo.made_as in silent)
        )

    def _let_answer(self, same_id: Iterable[SimulatedServo], packet: Packet, now_s: float) -> None:
        """Let servos with one ID carry out an instruction; they answer at the same time."""
        speakers = list[tuple[SimulatedServo, bytes, float]]()
        for servo in same_id:
            own_id, delay_s = servo.servo_id, servo.return_delay_s
            speaks = servo.answers(packet.instruction)
            error, data = (
                servo.execute(packet.instruction, packet.parameters, now_s)
                if packet.intact
                else servo.status(StatusError.CRC)
            )
            if speaks:
                speakers.append((servo, encode_status(own_id, error, data), delay_s))
        if speakers:
            servo, _, delay_s = speakers[0]
            self._reply(servo, _at_once([answer for _, answer, _ in speakers]), now_s, delay_s)

    def _broadcast(self, packet: Packet, hearing: list[SimulatedServo], now_s: float) -> None:
        instruction, parameters = packet.instruction, packet.parameters
        if instruction == Instruction.PING:
            in_turn = sorted(hearing, key=lambda s: s.servo_id)
            for _, same_id in itertools.groupby(in_turn, key=lambda s: s.servo_id):
                self._let_answer(same_id, packet, now_s)
        elif instruction in _GROUP_READS:
            self._chain(instruction, _entries(instruction, parameters), hearing, now_s)
        elif instruction in _GROUP_WRITES:
            for servo_id, address, _, data in _entries(instruction, parameters):
                for servo in hearing:
                    if servo_id == servo.servo_id:
                        servo.write(address, data, now_s)
        else:
            for servo in hearing:
                servo.execute(instruction, parameters, now_s)

    def _chain(
        self,
        instruction: int,
        requests: Sequence[tuple[int, int, int, bytes]],
        hearing: Iterable[SimulatedServo],
        now_s: float,
    ) -> None:
        """Let servos answer in sequence; the first silent servo ends the chain."""
        by_id = {servo.servo_id: servo for servo in hearing}
        for servo_id, address, size, _ in requests:
            servo = by_id.get(servo_id)
            if servo is None or not servo.answers(instruction):
                break
            error, data = servo.read(address, size, now_s)
            self._reply(servo, encode_status(servo_id, error, data), now_s)

    # Line

    def _wire_s(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.baudrate

    def _reply(
        self, servo: SimulatedServo, packet: bytes, now_s: float, delay_s: float | None = None
    ) -> None:
        pause_s = servo.return_delay_s if delay_s is None else delay_s
        start_s = max(now_s, self._line_free_s) + pause_s
        end_s = start_s + self._wire_s(len(packet))
        self._line_free_s = end_s
        if self.faults.chatter is not None:
            packet = self._met_by_chatter(packet, start_s, end_s)
        for late_s, data in self.faults.answer(servo.servo_id, packet):
            self._send_at(end_s + late_s, data)

    def _hear_chatter(self, until_s: float) -> None:
        """Deliver the bytes of another device until a time to the host."""
        for moment_s, data in self._bursts(until_s):
            self._send_at(moment_s + self._wire_s(len(data)), data)

    def _met_by_chatter(self, packet: bytes, start_s: float, end_s: float) -> bytes:
        """Return an answer mixed with bytes that another device sends at the same time."""
        self._hear_chatter(start_s)
        for moment_s, data in reversed(self._bursts(end_s)):
            place = round((moment_s - start_s) / self._wire_s(1))
            packet = packet[:place] + data + packet[place:]
        return packet

    def _bursts(self, until_s: float) -> list[tuple[float, bytes]]:
        """Return begin in s and bytes of further bursts of another device until a time in s."""
        chatter, before = self.faults.chatter, self._burst
        if chatter is None:
            self._burst = None
            return []
        last = math.floor(until_s / chatter.every_s + _ROUNDING)
        before = last if before is None else before
        self._burst = max(before, last)
        return [(n * chatter.every_s, chatter.data) for n in range(before + 1, last + 1)]

    def _send_at(self, due_s: float, data: bytes) -> None:
        heapq.heappush(self._queue, (due_s, next(self._order), data))


def _at_once(packets: Sequence[bytes]) -> bytes:
    """Return the bytes at the host if servos with the same ID answer at the same time.

    A driven 0 overrides the 1 of an idle line: equal answers look like one, others are damaged.
    """
    longest = max(map(len, packets))
    padded = (int.from_bytes(packet.ljust(longest, b"\xff")) for packet in packets)
    return functools.reduce(operator.and_, padded).to_bytes(longest)


def _entries(instruction: int, parameters: bytes) -> list[tuple[int, int, int, bytes]]:
    """Return ID, address, size and data for each servo of a group instruction.

    One that is cut off has none.
    """
    sync = instruction in {Instruction.SYNC_READ, Instruction.SYNC_WRITE}
    entries, at, end = [], 4 if sync else 0, len(parameters)
    try:
        address, size = _PLACE.unpack_from(parameters) if sync else (0, 0)
        while at < end:
            servo_id = parameters[at]
            if not sync:
                address, size = _PLACE.unpack_from(parameters, at + 1)
                at += 4
            at += 1
            data = parameters[at : at + size] if instruction in _GROUP_WRITES else b""
            if instruction in _GROUP_WRITES and not len(data) == size > 0:
                return []
            at += len(data)
            entries.append((servo_id, address, size, data))
    except struct.error:
        return []
    return entries


class SerialDevice(Protocol):
    """A device on a serial line."""

    baudrate: int
    """Line rate in baud that the host has set."""

    @property
    def unplugged(self) -> bool:
        """Whether the cable is out."""

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Take bytes that the host sent."""

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by ``now_s``."""

    def next_event_s(self) -> float:
        """Return when the next bytes reach the host; infinity: none are under way."""

    def drop_pending(self) -> None:
        """Forget bytes under way."""


class MemoryServoStream:
    """The host's end of a serial line in memory: bytes, with the time on the wire.

    Writing does not wait for the wire, as with a USB adapter. An answer arrives complete, with its
    last byte.
    """

    def __init__(self, device: SerialDevice, clock: VirtualClock) -> None:
        self.clock = clock
        self.closed = False
        self._device = device
        self._input = bytearray()
        self._lost = False

    def __str__(self) -> str:
        return "simulated"

    def write(self, data: bytes) -> None:
        """Send bytes to the servos.

        Raises PortUnplugged after the cable was unplugged once, and after `close`: as with a port
        of the system, an open port stays broken when the cable is back.
        """
        self._check()
        self._device.receive(data, self.clock.monotonic())

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to ``size`` bytes as soon as one is there, ``b""`` after ``timeout_s`` s."""
        self._check()
        deadline_s = self.clock.monotonic() + timeout_s
        while True:
            now_s = self.clock.monotonic()
            self._input += self._device.transmit(now_s)
            if self._input or now_s >= deadline_s:
                data = bytes(self._input[:size])
                del self._input[:size]
                return data
            until_s = min(self._device.next_event_s(), deadline_s)
            self.clock.sleep(max(until_s - now_s, ROUNDING_S))
            self._check()

    def drop_input(self) -> None:
        """Forget the bytes that have arrived and were not read."""
        self._check()
        self._device.transmit(self.clock.monotonic())
        self._input.clear()

    def close(self) -> None:
        """Close the stream; closing it again changes nothing."""
        self.closed = True

    def _check(self) -> None:
        if self.closed:
            raise PortUnplugged("the servo stream is closed; open a new one")
        self._lost |= self._device.unplugged
        if self._lost:
            raise PortUnplugged(
                "the simulated cable is unplugged (fault servos.unplugged or board.unplugged); "
                "plug it in and open the port again"
            )

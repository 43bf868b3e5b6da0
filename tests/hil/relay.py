"""Stand between a program and the terminal of a simulated device, and damage the bytes that pass.

    python relay.py LINE PORT SEED

LINE is ``servos`` (packets of Protocol 2.0) or ``can`` (lines of an slcan adapter). Prints the path
of its own terminal; then takes one order a line: ``pass``, ``hang_up``, ``chatter SECONDS WHAT``
with a name of `CHATTERS`, or a name of `DAMAGES` and its value. Answers of the device are damaged
packet by packet, requests with ``flip`` and ``drop`` too, each write as one.
"""

import heapq
import itertools
import os
import random
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterable

SIZE = 4096
HEADER = b"\xff\xff\xfd\x00"
PIECE_GAP_S = 0.001
CHATTERS = {
    "byte": b"\xa5",
    "burst": bytes(range(0x80, 0xA8)),
    "sentence": b"$GPGGA,092751.000,5321.6802,N,00630.3371,W,1,8,1.03,61.7,M,55.3,M,,*75\r\n",
}
"""What something else sends on the line: noise, and a GPS receiver."""

Pieces = Iterable[tuple[float, bytes]]
"""Delay in s and bytes, for the host."""


def crc16(data: bytes) -> int:
    """CRC of Protocol 2.0: polynomial 0x8005."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def status(servo_id: int, data: bytes) -> bytes:
    """Return a status packet without an error."""
    packet = (
        HEADER + bytes((servo_id,)) + (len(data) + 4).to_bytes(2, "little") + b"\x55\x00" + data
    )
    return packet + crc16(packet).to_bytes(2, "little")


class Servos:
    """The servo line: packets, and what belongs to one kind of them."""

    foreign = status(9, b"\x01\x02\x03\x04")

    @staticmethod
    def packets(data: bytes) -> tuple[list[bytes], bytes]:
        """Return the whole packets and the rest."""
        found = []
        while len(data) >= 7:
            start = data.find(HEADER)
            if start:
                # Nothing that begins like a packet: it passes as it is.
                start = len(data) if start < 0 else start
                found.append(data[:start])
                data = data[start:]
                continue
            size = 7 + int.from_bytes(data[5:7], "little")
            if len(data) < size:
                break
            found.append(data[:size])
            data = data[size:]
        return found, data

    @staticmethod
    def kind(packet: bytes) -> bytes | None:
        """Return what packets of one sender and one request have in common."""
        return packet[4:7] if packet.startswith(HEADER) else None


class Can:
    """The line of a serial CAN adapter (slcan): lines that end with CR, or BEL for a refusal."""

    foreign = b"t7A081122334455667788\r"

    @staticmethod
    def packets(data: bytes) -> tuple[list[bytes], bytes]:
        """Return the whole lines and the rest."""
        found = data.replace(b"\a", b"\a\r").split(b"\r")
        lines = [line if line.endswith(b"\a") else line + b"\r" for line in found[:-1]]
        return lines, found[-1]

    @staticmethod
    def kind(packet: bytes) -> bytes | None:
        """Return what frames of one identifier have in common; None for what is no frame."""
        return packet[:5] if packet[:1] == b"t" else None


class Relay:
    """Both terminals, and what happens to the bytes between them."""

    def __init__(self, line: Servos | Can, port: str, seed: int) -> None:
        self.line = line
        self.device = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.device)
        speed = termios.tcgetattr(self.device)
        speed[4] = speed[5] = termios.B1000000
        termios.tcsetattr(self.device, termios.TCSANOW, speed)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.random = random.Random(seed)
        self.queue: list[tuple[float, int, bytes]] = []
        self.count = itertools.count()
        self.rest = b""
        self.set("pass")

    def serve(self) -> None:
        self.say(os.ttyname(self.slave))
        while True:
            due_s = min([entry[0] for entry in self.queue[:1]] + [self.chatter_due_s])
            left_s = None if due_s == float("inf") else max(0.0, due_s - time.monotonic())
            ready, _, _ = select.select([self.device, self.master, sys.stdin], [], [], left_s)
            if sys.stdin in ready and not self.obey(sys.stdin.readline().split()):
                return
            if self.master in ready:
                data = self.requests(os.read(self.master, SIZE))
                if data:
                    os.write(self.device, data)
            if self.device in ready:
                self.answers(os.read(self.device, SIZE))
            self.chatter()
            self.deliver()

    def say(self, text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def obey(self, words: list[str]) -> bool:
        """Take an order; False where there is no more to do."""
        if not words or words[0] == "hang_up":
            os.close(self.master)  # at once: a process takes its time to end
            return False
        self.set(words[0], *words[1:])
        self.say("yes")
        return True

    def set(self, order: str, value: str = "0", word: str = "") -> None:
        """Damage what passes from now on in one way."""
        if order not in {"pass", "chatter", *DAMAGES}:
            raise ValueError(f"unknown order {order}")
        self.order, self.value, self.word = order, float(value), word
        self.before: dict[bytes, bytes] = {}
        self.held = b""
        self.last_s = 0.0
        chatters = order in {"chatter", "noise", "instead"}
        self.chatter_due_s = time.monotonic() if chatters else float("inf")

    def requests(self, data: bytes) -> bytes:
        if self.order not in {"flip", "drop"} or not self.hit():
            return data
        return b"" if self.order == "drop" else self.flipped(data)

    def answers(self, data: bytes) -> None:
        packets, self.rest = self.line.packets(self.rest + data)
        act = DAMAGES.get(self.order)
        for packet in packets:
            for late_s, piece in act(self, packet) if act else ((0.0, packet),):
                self.send(late_s, piece)

    def send(self, late_s: float, data: bytes) -> None:
        if data:
            heapq.heappush(self.queue, (time.monotonic() + late_s, next(self.count), data))

    def chatter(self) -> None:
        while self.chatter_due_s <= time.monotonic():
            self.send(0.0, CHATTERS[self.word])
            self.chatter_due_s += self.value

    def deliver(self) -> None:
        while self.queue and self.queue[0][0] <= time.monotonic():
            data = heapq.heappop(self.queue)[2]
            try:
                os.write(self.master, data)
            except BlockingIOError:
                # Nobody reads: the terminal is full, as a line without flow control loses bytes.
                continue

    def hit(self) -> bool:
        """Whether the damage meets this packet; the value is the share of those that it meets."""
        return self.random.random() < self.value

    def flipped(self, data: bytes) -> bytes:
        bit = self.random.randrange(8 * len(data))
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)

    def place(self, packet: bytes) -> int:
        return self.random.randrange(len(packet))


def flip(relay: Relay, packet: bytes) -> Pieces:
    """A bit turns in a share of the packets."""
    return [(0.0, relay.flipped(packet) if relay.hit() else packet)]


def drop(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets is lost."""
    return [] if relay.hit() else [(0.0, packet)]


def repeat(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets comes twice."""
    return [(0.0, packet)] * (2 if relay.hit() else 1)


def cut(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets lacks its end."""
    return [(0.0, packet[: relay.place(packet)] if relay.hit() else packet)]


def lose_byte(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets lacks a byte."""
    place = relay.place(packet)
    return [(0.0, packet[:place] + packet[place + 1 :] if relay.hit() else packet)]


def insert_byte(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets has a byte too many."""
    place = relay.place(packet)
    more = bytes((relay.random.randrange(256),)) if relay.hit() else b""
    return [(0.0, packet[:place] + more + packet[place:])]


def foreign(relay: Relay, packet: bytes) -> Pieces:
    """A whole packet of another sender comes before a share of the packets."""
    return [(0.0, relay.line.foreign if relay.hit() else b""), (0.0, packet)]


def swap(relay: Relay, packet: bytes) -> Pieces:
    """A share of the packets comes behind its successor."""
    if not relay.held and relay.hit():
        relay.held = packet
        return []
    held, relay.held = relay.held, b""
    return [(0.0, packet), (0.0, held)]


def delay(relay: Relay, packet: bytes) -> Pieces:
    """All packets come so many s later."""
    return [(relay.value, packet)]


def repeat_late(relay: Relay, packet: bytes) -> Pieces:
    """All packets come again so many s later."""
    return [(0.0, packet), (relay.value, packet)]


def lag(relay: Relay, packet: bytes) -> Pieces:
    """Each packet is replaced by the one of its kind before."""
    kind = relay.line.kind(packet)
    if kind is None:
        return [(0.0, packet)]
    before = relay.before.get(kind, packet)
    relay.before[kind] = packet
    return [(0.0, before)]


def split(relay: Relay, packet: bytes) -> Pieces:
    """Packets come in pieces of so many bytes, 1 ms apart."""
    size = int(relay.value)
    now_s = time.monotonic()
    pieces = []
    for start in range(0, len(packet), size):
        relay.last_s = max(now_s, relay.last_s + PIECE_GAP_S)
        pieces.append((relay.last_s - now_s, packet[start : start + size]))
    return pieces


def merge(relay: Relay, packet: bytes) -> Pieces:
    """Packets come together, each so many s."""
    return [(relay.value - time.monotonic() % relay.value, packet)]


def noise(relay: Relay, packet: bytes) -> Pieces:
    """Chatter comes by itself, and into each packet, as on a line where two send at once."""
    place = relay.place(packet)
    return [(0.0, packet[:place] + CHATTERS[relay.word] + packet[place:])]


def instead(_relay: Relay, _packet: bytes) -> Pieces:
    """Chatter comes by itself and no packet does: another device is at the port."""
    return []


_ACTS = (flip, drop, repeat, cut, lose_byte, insert_byte, foreign, swap, delay, repeat_late)
_ACTS += (lag, split, merge, noise, instead)
DAMAGES: dict[str, Callable[[Relay, bytes], Pieces]] = {act.__name__: act for act in _ACTS}
"""What may happen to a packet on its way to the host, by name."""


if __name__ == "__main__":
    Relay({"servos": Servos(), "can": Can()}[sys.argv[1]], sys.argv[2], int(sys.argv[3])).serve()

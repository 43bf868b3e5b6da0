"""Fuzz targets of the serial CAN adapter's lines: our driver's end and the simulated adapter's."""

import contextlib
import os
import random
import re

from benchmarks._fuzz_engine import Broken, Target
from benchmarks._fuzz_mutate import mutated, pieces
from simulator.slcan import OUTPUT_LIMIT, SlcanAdapter
from tactile.can_bus import BulkSlcanBus

_HEX = b"0123456789ABCDEFabcdef"
_SETUP = (b"O", b"C", b"S8", b"L", b"Z1", b"F", b"V", b"N", b"s031C", b"M00000000", b"X1")
_DATA = re.compile(
    rb"(?:t(?P<id>[0-7][0-9A-Fa-f]{2})|T(?P<xid>[01][0-9A-Fa-f]{7}))"
    rb"(?P<n>[0-8])(?P<data>(?:[0-9A-Fa-f]{2})*)(?P<stamp>[0-9A-Fa-f]{4})?"
)
"""What a line of data is, by the manual of the LAWICEL CANUSB; written apart from the parsers."""

Message = tuple[int, bool, bytes]


def _line(rng: random.Random) -> bytes:
    extended = rng.random() < 0.3
    data = rng.randbytes(rng.randint(0, 8))
    head = b"T%08X" % rng.randrange(1 << 29) if extended else b"t%03X" % rng.randrange(0x800)
    return head + b"%d" % len(data) + data.hex().upper().encode()


def _expected(line: bytes, *, stamps: bool) -> Message | None:
    match = _DATA.fullmatch(line)
    if match is None:
        return None
    extended = match["xid"] is not None
    digits = line[10:] if extended else line[5:]
    size = 2 * int(match["n"])
    if len(digits) != size and not (stamps and len(digits) == size + 4):
        return None
    return int(match["xid"] or match["id"], 16), extended, bytes.fromhex(digits[:size].decode())


class HostTrial:
    """Bytes that an adapter sends to our driver, over a pseudo-terminal."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        name = os.ttyname(slave)
        self.bus = BulkSlcanBus(name, bitrate=1_000_000, tty_baudrate=1_000_000)
        os.close(slave)
        os.set_blocking(self.master, False)

    def close(self) -> None:
        self.bus.shutdown()
        os.close(self.master)

    def generate(self, rng: random.Random) -> list[bytes]:
        lines = [_line(rng) for _ in range(rng.randint(1, 4))]
        lines += rng.choices((b"", b"z", b"F00", b"V1013", b"\a", b"r1238", b"d1231FF"), k=1)
        wire = b"\r".join(lines) + b"\r"
        kind = rng.random()
        if kind < 0.6:
            wire = mutated(rng, wire, lines)
        elif kind < 0.8:
            wire = bytes(rng.choices(b"tTrRdDbB0123456789ABCDEF+-_ .\r", k=rng.randint(1, 40)))
        # The end of a line, so that nothing of this input belongs to the next one.
        return pieces(rng, wire + b"\r")

    def check(self, item: list[bytes]) -> str:
        expected = [
            message
            for line in b"".join(item).replace(b"\a", b"\r").split(b"\r")
            if (message := _expected(line, stamps=True)) is not None
        ]
        found: list[Message] = []
        for piece in item:
            os.write(self.master, piece)
            self._take(found)
        with contextlib.suppress(BlockingIOError):
            os.read(self.master, 4096)
        if found != expected:
            raise Broken(f"found {found}, expected {expected}")
        return "whole lines only" if found else "dropped"

    def _take(self, found: list[Message]) -> None:
        for _ in range(1000):
            message = self.bus.recv(0)
            if message is None:
                return
            if message.is_remote_frame or message.is_fd or message.is_error_frame:
                continue
            if len(message.data) != message.dlc:
                raise Broken(f"a message of {message.dlc} bytes holds {len(message.data)}")
            found.append((message.arbitration_id, message.is_extended_id, bytes(message.data)))
        raise Broken("the driver does not come to an end")


class _Wire:
    """Takes what the adapter puts on the bus."""

    class faults:  # noqa: N801  the adapter asks for the bus's state here
        """Nothing is wrong."""

        error_passive = bus_off = False

    def __init__(self) -> None:
        self.sent: list[Message] = []

    def send(self, can_id: int, data: bytes, now_s: float, *, extended: bool = False) -> None:
        self.sent.append((can_id, extended, data))

    def take(self, now_s: float) -> None:
        return None

    def advance(self, now_s: float) -> None: ...

    def clear(self) -> None: ...


class AdapterTrial:
    """Bytes that a client sends to the simulated adapter."""

    def __init__(self) -> None:
        self.wire = _Wire()
        self.adapter = SlcanAdapter(self.wire, bitrate=1_000_000)  # type: ignore[arg-type]

    def generate(self, rng: random.Random) -> list[bytes]:
        lines = [_line(rng) if rng.random() < 0.8 else rng.choice(_SETUP) for _ in range(4)]
        data = b"\r".join(lines) + b"\r"
        data = (
            mutated(rng, data, lines) if rng.random() < 0.8 else rng.randbytes(rng.randint(0, 99))
        )
        return pieces(rng, data)

    def check(self, item: list[bytes]) -> str:
        wire, adapter = self.wire, self.adapter
        adapter.reset()
        adapter.receive(b"O\r", 0.0)
        wire.sent.clear()
        for piece in item:
            adapter.receive(piece, 0.0)
        allowed = {_expected(line, stamps=False) for line in b"".join(item).split(b"\r")}
        answer = adapter.transmit(0.0)
        if len(answer) > OUTPUT_LIMIT:
            raise Broken("more output than the limit")
        if any(message not in allowed for message in wire.sent):
            raise Broken(f"sent {wire.sent}")
        return "whole lines only" if wire.sent else "refused"


TARGETS = (
    Target(
        name="slcan-host",
        parser="tactile.can_bus.BulkSlcanBus",
        inputs="lines of an adapter, damaged or made of the alphabet, over a pseudo-terminal",
        make=HostTrial,
    ),
    Target(
        name="slcan-adapter",
        parser="simulator.slcan",
        inputs="commands and messages of a client, damaged, cut into pieces",
        make=AdapterTrial,
    ),
)

"""A serial CAN adapter: the LAWICEL (slcan) ASCII protocol for the simulated bus.

Written from the manual of the LAWICEL CANUSB: open, close, bit rate, messages, version, flags.
Commands end with CR; CR acknowledges, BEL refuses.
The adapter has no loop and no port: bytes in, bytes out, time as an argument.
"""

import re

import can

from simulator.can.link import CanLink

BIT_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rate by the digit of the command S."""

_OK, _REFUSED = b"\r", b"\a"
_VERSION = b"V1013\r"
"""Answer to V: hardware version 1.0, software version 1.3."""
_FLAG_PASSIVE = 0x20
"""Bit of the answer to F."""
_MESSAGE = re.compile("t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")
"""A message: identifier of 11 bits, number of data bytes, and each as two digits. The devices here
take no identifiers of 29 bits and no requests (RTR), which the adapter refuses."""


class SlcanAdapter:
    """The adapter between a serial line and the bus, at first with the bit rate of the bus."""

    def __init__(self, link: CanLink) -> None:
        self.baudrate = 0
        """Line rate set by the client; a USB device ignores it."""
        self._link = link
        self._chosen = link.bitrate
        self._input = bytearray()
        self._output = bytearray()
        self._open = False

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Take bytes of the client and carry out the commands that are complete.

        Parameters
        ----------
        sent_after_s
            Earliest time in s at which the client may have sent them, if the exact time is not
            known; None: ``now_s``. Each command is taken at that time, or when the wire is free
            again, at the latest now. So the burst of one SYNC ends before the next SYNC, unless the
            client sent them closer together; also after a stall of the simulator.
        """
        self._input += data
        *lines, rest = self._input.split(b"\r")
        self._input = rest
        at_s = now_s if sent_after_s is None else min(sent_after_s, now_s)
        for line in filter(None, lines):
            at_s = max(at_s, min(now_s, self._link.free_s(at_s)))
            self._output += self._command(line, at_s)

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes for the client until ``now_s`` s."""
        messages = self._link.take(now_s)
        if self._open and self._chosen == self._link.bitrate:
            self._output += b"".join(_text(msg) for msg in messages if not msg.is_error_frame)
        output = bytes(self._output)
        self._output.clear()
        return output

    @property
    def unplugged(self) -> bool:
        """Whether the adapter is gone."""
        return self._link.faults.unplugged

    def next_event_s(self) -> float:
        """Return the earliest time of the next bytes for the client; infinity: never."""
        return self._link.next_event_s()

    def drop_pending(self) -> None:
        """Lose power: channel closed, nothing waits."""
        self._input.clear()
        self._output.clear()
        self._link.clear()
        self._open = False
        self._chosen = self._link.bitrate

    def _command(self, line: bytes | bytearray, now_s: float) -> bytes:
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            return _REFUSED
        name, rest = text[0], text[1:]
        if name == "t":
            return self._send(text, now_s)
        if name == "S" and len(rest) == 1 and "0" <= rest <= "8" and not self._open:
            self._chosen = BIT_RATES[int(rest)]
            return _OK
        if name in "OC" and not rest and self._open == (name == "C"):
            self._open = not self._open
            self._link.clear(now_s)
            return _OK
        if name == "F" and not rest and self._open:
            return b"F%02X\r" % (_FLAG_PASSIVE if self._link.faults.error_passive else 0)
        return _VERSION if text == "V" else _REFUSED

    def _send(self, text: str, now_s: float) -> bytes:
        match = _MESSAGE.fullmatch(text)
        if match is None or not self._open:
            return _REFUSED
        data = bytes.fromhex(match[3])
        if len(data) != int(match[2]):
            return _REFUSED
        if self._chosen == self._link.bitrate:
            try:
                self._link.send(int(match[1], 16), data, now_s)
            except can.CanOperationError:
                return _REFUSED
        return b"z\r"


def _text(message: can.Message) -> bytes:
    content = message.data.hex().upper().encode("ascii")
    return b"t%03X%d" % (message.arbitration_id, message.dlc) + content + b"\r"

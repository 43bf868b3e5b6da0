"""Transactions on a servo line: requests, checks of answers, and errors.

`gripper.dynamixel.bus.ServoBus` carries them out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gripper.dynamixel.protocol2 import Instruction, StatusPacket
from gripper.errors import AnswersOff, BusCorrupt, BusTimeout, LimitExceeded, ServoRejected

BROADCAST_ID = 0xFE
"""ID that all servos listen to (e-Manual, Protocol 2.0, "Packet ID")."""
HIGHEST_ID = 252
"""Highest ID of a servo (e-Manual, Protocol 2.0, "Packet ID")."""
PING_SIZE = 3
"""Bytes of data in the answer to a ping: Model Number (2) and Firmware Version (1)."""

_CRC_REFUSED = 3
"""Error number of a servo that received a damaged request (e-Manual, "Error": CRC)."""
_HEARD_BYTES = 16
"""Received bytes that an error shows: a header and what follows it."""
_PRINTABLE = frozenset(range(0x20, 0x7F)) | {0x0A, 0x0D}
"""Bytes of a text line: a device that sends text, as a GPS receiver, is known by its words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusStatistics:
    """Counts since the bus was opened."""

    transactions: int = 0
    """Transactions asked for."""
    retries: int = 0
    """Requests sent a second time."""
    timeouts: int = 0
    """Answers that did not come in time."""
    corrupt: int = 0
    """Answers that came damaged, or behind bytes that are none."""
    late: int = 0
    """Answers to an earlier request, or of another servo; dropped."""


class Request(NamedTuple):
    """A request to one servo."""

    servo_id: int
    instruction: Instruction
    """Who is asked, and for what."""
    size: int
    """Bytes of data in the right answer."""
    action: str
    """Name of the request in error messages."""
    params: bytes = b""
    """Parameters of the instruction packet, unstuffed."""


class Heard:
    """Invalid data since the last correct answer, for error messages."""

    def __init__(self) -> None:
        self._bytes = self._packets = 0
        self._head = b""

    def __bool__(self) -> bool:
        return self._bytes + self._packets > 0

    def __str__(self) -> str:
        parts = []
        if self._packets:
            parts.append(f"{self._packets} whole packets that answer no request")
        if self._bytes:
            text = f" ({self._head!r})" if _PRINTABLE.issuperset(self._head) else ""
            parts.append(
                f"{self._bytes} bytes that are no packet, the first are {self._head.hex(' ')}{text}"
            )
        return f"received were {' and '.join(parts) or 'no bytes'}"

    def add(self, dropped: bytes) -> None:
        """Add bytes that are no packet."""
        self._bytes += len(dropped)
        self._head = (self._head + dropped)[:_HEARD_BYTES]

    def add_packet(self) -> None:
        """Count a packet that answers no request."""
        self._packets += 1

    def forget(self) -> None:
        """Begin anew: a right answer came."""
        self._bytes = self._packets = 0
        self._head = b""


class NoAnswerError(Exception):
    """No correct answer within the time-out; `ServoBus` converts it into a typed error."""

    def __init__(self, damaged: bool) -> None:
        super().__init__(damaged)
        self.damaged = damaged
        """True when other data than the answer came."""


def ping_request(servo_id: int) -> Request:
    """Return the request of a ping."""
    return Request(servo_id, Instruction.PING, PING_SIZE, f"ping of servo {servo_id}")


def protocol_1_text(ids: Sequence[int]) -> str:
    """Return the hint for servos that answer in Protocol 1.0."""
    return (
        f"answers in Protocol 1.0 come from servo {', '.join(map(str, ids))}: set Protocol Type "
        f"(register 13) to 2 with the servo maker's wizard"
    )


def check_id(servo_id: int) -> None:
    """Raise LimitExceeded where no servo can have an ID."""
    if not 0 <= servo_id <= HIGHEST_ID:
        raise LimitExceeded(f"servo ID {servo_id} is not from 0 to {HIGHEST_ID}")


def checked(status: StatusPacket, action: str) -> StatusPacket:
    """Return an answer; raise ServoRejected where the servo has refused the action."""
    if status.error:
        raise ServoRejected(status.servo_id, status.error, action)
    return status


def accepted(status: StatusPacket) -> StatusPacket:
    """Return an answer; raise NoAnswerError where the servo received the request damaged."""
    if status.error == _CRC_REFUSED:
        raise NoAnswerError(damaged=True)
    return status


def given_up(
    failure: NoAnswerError, request: Request, heard: Heard, *, pinged: bool
) -> BusTimeout | BusCorrupt:
    """Return the error of a servo that is not asked again.

    ``pinged``: whether it has answered each ping between its requests.
    """
    if failure.damaged:
        received = f" ({heard})" if heard else ""
        return BusCorrupt(
            f"{request.action}: the answers of servo {request.servo_id} arrive damaged, twice in a "
            f"row{received}: check cable, termination and that no two servos share the ID"
        )
    if pinged:
        return AnswersOff(
            f"{request.action}: no answer of servo {request.servo_id}, although it answers pings: "
            f"its Status Return Level (register 68) is below 2. A start or a release sets it to 2, "
            f"and so does switching its supply off and on"
        )
    return BusTimeout(
        f"{request.action}: no answer of servo {request.servo_id}, twice in a row: check its "
        f"supply, cable, ID and baud rate"
    )

"""Servo bus: typed, checked transactions in DYNAMIXEL Protocol 2.0, and retries of lost answers.

Every status packet is checked: CRC, sender, length of its data, error number and Alert bit. A
transaction returns the requested values or raises; it never returns a value that no servo has sent.

Late answers are the danger of a bus without sequence numbers: one may be taken for the answer to
the next request. A servo answers in the order of its requests, so an answered ping shows that no
older answer of this servo is pending.
"""

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from gripper import errors
from gripper.clock import Clock
from gripper.dynamixel import control_table as ct
from gripper.dynamixel.models import ram_shift
from gripper.dynamixel.protocol2 import (
    STATUS_OVERHEAD,
    CheckedPacketHandler,
    Instruction,
    StatusPacket,
)
from gripper.dynamixel.serial_port import ByteStream, SdkPort

BROADCAST_ID = 0xFE
"""ID that all servos listen to (e-Manual, Protocol 2.0, "Packet ID")."""
HIGHEST_ID = 252
"""Highest ID of a servo (e-Manual, Protocol 2.0, "Packet ID")."""
PING_SIZE = 3
"""Bytes of data in the answer to a ping: Model Number (2) and Firmware Version (1)."""

_COLLISION_READS = 3
"""Readings of a servo's state that show whether a second servo answers to the same ID."""
ANSWERS_ALL = 2
"""Content of Status Return Level (register 68) at which a servo answers each request. At 1 it
answers pings and reads, at 0 pings only."""
_REPETITIONS = 3
"""How often a lost answer is requested again between commands: a servo may be slow once."""
_ALL_SILENT_MISSES = 3
"""Lost answers in a row, of each requested servo, before a sync read waits for a quiet line."""
_LATE_GUARD_S = 0.05
"""Quiet time in s after which no late answer is expected."""
_LONGEST_QUIET_WAIT = 10.0
"""Longest wait for a quiet line, in multiples of `_LATE_GUARD_S`: longer than all pending answers
take, so that only a line that never becomes quiet reaches it."""
_SLOT_S = 0.003
"""Time in s that a servo may take for its answer to a broadcast ping, for each ID."""
_CRC_REFUSED = 3
"""Error number of a servo that received a damaged request (e-Manual, "Error": CRC)."""
_HEAD_BYTES = 16
"""Received bytes that an error shows: a header and what follows it."""
_PRINTABLE = frozenset(range(0x20, 0x7F)) | {0x0A, 0x0D}
"""Bytes of a text line: a device that sends text, as a GPS receiver, is known by its words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoIdentity:
    """Answer to a ping: Model Number (register 0) and Firmware Version (register 6)."""

    servo_id: int
    model_number: int
    firmware: int


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


class _Request(NamedTuple):
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


@dataclass(slots=True)
class _StrayData:
    """Invalid data since the last correct answer, for error messages."""

    n_bytes: int = 0
    head: bytes = b""
    """Bytes that are no packet: their number, and the first ones."""
    n_packets: int = 0
    """Whole packets that answer no request."""

    def __str__(self) -> str:
        parts = []
        if self.n_packets:
            parts.append(f"{self.n_packets} whole packets that answer no request")
        if self.n_bytes:
            text = f" ({self.head!r})" if _PRINTABLE.issuperset(self.head) else ""
            parts.append(
                f"{self.n_bytes} bytes that are no packet, the first are {self.head.hex(' ')}{text}"
            )
        return f"received were {' and '.join(parts) or 'no bytes'}"

    def add(self, dropped: bytes) -> None:
        """Add bytes that are no packet."""
        self.n_bytes += len(dropped)
        self.head = (self.head + dropped)[:_HEAD_BYTES]


class _NoAnswerError(Exception):
    """No correct answer within the time-out; `ServoBus` converts it into a typed error."""

    def __init__(self, damaged: bool) -> None:
        super().__init__(damaged)
        self.damaged = damaged
        """True when other data than the answer came."""


class ServoBus:
    """Transactions with servos on one line, from one thread.

    A lost answer is requested again after a ping: once within `in_loop`, up to three times with
    longer waits outside of it. A late answer is never taken for a new one.

    The line is CLEAN, OWING (inside a transaction whose answer is missing) or SUSPECT:

    ======= ======================================= ======= ======================================
    state   event                                   next    action
    ======= ======================================= ======= ======================================
    CLEAN   answer lost, damaged or refused (CRC)   OWING   ping, then ask again
    OWING   ping answered                           CLEAN   nothing older is outstanding
    OWING   all repetitions lost                    SUSPECT BusTimeout or BusCorrupt
    any     `expect_late_answer`                    SUSPECT none
    SUSPECT next one between commands               CLEAN   wait until the line is quiet
    SUSPECT the same, where it never falls quiet    SUSPECT BusCorrupt, BusTimeout
    SUSPECT request to one servo in the loop        SUSPECT ping before the request
    SUSPECT sync read in the loop, sync write       SUSPECT none
    SUSPECT ``_LATE_GUARD_S`` passed                CLEAN   none
    ======= ======================================= ======= ======================================

    Each wait is bounded: for an answer by the time-out of the packet or ``_LATE_GUARD_S``, for a
    quiet line by ten times that. The loop does not wait for a quiet line: it drops received bytes,
    and the transaction fails until the line was quiet for ``_LATE_GUARD_S``.

    Parameters
    ----------
    period_s
        Period of the loop that uses the bus in s: `sync_read` ends within it, retry included.
    allowance_s
        Time for adapter and operating system in s.
    name
        Name of the line in error messages.
    ram_shifts
        `ServoModel.ram_shift` by servo ID, where it is known before a servo was pinged.
    """

    def __init__(
        self,
        stream: ByteStream,
        *,
        baudrate: int,
        clock: Clock,
        period_s: float = 0.005,
        allowance_s: float = 0.0015,
        name: str = "the servo line",
        ram_shifts: Mapping[int, int] | None = None,
    ) -> None:
        self.alerts: set[int] = set()
        """IDs of the servos whose last answer had the Alert bit: register 70 is not zero."""
        self.misses = Counter[int]()
        """How many answers of each servo were lost in a row, by its ID."""
        self.baudrate = baudrate
        self.port = SdkPort(stream, clock, baudrate=baudrate, allowance_s=allowance_s)
        """The line, with its time-outs."""
        self._name = name
        self._clock = clock
        self._period_s = period_s
        self._handler = CheckedPacketHandler()
        self.patient = True
        """Whether ping and repetition wait 50 ms for their answers, and all wait for a quiet
        line; else no transaction takes longer than a period allows, see `in_loop`."""
        self._suspect_since_s: float | None = None
        self._quiet_since_s: float | None = None
        self._outstanding = 0
        self._stray = _StrayData()
        self._last_error: errors.BusTimeout | errors.BusCorrupt | None = None
        self._ram_shifts = dict(ram_shifts or {})
        self._counts = dict.fromkeys(BusStatistics.__slots__, 0)
        self._closed = False

    @property
    def statistics(self) -> BusStatistics:
        """Counts since the bus was opened."""
        return BusStatistics(**self._counts)

    def in_loop(self) -> "_InLoop":
        """Limit each transaction in the block to the time that a period of the loop allows.

        Outside the block a retry waits for ``_LATE_GUARD_S``: at a start or between commands a slow
        answer is no fault. Within it a sync read does not wait for a quiet line: its caller also
        reads Realtime Tick (register 120), which shows an old answer.
        """
        return _InLoop(self)

    def ping(self, servo_id: int) -> ServoIdentity:
        """Read the identity of a servo; raises BusTimeout if no servo has this ID."""
        return self._identity(self._ask(_ping_request(servo_id)))

    def scan_at_once(self) -> tuple[tuple[ServoIdentity, ...], bool]:
        """Ping all IDs with one broadcast; return the servos, and whether damaged bytes came.

        Takes about a second. Damaged bytes are of servos that share an ID, or of another device;
        equal servos that share an ID may look like one, see `shares_id`. Servos answer one after
        the other, in the order of their IDs; the wait is that of the vendor's SDK
        (`Protocol2PacketHandler.broadcastPing`).
        """
        answers: list[ServoIdentity] = []
        damaged = False
        self._begin()
        self._handler.send(self.port, BROADCAST_ID, Instruction.PING, b"")
        wire_s = 10.0 / self.baudrate * (STATUS_OVERHEAD + PING_SIZE) * (HIGHEST_ID + 1)
        self.port.start_timeout(wire_s + _SLOT_S * HIGHEST_ID + self.port.allowance_s)
        while (status := self._handler.receive(self.port)) is not None:
            damaged |= bool(self._handler.dropped) or len(status.data) != PING_SIZE
            if len(status.data) == PING_SIZE:
                answers.append(self._identity(status))
        damaged |= bool(self._handler.dropped)
        self._mark_suspect()
        return tuple(dict.fromkeys(answers)), damaged  # an answer may come twice

    def shares_id(self, servo_id: int) -> bool:
        """Return whether several servos answer to one ID.

        Each servo reports its own time, position and voltage: their answers damage each other, or
        the adapter receives no bytes. One answer may be lost by chance. Equal servos report one
        Model Number (register 0); a servo that answers no read does not.
        """
        request, lost = self._reading(servo_id, ct.PRESENT_BLOCK), 0
        for _ in range(_COLLISION_READS):
            try:
                _checked(self._ask_once(request)[0], request.action)
            except errors.BusCorrupt:
                return True
            except errors.BusTimeout:
                lost += 1
        return lost == _COLLISION_READS and not self.answers_off(servo_id)

    def answers_off(self, servo_id: int) -> bool:
        """Return whether a servo answers pings but no read: Status Return Level (68) is 0."""
        try:
            self.read(servo_id, ct.MODEL_NUMBER)
        except (errors.BusTimeout, errors.BusCorrupt) as error:
            return isinstance(error, errors.AnswersOff)
        return False

    def demand_answers(self, ids: Sequence[int]) -> None:
        """Set Status Return Level (register 68) to 2, at which servos answer each request.

        At a lower level a servo does not confirm the write, so that no answer is awaited. The item
        is in the RAM: it can be written with torque.
        """
        for servo_id in ids:
            self.sync_write({servo_id: (ANSWERS_ALL,)}, ct.RegisterBlock(ct.STATUS_RETURN_LEVEL))

    def round_trip_s(self, servo_id: int) -> float:
        """Return the round-trip time of a ping in s, also for a late answer."""
        return self._ask_once(_ping_request(servo_id), patient=True)[1]

    def read(self, servo_id: int, register: ct.Register) -> int:
        """Return the raw value of an item, sign-extended."""
        return register.decode(self._ask(self._reading(servo_id, register)).data)

    def write(self, servo_id: int, register: ct.Register, raw: int) -> None:
        """Write the raw value of an item and wait for the servo's confirmation.

        Raises
        ------
        LimitExceeded
            When the item is read-only or the value does not fit.
        ServoRejected
            When the servo refuses, for example EEPROM with torque on (error 7).
        """
        if not register.writable:
            raise errors.LimitExceeded(f"{register.name} is read-only")
        action = f"writing {register} = {raw} to servo {servo_id}"
        params = _words(self._address([servo_id], register)) + register.encode(raw)
        self._ask(_Request(servo_id, Instruction.WRITE, 0, action, params))

    def sync_read(self, ids: Sequence[int], block: ct.RegisterBlock) -> dict[int, dict[str, int]]:
        """Return the items of one block of several servos as raw values by name.

        A servo whose answer is missing is asked alone, within `in_loop` only as the period allows.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is still missing; then nothing is returned.
        """
        action, size = f"reading {block} of servos {ids}", block.size
        params = _words(self._address(ids, block), size)
        if not self.patient:
            # A silent servo must not hide one that answers.
            ids = sorted(ids, key=self.misses.__getitem__)
        # Requests must not accumulate at a slow machine.
        all_silent = min(map(self.misses.__getitem__, ids)) >= _ALL_SILENT_MISSES
        answers: dict[int, StatusPacket] = {}
        self._begin(quiet=self.patient or all_silent)
        deadline_s = None if self.patient else self._clock.monotonic() + self._period_s
        self._handler.send(self.port, BROADCAST_ID, Instruction.SYNC_READ, params + bytes(ids))
        try:
            for servo_id in ids:
                answers[servo_id] = _accepted(self._receive(servo_id, size))
        except _NoAnswerError as failure:
            # The servos answer one after the other: after a missing answer no other follows.
            for servo_id in ids[len(answers) :]:
                request = _Request(servo_id, Instruction.READ, size, action, params)
                answers[servo_id] = self._retry(request, failure, deadline_s)
        return {i: block.decode(_checked(status, action).data) for i, status in answers.items()}

    def sync_write(self, values: Mapping[int, Sequence[int]], block: ct.RegisterBlock) -> None:
        """Write the items of one block to several servos at once.

        Servos do not confirm a sync write: the caller reads back critical values.

        Parameters
        ----------
        values
            Raw value of each item, by servo ID.
        """
        params = _words(self._address(list(values), block), block.size)
        for servo_id, raws in values.items():
            params += bytes((servo_id,)) + block.encode(raws)
        # No servo answers: a late answer does no harm.
        self._begin(quiet=False)
        self._handler.send(self.port, BROADCAST_ID, Instruction.SYNC_WRITE, params)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque off, RAM at its defaults; it lets a held part go.

        Sent only once, because a repetition would restart it again.
        """
        request = _Request(servo_id, Instruction.REBOOT, 0, f"reboot of servo {servo_id}")
        status, _ = self._ask_once(request)
        self.alerts.discard(servo_id)
        _checked(status, request.action)

    def expect_late_answer(self) -> None:
        """Make the next transaction wait for a quiet line, after an unexpected answer."""
        self._mark_suspect()
        self._outstanding += 1

    def close(self) -> None:
        """Close the line; the servos keep their last goals, and transactions raise PortLost."""
        self._closed = True
        self.port.close()

    def _begin(self, *, quiet: bool = True) -> None:
        """Begin a transaction; ``quiet``: after a suspect line has become quiet.

        Raises PortLost after `close`, and BusCorrupt when the line never becomes quiet.
        """
        if self._closed:
            raise errors.PortLost("the servo bus is closed: open it again")
        # The SDK keeps it after a request without an answer.
        self.port.is_using = False
        self._counts["transactions"] += 1
        if self._suspect_since_s is None:
            return
        if quiet:
            self._wait_until_quiet()
        elif self._clock.monotonic() - self._suspect_since_s > _LATE_GUARD_S:
            self._mark_clean()

    def _address(self, ids: Sequence[int], what: ct.Register | ct.RegisterBlock) -> int:
        """Return the address of an item or a block in the control tables of servos."""
        for servo_id in ids:
            _check_id(servo_id)
        shifts = {self._ram_shifts.get(servo_id, 0) for servo_id in ids}
        if what.address < ct.RAM_START:
            return what.address
        if len(shifts) != 1:
            raise errors.LimitExceeded(
                f"servos {ids} have {what} at different addresses: put models with different "
                "control tables on separate lines"
            )
        return what.address + shifts.pop()

    def _reading(self, servo_id: int, what: ct.Register | ct.RegisterBlock) -> _Request:
        params = _words(self._address([servo_id], what), what.size)
        action = f"reading {what} of servo {servo_id}"
        return _Request(servo_id, Instruction.READ, what.size, action, params)

    def _identity(self, status: StatusPacket) -> ServoIdentity:
        number = int.from_bytes(status.data[:2], "little")
        self._ram_shifts[status.servo_id] = ram_shift(number)
        return ServoIdentity(servo_id=status.servo_id, model_number=number, firmware=status.data[2])

    def _ask(self, request: _Request) -> StatusPacket:
        """Send a request and return the checked answer; repeat it when the answer is lost.

        Raises BusTimeout or BusCorrupt when no repetition was answered, or the line did not become
        quiet. Raises ServoRejected when the servo refuses.
        """
        _check_id(request.servo_id)
        self._begin(quiet=self.patient)
        try:
            if self._suspect_since_s is not None and not self.patient:
                self._ping(request.servo_id)
            status = _accepted(self._exchange(request))
        except _NoAnswerError as failure:
            status = self._retry(request, failure)
        return _checked(status, request.action)

    def _ask_once(self, request: _Request, *, patient: bool = False) -> tuple[StatusPacket, float]:
        """Send a request that is never repeated; return the answer and the time in s it took."""
        _check_id(request.servo_id)
        self._begin()
        sent_s = self._clock.monotonic()
        try:
            status = self._exchange(request, patient=patient)
        except _NoAnswerError as failure:
            raise self._given_up(failure, request) from None
        return status, self._clock.monotonic() - sent_s

    def _mark_suspect(self) -> None:
        self._suspect_since_s = self._clock.monotonic()
        self._quiet_since_s = None

    def _mark_clean(self) -> None:
        self._suspect_since_s = None
        self._outstanding = 0

    def _retry(
        self, request: _Request, failure: _NoAnswerError, deadline_s: float | None = None
    ) -> StatusPacket:
        """Repeat a request after a ping, in the loop once; raise without an answer."""
        pings, repetitions = 0, _REPETITIONS if self.patient else 1
        for _ in range(repetitions):
            with suppress(_NoAnswerError):
                self._ping(request.servo_id, deadline_s)
                pings += 1
                self._counts["retries"] += 1
                return _accepted(self._exchange(request, patient=self.patient))
        # In the loop, with one repetition, noise does the same.
        pinged = self.patient and pings == repetitions
        raise self._given_up(failure, request, pinged=pinged) from None

    def _given_up(
        self, failure: _NoAnswerError, request: _Request, *, pinged: bool = False
    ) -> errors.BusTimeout | errors.BusCorrupt:
        """Return the error of a servo without an answer; the line is now suspect.

        ``pinged``: whether the servo has answered each ping between its requests.
        """
        self._mark_suspect()
        if failure.damaged:
            received = f" ({self._stray})" if self._stray != _StrayData() else ""
            error: errors.BusTimeout | errors.BusCorrupt = errors.BusCorrupt(
                f"{request.action}: the answers of servo {request.servo_id} arrive "
                f"damaged{received}: check cable, termination and that no two servos share the ID"
            )
        elif pinged:
            error = errors.AnswersOff(
                f"{request.action}: no answer of servo {request.servo_id}, although it answers "
                f"pings: its Status Return Level (register 68) is below 2. A start or a release "
                f"sets it to 2, and so does switching its supply off and on"
            )
        else:
            error = errors.BusTimeout(
                f"{request.action}: no answer of servo {request.servo_id}: check its supply, "
                f"cable, ID and baud rate"
            )
        self._last_error = error
        return error

    def _ping(self, servo_id: int, deadline_s: float | None = None) -> None:
        """Ping a servo, so that no earlier answer of it is pending.

        The answer to a ping with a long wait may be an earlier one: then wait for a quiet line.
        """
        if deadline_s is not None and self._clock.monotonic() >= deadline_s:
            raise _NoAnswerError(damaged=False)
        self._exchange(_ping_request(servo_id), patient=self.patient)
        if self.patient and self._outstanding > 0:
            self._wait_until_quiet()
        self._outstanding = 0

    def _exchange(self, request: _Request, *, patient: bool = False) -> StatusPacket:
        self._handler.send(self.port, request.servo_id, request.instruction, request.params)
        return self._receive(request.servo_id, request.size, patient=patient)

    def _receive(self, servo_id: int, size: int, *, patient: bool = False) -> StatusPacket:
        """Return the next correct answer; drop damaged, late and foreign ones."""
        if patient:
            self.port.start_timeout(_LATE_GUARD_S)
        else:
            self.port.setPacketTimeout(STATUS_OVERHEAD + size)
        damaged = short = False
        while True:
            status = self._handler.receive(self.port)
            self._stray.add(self._handler.dropped)
            damaged |= bool(self._handler.dropped)
            if status is None:
                self._outstanding += 1
                self.misses[servo_id] += 1
                self._counts["corrupt" if damaged or short else "timeouts"] += 1
                raise _NoAnswerError(damaged or short)
            # A refusal has no data; any other length is an answer to an earlier request.
            earlier = status.error == 0 and len(status.data) != size
            if status.servo_id == servo_id and not earlier:
                self._counts["corrupt"] += damaged
                self.misses[servo_id] = 0
                self._stray = _StrayData()
                (self.alerts.add if status.alert else self.alerts.discard)(servo_id)
                return status
            if status.servo_id == servo_id:
                short = True
                self._outstanding = max(0, self._outstanding - 1)
            self._counts["late"] += 1
            self._stray.n_packets += 1

    def _wait_until_quiet(self) -> None:
        """Drop late answers until all came or the line was quiet for ``_LATE_GUARD_S``.

        Raises
        ------
        BusCorrupt
            When bytes still come after ten times ``_LATE_GUARD_S``; in the loop when they do now.
        BusTimeout
            In the loop, while late answers of silent servos may still come.
        """
        now_s = self._clock.monotonic()
        if self._quiet_since_s is None:
            self._quiet_since_s = now_s
        patience_s = _LONGEST_QUIET_WAIT * _LATE_GUARD_S if self.patient else 0.0
        deadline_s = now_s + patience_s
        while self._outstanding > 0:
            left_s = self._quiet_since_s + _LATE_GUARD_S - now_s
            if left_s <= 0.0:
                break
            # Noise counts from when it came: a held part's watchdog allows no second guard time.
            wait_s = min(left_s, self._period_s, max(0.0, deadline_s - now_s))
            self.port.start_timeout(wait_s)
            status = self._handler.receive(self.port)
            self._stray.add(self._handler.dropped)
            now_s = self._clock.monotonic()
            if status is not None:
                self._outstanding -= 1
                self._counts["late"] += 1
                self._stray.n_packets += 1
            if status is not None or self._handler.dropped:
                self._quiet_since_s = now_s
            if self._outstanding > 0 and now_s >= deadline_s:
                self._suspect_since_s = now_s
                raise self._not_quiet(patience_s)
        self._quiet_since_s = None
        self._mark_clean()

    def _not_quiet(self, patience_s: float) -> errors.BusTimeout | errors.BusCorrupt:
        if self._stray == _StrayData() and self._last_error is not None:
            return type(self._last_error)(*self._last_error.args)
        within = f"within {patience_s:.2g} s" if patience_s else "yet"
        return errors.BusCorrupt(
            f"{self._name} did not become quiet {within}: {self._stray}. Another program or device "
            f"sends on the line, or it picks up noise: disconnect other hosts, check cable, "
            f"ground, termination and baud rate"
        )


class _InLoop:
    """Transactions of a period; a generator would cost more in each."""

    def __init__(self, bus: ServoBus) -> None:
        self._bus, self._before = bus, bus.patient

    def __enter__(self) -> None:
        self._bus.patient = False

    def __exit__(self, *_error: object) -> None:
        self._bus.patient = self._before


def _ping_request(servo_id: int) -> _Request:
    """Return the request of a ping."""
    return _Request(servo_id, Instruction.PING, PING_SIZE, f"ping of servo {servo_id}")


def _check_id(servo_id: int) -> None:
    """Raise LimitExceeded where no servo can have an ID."""
    if not 0 <= servo_id <= HIGHEST_ID:
        raise errors.LimitExceeded(f"servo ID {servo_id} is not from 0 to {HIGHEST_ID}")


def _checked(status: StatusPacket, action: str) -> StatusPacket:
    """Return an answer; raise ServoRejected where the servo has refused the action."""
    if status.error:
        raise errors.ServoRejected(status.servo_id, status.error, action)
    return status


def _accepted(status: StatusPacket) -> StatusPacket:
    """Return an answer; raise _NoAnswerError where the servo received the request damaged."""
    if status.error == _CRC_REFUSED:
        raise _NoAnswerError(damaged=True)
    return status


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}H", *values)

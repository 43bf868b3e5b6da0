"""Servo bus: typed, checked transactions in DYNAMIXEL Protocol 2.0, and retries of lost answers.

Every status packet is checked: CRC, sender, length of its data, error number and Alert bit. A
transaction returns the requested values or raises; it never returns a value that no servo has sent.

Late answers are the danger of a bus without sequence numbers: one may be taken for the answer to
the next request. A servo answers in the order of its requests, so an answered ping shows that no
older answer of this servo is pending.
"""

import struct
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler

from gripper.clock import Clock
from gripper.dynamixel.control_table import (
    MODEL_NUMBER,
    PRESENT_BLOCK,
    RAM_START,
    STATUS_RETURN_LEVEL,
    Register,
    RegisterBlock,
)
from gripper.dynamixel.models import ram_shift
from gripper.dynamixel.protocol2 import (
    STATUS_OVERHEAD,
    CheckedPacketHandler,
    Instruction,
    StatusPacket,
)
from gripper.dynamixel.serial_port import ByteStream, SdkPort
from gripper.dynamixel.transactions import (
    BROADCAST_ID,
    HIGHEST_ID,
    PING_SIZE,
    BusStatistics,
    Heard,
    NoAnswerError,
    Request,
    accepted,
    check_id,
    checked,
    given_up,
    ping_request,
)
from gripper.errors import (
    AnswersOff,
    BusBusy,
    BusCorrupt,
    BusTimeout,
    LimitExceeded,
    PortLost,
)

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoIdentity:
    """Answer to a ping: Model Number (register 0) and Firmware Version (register 6)."""

    servo_id: int
    model_number: int
    firmware: int


class ServoBus:
    """Transactions with servos on one line; safe to use from several threads.

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
    lock_timeout_s
        Longest wait in s for another thread's transaction.
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
        lock_timeout_s: float = 1.0,
        name: str = "the servo line",
        ram_shifts: Mapping[int, int] | None = None,
    ) -> None:
        self.alerts: set[int] = set()
        """IDs of the servos whose last answer had the Alert bit."""
        self.misses = Counter[int]()
        """How many answers of each servo were lost in a row, by its ID."""
        self.baudrate = baudrate
        self._least_allowance_s = allowance_s
        self.port = SdkPort(stream, clock, baudrate=baudrate, allowance_s=allowance_s)
        """The line, with its time-outs."""
        self._name = name
        self._clock = clock
        self._period_s = period_s
        self._lock_timeout_s = lock_timeout_s
        self._handler = CheckedPacketHandler()
        self.patient = True
        """Whether ping and repetition wait 50 ms for their answers, and all wait for a quiet
        line; else no transaction takes longer than a period allows, see `in_loop`."""
        self._suspect = False
        self._suspect_since_s = 0.0
        self._quiet_since_s: float | None = None
        self._outstanding = 0
        self._heard = Heard()
        self._last_error: BusTimeout | BusCorrupt | None = None
        self._ram_shifts = dict(ram_shifts or {})
        self._counts = dict.fromkeys(BusStatistics.__slots__, 0)
        self._lock = threading.RLock()
        self._closed = False

    @property
    def lost(self) -> bool:
        """Whether the line has failed since it was opened; then call `use` with a new one."""
        return self.port.lost

    def use(self, stream: ByteStream) -> None:
        """Continue with a reopened line."""
        self.port.use(stream)

    def fit_allowance(self, wanted_s: float, most_s: float) -> None:
        """Set the time for adapter and operating system in a time-out; never below the usual."""
        self.port.allowance_s = max(self._least_allowance_s, min(wanted_s, most_s))

    @property
    def statistics(self) -> BusStatistics:
        """Counts since the bus was opened."""
        return BusStatistics(**self._counts)

    def in_loop(self) -> AbstractContextManager[None]:
        """Limit each transaction in the block to the time that a period of the loop allows.

        Outside the block a retry waits for ``_LATE_GUARD_S``: at a start or between commands a slow
        answer is no fault. Within it a sync read does not wait for a quiet line: its caller also
        reads Realtime Tick (register 120), which shows an old answer.
        """
        return _InLoop(self)

    def alert(self, servo_id: int) -> bool:
        """Return whether the last answer of a servo had the Alert bit: register 70 is not zero."""
        return servo_id in self.alerts

    def ping(self, servo_id: int) -> ServoIdentity:
        """Read the identity of a servo; raises BusTimeout if no servo has this ID."""
        return self._identity(self._ask(ping_request(servo_id)))

    def scan_at_once(self) -> tuple[tuple[ServoIdentity, ...], bool]:
        """Ping all IDs with one broadcast; return the servos, and whether damaged bytes came.

        Takes about a second. Damaged bytes are of servos that share an ID, or of another device;
        equal servos that share an ID may look like one, see `shares_id`. Servos answer one after
        the other, in the order of their IDs; the wait is that of the vendor's SDK
        (`Protocol2PacketHandler.broadcastPing`).
        """
        answers: list[ServoIdentity] = []
        damaged = False
        with self.exclusive():
            self._handler.send(self.port, BROADCAST_ID, Instruction.PING, b"")
            wire_s = 10.0 / self.baudrate * (STATUS_OVERHEAD + PING_SIZE) * (HIGHEST_ID + 1)
            slots_s = _SLOT_S * HIGHEST_ID
            self.port.start_timeout(wire_s + slots_s + self.port.allowance_s)
            while (status := self._handler.receive(self.port)) is not None:
                damaged |= bool(self._handler.dropped) or len(status.data) != PING_SIZE
                if len(status.data) == PING_SIZE:
                    answers.append(self._identity(status))
            damaged |= bool(self._handler.dropped)
            self._mark_suspect()
        return tuple(answers), damaged

    def scan_protocol_1(self, ids: Sequence[int] = range(HIGHEST_ID + 1)) -> tuple[int, ...]:
        """Ping each ID once in Protocol 1.0 and return the servos' IDs; for diagnosis."""
        answering, handler = [], Protocol1PacketHandler()
        with self.exclusive():
            for servo_id in ids:
                ping = [0, 0, servo_id, 2, int(Instruction.PING), 0]
                answer, result, _ = handler.txRxPacket(self.port, ping)
                # Not its echo.
                if result == COMM_SUCCESS and answer != ping:
                    answering.append(servo_id)
            self._mark_suspect()
        return tuple(answering)

    def shares_id(self, servo_id: int) -> bool:
        """Return whether several servos answer to one ID.

        Each servo reports its own time, position and voltage: their answers damage each other, or
        the adapter receives no bytes. One answer may be lost by chance. Equal servos report one
        Model Number (register 0); a servo that answers no read does not.
        """
        action = f"reading {PRESENT_BLOCK} of servo {servo_id}"
        params = _words(self._address(servo_id, PRESENT_BLOCK), PRESENT_BLOCK.size)
        request = Request(servo_id, Instruction.READ, PRESENT_BLOCK.size, action, params)
        lost = 0
        for _ in range(_COLLISION_READS):
            try:
                checked(self._ask_once(request)[0], action)
            except BusCorrupt:
                return True
            except BusTimeout:
                lost += 1
        return lost == _COLLISION_READS and not self.answers_off(servo_id)

    def answers_off(self, servo_id: int) -> bool:
        """Return whether a servo answers pings but no read: Status Return Level (68) is 0."""
        try:
            self.read(servo_id, MODEL_NUMBER)
        except AnswersOff:
            return True
        except (BusTimeout, BusCorrupt):
            return False
        return False

    def demand_answers(self, ids: Sequence[int]) -> None:
        """Set Status Return Level (register 68) to 2, at which servos answer each request.

        At a lower level a servo does not confirm the write, so that no answer is awaited. The item
        is in the RAM: it can be written with torque.
        """
        for servo_id in ids:
            self.sync_write({servo_id: (ANSWERS_ALL,)}, RegisterBlock(STATUS_RETURN_LEVEL))

    def round_trip_s(self, servo_id: int) -> float:
        """Return the round-trip time of a ping in s, also for a late answer."""
        return self._ask_once(ping_request(servo_id), patient=True)[1]

    def read(self, servo_id: int, register: Register) -> int:
        """Return the raw value of an item, sign-extended."""
        action = f"reading {register.name} of servo {servo_id}"
        params = _words(self._address(servo_id, register), register.size)
        request = Request(servo_id, Instruction.READ, register.size, action, params)
        return register.decode(self._ask(request).data)

    def write(self, servo_id: int, register: Register, raw: int) -> None:
        """Write the raw value of an item and wait for the servo's confirmation.

        Raises
        ------
        LimitExceeded
            When the item is read-only or the value does not fit.
        ServoRejected
            When the servo refuses, for example EEPROM with torque on (error 7).
        """
        if not register.writable:
            raise LimitExceeded(f"{register.name} is read-only")
        action = f"writing {register.name} = {raw} to servo {servo_id}"
        params = _words(self._address(servo_id, register)) + register.encode(raw)
        self._ask(Request(servo_id, Instruction.WRITE, 0, action, params))

    def sync_read(self, ids: Sequence[int], block: RegisterBlock) -> dict[int, dict[str, int]]:
        """Return the items of one block of several servos as raw values by name.

        A servo whose answer is missing is asked alone, within `in_loop` only as the period allows.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is still missing; then nothing is returned.
        """
        action = f"reading {block} of servos {ids}"
        params = _words(self._common_address(ids, block), block.size)
        answers = self._ask_all(ids, params, block.size, action)
        return {servo_id: block.decode(status.data) for servo_id, status in answers.items()}

    def sync_write(self, values: Mapping[int, Sequence[int]], block: RegisterBlock) -> None:
        """Write the items of one block to several servos at once.

        Servos do not confirm a sync write: the caller reads back critical values.

        Parameters
        ----------
        values
            Raw value of each item, by servo ID.
        """
        if not values:
            raise LimitExceeded("a sync write needs at least one servo")
        if not block.writable:
            raise LimitExceeded(f"{block}: not all are writable")
        params = _words(self._common_address(list(values), block), block.size)
        for servo_id, raws in values.items():
            params += bytes((servo_id,)) + block.encode(raws)
        # No servo answers: a late answer does no harm.
        self._begin(quiet=False)
        try:
            self._handler.send(self.port, BROADCAST_ID, Instruction.SYNC_WRITE, params)
        finally:
            self._end()

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque off, RAM at its defaults; it lets a held part go.

        Sent only once, because a repetition would restart it again.
        """
        request = Request(servo_id, Instruction.REBOOT, 0, f"reboot of servo {servo_id}")
        status, _ = self._ask_once(request)
        self.alerts.discard(servo_id)
        checked(status, request.action)

    def expect_late_answer(self) -> None:
        """Make the next transaction wait for a quiet line, after an unexpected answer."""
        self._mark_suspect()
        self._outstanding += 1

    def close(self) -> None:
        """Close the line; the servos keep their last goals, and transactions raise PortLost."""
        with self._lock:
            self._closed = True
            self.port.close()

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Hold the line for one transaction, after a suspect line has become quiet.

        Raises
        ------
        BusBusy
            When another thread holds the line for more than ``lock_timeout_s``.
        PortLost
            After `close`.
        BusCorrupt
            When the line never becomes quiet.
        """
        self._begin(quiet=True)
        try:
            yield
        finally:
            self._end()

    def _begin(self, *, quiet: bool) -> None:
        """Begin a transaction as `exclusive` does; ``quiet``: after a suspect line became quiet."""
        if not self._lock.acquire(timeout=self._lock_timeout_s):
            raise BusBusy(
                f"another thread holds the servo bus for more than {self._lock_timeout_s} s"
            )
        try:
            if self._closed:
                raise PortLost("the servo bus is closed: open it again")
            self._counts["transactions"] += 1
            if self._suspect and quiet:
                self._wait_until_quiet()
            elif self._suspect and self._clock.monotonic() - self._suspect_since_s > _LATE_GUARD_S:
                self._mark_clean()
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        self.port.is_using = False
        self._lock.release()

    def _address(self, servo_id: int, what: Register | RegisterBlock) -> int:
        """Return the address of an item or a block in the control table of a servo's model."""
        shift = self._ram_shifts.get(servo_id, 0) if what.address >= RAM_START else 0
        return what.address + shift

    def _common_address(self, ids: Sequence[int], block: RegisterBlock) -> int:
        for servo_id in ids:
            check_id(servo_id)
        addresses = {self._address(servo_id, block) for servo_id in ids}
        if len(addresses) != 1:
            raise LimitExceeded(
                f"servos {ids} have {block} at different addresses: put models with different "
                "control tables on separate lines"
            )
        return addresses.pop()

    def _identity(self, status: StatusPacket) -> ServoIdentity:
        number = int.from_bytes(status.data[:2], "little")
        self._ram_shifts[status.servo_id] = ram_shift(number)
        return ServoIdentity(servo_id=status.servo_id, model_number=number, firmware=status.data[2])

    def _ask(self, request: Request) -> StatusPacket:
        """Send a request and return the checked answer; repeat it when the answer is lost.

        Raises BusTimeout or BusCorrupt when no repetition was answered, or the line did not become
        quiet. Raises ServoRejected when the servo refuses.
        """
        check_id(request.servo_id)
        self._begin(quiet=self.patient)
        try:
            if self._suspect and not self.patient:
                self._ping(request.servo_id)
            status = accepted(self._exchange(request))
        except NoAnswerError as failure:
            status = self._retry(request, failure)
        finally:
            self._end()
        return checked(status, request.action)

    def _ask_all(
        self, ids: Sequence[int], params: bytes, size: int, action: str
    ) -> dict[int, StatusPacket]:
        """Ask several servos for the same block with one sync read; return the answers by ID.

        A servo that does not answer is asked alone. In the loop the servos are asked in the order
        of their lost answers, so that a silent one does not hide one that answers. Raises
        BusTimeout, BusCorrupt or ServoRejected as `_ask` does, for the first servo without a right
        answer.
        """
        if not self.patient:
            ids = sorted(ids, key=self.misses.__getitem__)
        # Requests must not accumulate at a slow machine.
        all_silent = min(map(self.misses.__getitem__, ids)) >= _ALL_SILENT_MISSES
        self._begin(quiet=self.patient or all_silent)
        try:
            deadline_s = None if self.patient else self._clock.monotonic() + self._period_s
            answers, failure = self._sync_read(ids, params, size)
            for servo_id in ids:
                if servo_id not in answers:
                    request = Request(servo_id, Instruction.READ, size, action, params)
                    answers[servo_id] = self._retry(request, failure, deadline_s)
        finally:
            self._end()
        return {servo_id: checked(answers[servo_id], action) for servo_id in ids}

    def _ask_once(self, request: Request, *, patient: bool = False) -> tuple[StatusPacket, float]:
        """Send a request that is never repeated; return the answer and the time in s it took."""
        check_id(request.servo_id)
        with self.exclusive():
            sent_s = self._clock.monotonic()
            try:
                status = self._exchange(request, patient=patient)
            except NoAnswerError as failure:
                raise self._given_up(failure, request) from None
            return status, self._clock.monotonic() - sent_s

    def _mark_suspect(self) -> None:
        self._suspect = True
        self._suspect_since_s = self._clock.monotonic()
        self._quiet_since_s = None

    def _mark_clean(self) -> None:
        self._suspect = False
        self._outstanding = 0

    def _retry(
        self, request: Request, failure: NoAnswerError, deadline_s: float | None = None
    ) -> StatusPacket:
        """Repeat a request after a ping, in the loop once; raise without an answer."""
        pings, repetitions = 0, _REPETITIONS if self.patient else 1
        for _ in range(repetitions):
            with suppress(NoAnswerError):
                self._ping(request.servo_id, deadline_s)
                pings += 1
                self._counts["retries"] += 1
                return accepted(self._exchange(request, patient=self.patient))
        # In the loop, with one repetition, noise does the same.
        pinged = self.patient and pings == repetitions
        raise self._given_up(failure, request, pinged=pinged) from None

    def _given_up(
        self, failure: NoAnswerError, request: Request, *, pinged: bool = False
    ) -> BusTimeout | BusCorrupt:
        """Return the error of a servo without an answer; the line is now suspect."""
        self._mark_suspect()
        self._last_error = given_up(failure, request, self._heard, pinged=pinged)
        return self._last_error

    def _ping(self, servo_id: int, deadline_s: float | None = None) -> None:
        """Ping a servo, so that no earlier answer of it is pending.

        The answer to a ping with a long wait may be an earlier one: then wait for a quiet line.
        """
        if deadline_s is not None and self._clock.monotonic() >= deadline_s:
            raise NoAnswerError(damaged=False)
        self._exchange(ping_request(servo_id), patient=self.patient)
        if self.patient and self._outstanding > 0:
            self._wait_until_quiet()
        self._outstanding = 0

    def _sync_read(
        self, ids: Sequence[int], params: bytes, size: int
    ) -> tuple[dict[int, StatusPacket], NoAnswerError]:
        """Send a sync read and collect the answers up to the first missing one.

        The servos answer one after the other: after a missing answer no other follows.
        """
        self._handler.send(self.port, BROADCAST_ID, Instruction.SYNC_READ, params + bytes(ids))
        answers: dict[int, StatusPacket] = {}
        try:
            for servo_id in ids:
                answers[servo_id] = accepted(self._receive(servo_id, size))
        except NoAnswerError as failure:
            return answers, failure
        return answers, NoAnswerError(damaged=False)

    def _exchange(self, request: Request, *, patient: bool = False) -> StatusPacket:
        self._handler.send(self.port, request.servo_id, request.instruction, request.params)
        return self._receive(request.servo_id, request.size, patient=patient)

    def _receive(self, servo_id: int, size: int, *, patient: bool = False) -> StatusPacket:
        """Return the next correct answer; drop damaged, late and foreign ones."""
        if patient:
            self.port.start_timeout(_LATE_GUARD_S)
        else:
            self.port.setPacketTimeout(STATUS_OVERHEAD + size)
        damaged = False
        while True:
            status = self._handler.receive(self.port)
            self._heard.add(self._handler.dropped)
            if status is None:
                self._outstanding += 1
                self.misses[servo_id] += 1
                damaged |= bool(self._handler.dropped)
                self._counts["corrupt" if damaged else "timeouts"] += 1
                raise NoAnswerError(damaged)
            if status.servo_id != servo_id:
                self._counts["late"] += 1
                self._heard.add_packet()
            elif status.error == 0 and len(status.data) != size:
                # A refusal has no data; any other length is an answer to an earlier request.
                damaged = True
                self._outstanding = max(0, self._outstanding - 1)
                self._counts["late"] += 1
                self._heard.add_packet()
            else:
                self._counts["corrupt"] += bool(self._handler.dropped)
                self.misses[servo_id] = 0
                self._heard.forget()
                (self.alerts.add if status.alert else self.alerts.discard)(servo_id)
                return status

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
            self.port.start_timeout(min(left_s, max(0.0, deadline_s - now_s)))
            status = self._handler.receive(self.port)
            self._heard.add(self._handler.dropped)
            now_s = self._clock.monotonic()
            if status is not None:
                self._outstanding -= 1
                self._counts["late"] += 1
                self._heard.add_packet()
            if status is not None or self._handler.dropped:
                self._quiet_since_s = now_s
            if self._outstanding > 0 and now_s >= deadline_s:
                self._suspect_since_s = now_s
                raise self._not_quiet(patience_s)
        self._quiet_since_s = None
        self._mark_clean()

    def _not_quiet(self, patience_s: float) -> BusTimeout | BusCorrupt:
        if not self._heard and self._last_error is not None:
            return type(self._last_error)(*self._last_error.args)
        within = f"within {patience_s:.2g} s" if patience_s else "yet"
        return BusCorrupt(
            f"{self._name} did not become quiet {within}: {self._heard}. Another program or device "
            f"sends on the line, or it picks up noise: disconnect other hosts, check cable, "
            f"ground, termination and baud rate"
        )


class _InLoop:
    """Transactions of a period."""

    def __init__(self, bus: ServoBus) -> None:
        self._bus = bus

    def __enter__(self) -> None:
        self._before, self._bus.patient = self._bus.patient, False

    def __exit__(self, *_error: object) -> None:
        self._bus.patient = self._before


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}H", *values)

"""Servo bus: typed, checked transactions in DYNAMIXEL Protocol 2.0.

Every status packet is looked at: CRC, sender, length of its data, error number and Alert bit. A
transaction either returns what was asked for or raises; it never returns a value that no servo
has sent.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise

from gripper.asking import BROADCAST_ID, HIGHEST_ID, Asking, check_error, check_id, given_up
from gripper.clock import Clock
from gripper.errors import LimitExceeded
from gripper.line import BusStatistics, NoAnswerError, ServoLine
from gripper.packet_handler import Instruction
from gripper.port import ByteStream
from gripper.registers import Register, registers_between


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoIdentity:
    """Answer to a ping: Model Number (register 0) and Firmware Version (register 6)."""

    servo_id: int
    model_number: int
    firmware: int


class ServoBus:
    """Transactions with servos on one line; safe to use from several threads.

    A lost answer is asked for once more, outside of `in_loop` up to three times and patiently.
    Before that, a ping
    shows that everything that the servo still owed has arrived, so that a late answer is never
    taken for the new one. Where the ping stays unanswered too, the next transaction first waits
    until the line has been quiet for ``late_guard_s``.

    Parameters
    ----------
    stream
        The line.
    baudrate
        Baud rate in bit/s.
    clock
        Source of time.
    period_s
        Period of the loop that uses the bus in s: `sync_read` ends within it, retry included.
    return_delay_s
        Longest Return Delay Time of the servos in s (register 9; the factory value is 0.5 ms).
    allowance_s
        Time for adapter and operating system in s.
    late_guard_s
        Quiet time in s after which nothing late is expected any more.
    lock_timeout_s
        Longest wait in s for another thread's transaction.
    """

    def __init__(
        self,
        stream: ByteStream,
        *,
        baudrate: int,
        clock: Clock,
        period_s: float = 0.005,
        return_delay_s: float = 0.0005,
        allowance_s: float = 0.0015,
        late_guard_s: float = 0.05,
        lock_timeout_s: float = 1.0,
    ) -> None:
        self.baudrate = baudrate
        self._least_allowance_s = allowance_s
        self._line = ServoLine(
            stream,
            baudrate=baudrate,
            clock=clock,
            return_delay_s=return_delay_s,
            allowance_s=allowance_s,
            late_guard_s=late_guard_s,
            lock_timeout_s=lock_timeout_s,
        )
        self._asking = Asking(self._line, period_s)

    def in_loop(self) -> AbstractContextManager[None]:
        """Within the block no transaction waits longer than a period of the loop may take.

        Outside of it a retry waits for ``late_guard_s``: at a start or between commands a servo,
        or the machine that simulates it, may be slow once without being at fault. Within it a
        `sync_read` does not wait until the line is quiet: whoever uses it there reads Realtime
        Tick (register 120) along, which shows an old answer. A servo that was silent is asked
        last, so that it cannot hide one that is not.
        """
        return self._asking.hurried()

    @property
    def statistics(self) -> BusStatistics:
        """Counts since the bus was opened."""
        return self._line.statistics

    @property
    def return_delay_s(self) -> float:
        """Longest Return Delay Time of the servos in s; enters every time-out."""
        return float(self._line.port.return_delay_s)

    @return_delay_s.setter
    def return_delay_s(self, delay_s: float) -> None:
        self._line.port.return_delay_s = delay_s

    def alert(self, servo_id: int) -> bool:
        """Say whether the last answer of a servo had the Alert bit: register 70 is not zero."""
        return servo_id in self._line.alerts

    def misses(self, servo_id: int) -> int:
        """Return how many answers of a servo have been lost in a row."""
        return self._line.misses.get(servo_id, 0)

    @property
    def suspect(self) -> bool:
        """Whether an old answer may still be on its way."""
        return self._line.suspect

    def distrust(self) -> None:
        """Let the next transaction wait until the line is quiet: an answer came out of turn."""
        self._line.distrust()

    def ping(self, servo_id: int) -> ServoIdentity:
        """Ask a servo who it is; BusTimeout when none has that ID."""
        status = self._asking.ask(servo_id, Instruction.PING, b"", 3, f"ping of servo {servo_id}")
        return ServoIdentity(
            servo_id=servo_id,
            model_number=int.from_bytes(status.data[:2], "little"),
            firmware=status.data[2],
        )

    def scan(self, ids: Sequence[int] = range(HIGHEST_ID + 1)) -> tuple[ServoIdentity, ...]:
        """Ask each ID once, without patience, and return who answers; for finding a mistake."""
        found = []
        with self._line.transaction():
            for servo_id in ids:
                try:
                    data = self._line.request(servo_id, Instruction.PING, b"", 3).data
                except NoAnswerError:
                    continue
                number = int.from_bytes(data[:2], "little")
                found.append(
                    ServoIdentity(servo_id=servo_id, model_number=number, firmware=data[2])
                )
            self._line.give_up()
        return tuple(found)

    def round_trip_s(self, servo_id: int) -> float:
        """Return the time in s that a ping takes, however late its answer comes."""
        check_id(servo_id)
        with self._line.transaction():
            sent_s = self._line.clock.monotonic()
            try:
                self._line.request(servo_id, Instruction.PING, b"", 3, patient=True)
            except NoAnswerError as failure:
                self._line.give_up()
                raise given_up(failure, f"ping of servo {servo_id}", servo_id) from None
            return self._line.clock.monotonic() - sent_s

    def fit_allowance(self, wanted_s: float, most_s: float) -> None:
        """Set the time for adapter and operating system in a time-out; never below the usual."""
        self._line.port.allowance_s = max(self._least_allowance_s, min(wanted_s, most_s))

    def read(self, servo_id: int, register: Register) -> int:
        """Return the raw value of an item, sign-extended."""
        status = self._asking.ask(
            servo_id,
            Instruction.READ,
            _words(register.address, register.size),
            register.size,
            f"reading {register.name} of servo {servo_id}",
        )
        return register.decode(status.data)

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
        self._asking.ask(
            servo_id,
            Instruction.WRITE,
            _words(register.address) + register.encode(raw),
            0,
            f"writing {register.name} = {raw} to servo {servo_id}",
        )

    def sync_read(
        self, ids: Sequence[int], first: Register, last: Register
    ) -> dict[int, dict[str, int]]:
        """Return one contiguous block of items of several servos as raw values by name.

        A servo whose answer is missing is asked alone, `in_loop` as long as the period allows.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is still missing; nothing of the others is returned then.
        """
        block = registers_between(first, last)
        size = last.end - first.address
        action = f"reading {first.name} to {last.name} of servos {list(ids)}"
        found = self._asking.ask_all(ids, _words(first.address, size), size, action)
        return {servo_id: _decode(block, status.data) for servo_id, status in found.items()}

    def sync_write(self, values: Mapping[int, int | Sequence[int]], *registers: Register) -> None:
        """Write one item, or several contiguous ones, to several servos at once.

        Servos do not confirm a sync write: what must be certain is read back by the caller.

        Parameters
        ----------
        values
            Raw value, or one for each register, by servo ID.
        registers
            Contiguous items in the order of their addresses.
        """
        if not registers or not values:
            raise LimitExceeded("a sync write needs at least one servo and one register")
        if any(a.end != b.address for a, b in pairwise(registers)):
            raise LimitExceeded(f"{', '.join(r.name for r in registers)} are not contiguous")
        if any(not r.writable for r in registers):
            raise LimitExceeded(f"{', '.join(r.name for r in registers)}: not all are writable")
        params = _words(registers[0].address, registers[-1].end - registers[0].address)
        for servo_id, raws in values.items():
            check_id(servo_id)
            listed = (raws,) if isinstance(raws, int) else tuple(raws)
            params += bytes([servo_id])
            params += b"".join(r.encode(v) for r, v in zip(registers, listed, strict=True))
        # Nobody answers a sync write: an old answer can do no harm.
        with self._line.transaction(quiet=False):
            self._line.send(BROADCAST_ID, Instruction.SYNC_WRITE, params)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque off, RAM at its defaults; a part that it holds is let go.

        Sent once only, because a repetition would restart it again.
        """
        with self._line.transaction():
            action = f"reboot of servo {servo_id}"
            check_id(servo_id)
            try:
                status = self._line.request(servo_id, Instruction.REBOOT, b"", 0)
            except NoAnswerError as failure:
                self._line.give_up()
                raise given_up(failure, action, servo_id) from None
            self._line.alerts.discard(servo_id)
            check_error(status, action)

    def close(self) -> None:
        """Close the line; the servos keep doing what they were told last."""
        self._line.close()


def _words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


def _decode(block: Sequence[Register], data: bytes) -> dict[str, int]:
    start = block[0].address
    return {r.name: r.decode(data[r.address - start : r.end - start]) for r in block}

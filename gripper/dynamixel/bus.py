"""Servo bus: typed, checked transactions in DYNAMIXEL Protocol 2.0.

Every status packet is checked: CRC, sender, length of its data, error number and Alert bit. A
transaction either returns what was asked for or raises; it never returns a value that no servo
has sent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gripper.dynamixel.control_table import PRESENT_BLOCK, Register, RegisterBlock
from gripper.dynamixel.protocol2 import Instruction, StatusPacket
from gripper.dynamixel.transactions import (
    HIGHEST_ID,
    Request,
    Transactions,
    check_id,
    checked,
    ping_request,
)
from gripper.errors import BusCorrupt, BusTimeout, LimitExceeded

_COLLISION_READS = 3
"""Readings of a servo's present state that show whether another one answers with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoIdentity:
    """Answer to a ping: Model Number (register 0) and Firmware Version (register 6)."""

    servo_id: int
    model_number: int
    firmware: int


class ServoBus(Transactions):
    """Transactions with servos on one line; safe to use from several threads.

    A lost answer is asked for again behind a ping: once in `in_loop`, up to three times and
    patiently outside of it. A late answer is never taken for a new one, see `Transactions`.

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
    name
        Name of the line in error messages.
    """

    def alert(self, servo_id: int) -> bool:
        """Return whether the last answer of a servo had the Alert bit: register 70 is not zero."""
        return servo_id in self.alerts

    def ping(self, servo_id: int) -> ServoIdentity:
        """Ask a servo for its identity; BusTimeout when none has that ID."""
        return _identity(self.ask(ping_request(servo_id)))

    def scan(self, ids: Sequence[int] = range(HIGHEST_ID + 1)) -> tuple[ServoIdentity, ...]:
        """Ping each ID once, without patience, and return who answers; for finding a mistake."""
        return tuple(_identity(status) for status in self.ping_each(ids))

    def scan_at_once(self) -> tuple[tuple[ServoIdentity, ...], bool]:
        """Ping all IDs with one broadcast; return who answers, and whether damaged bytes came.

        Takes about a second. Damaged bytes are of servos that share an ID, or of another device;
        equal servos that share an ID may pass for one, see `shares_id`.
        """
        found, damaged = self.ping_all()
        return tuple(_identity(status) for status in found), damaged

    def shares_id(self, servo_id: int) -> bool:
        """Return whether several servos answer to one ID.

        Each reports its own time, position and voltage: their answers damage each other, or leave
        nothing that an adapter takes for bytes. One answer may be lost by chance.
        """
        action = f"reading {PRESENT_BLOCK} of servo {servo_id}"
        params = _words(PRESENT_BLOCK.address, PRESENT_BLOCK.size)
        request = Request(servo_id, Instruction.READ, PRESENT_BLOCK.size, action, params)
        lost = 0
        for _ in range(_COLLISION_READS):
            try:
                checked(self.ask_once(request)[0], action)
            except BusCorrupt:
                return True
            except BusTimeout:
                lost += 1
        return lost == _COLLISION_READS

    def round_trip_s(self, servo_id: int) -> float:
        """Return the time in s that a ping takes, however late its answer comes."""
        return self.ask_once(ping_request(servo_id), patient=True)[1]

    def read(self, servo_id: int, register: Register) -> int:
        """Return the raw value of an item, sign-extended."""
        action = f"reading {register.name} of servo {servo_id}"
        params = _words(register.address, register.size)
        request = Request(servo_id, Instruction.READ, register.size, action, params)
        return register.decode(self.ask(request).data)

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
        params = _words(register.address) + register.encode(raw)
        self.ask(Request(servo_id, Instruction.WRITE, 0, action, params))

    def sync_read(self, ids: Sequence[int], block: RegisterBlock) -> dict[int, dict[str, int]]:
        """Return the items of one block of several servos as raw values by name.

        A servo whose answer is missing is asked alone, `in_loop` as long as the period allows.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is still missing; nothing of the others is returned then.
        """
        action = f"reading {block} of servos {ids}"
        params = _words(block.address, block.size)
        found = self.ask_all(ids, params, block.size, action)
        return {servo_id: block.decode(status.data) for servo_id, status in found.items()}

    def sync_write(self, values: Mapping[int, Sequence[int]], block: RegisterBlock) -> None:
        """Write the items of one block to several servos at once.

        Servos do not confirm a sync write: what must be certain is read back by the caller.

        Parameters
        ----------
        values
            Raw value of each item, by servo ID.
        block
            The items.
        """
        if not values:
            raise LimitExceeded("a sync write needs at least one servo")
        if not block.writable:
            raise LimitExceeded(f"{block}: not all are writable")
        params = _words(block.address, block.size)
        for servo_id, raws in values.items():
            check_id(servo_id)
            params += bytes((servo_id,)) + block.encode(raws)
        self.broadcast(Instruction.SYNC_WRITE, params)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque off, RAM at its defaults; a part that it holds is let go.

        Sent once only, because a repetition would restart it again.
        """
        request = Request(servo_id, Instruction.REBOOT, 0, f"reboot of servo {servo_id}")
        status, _ = self.ask_once(request)
        self.alerts.discard(servo_id)
        checked(status, request.action)


def _words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


def _identity(status: StatusPacket) -> ServoIdentity:
    return ServoIdentity(
        servo_id=status.servo_id,
        model_number=int.from_bytes(status.data[:2], "little"),
        firmware=status.data[2],
    )

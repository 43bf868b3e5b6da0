"""Three hosts of the same servo bus with the same control cycle: ours, the SDK, and rustypot."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol, TypeVar

import rustypot
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from benchmarks.performance._child import Child, running
from benchmarks.performance._servo_responder import BAUD_RATE, SERVO_IDS
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import REGISTERS, RegisterBlock
from gripper.dynamixel.serial_port import SerialStream
from gripper.errors import BusCorrupt, BusTimeout

STATUS = (
    REGISTERS["present_current"],
    REGISTERS["present_velocity"],
    REGISTERS["present_position"],
)
GOAL = REGISTERS["goal_current"]
START = STATUS[0].address
SIZE = STATUS[-1].end - START
_ATTEMPTS = 10
"""A machine that others use too delays the simulated servos now and then for several time-outs."""

_Result = TypeVar("_Result")

Block = dict[int, tuple[int, ...]]
"""Signed raw current, velocity and position by servo."""


class NoAnswerError(Exception):
    """The host gave up on an answer."""


class Client(Protocol):
    """A host of the bus; what it asks raises NoAnswerError where it gives up."""

    def read(self, servo_id: int) -> int:
        """Return the raw present position of one servo."""
        ...

    def goals(self) -> tuple[int, ...]:
        """Return the raw goal currents that the servos have."""
        ...

    def status(self) -> tuple[Block, int]:
        """Return the status of all servos, and how many requests were sent a second time."""
        ...

    def set_goals(self, goals: dict[int, int]) -> None:
        """Write the raw goal currents of all servos."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


def until_answered(ask: Callable[[], _Result]) -> tuple[_Result, int]:
    """Ask until the host does not give up; the answer, and how often it gave up."""
    for given_up in range(_ATTEMPTS):
        try:
            return ask(), given_up
        except NoAnswerError:
            continue
    raise RuntimeError(f"the simulated servos did not answer {_ATTEMPTS} times in a row")


class Ours:
    """`gripper.dynamixel.bus.ServoBus` with its blocking, checked receiver."""

    def __init__(self, port: str) -> None:
        self._bus = ServoBus(SerialStream(port, BAUD_RATE), baudrate=BAUD_RATE, clock=time)

    def read(self, servo_id: int) -> int:
        with _giving_up(BusTimeout, BusCorrupt):
            return self._bus.read(servo_id, STATUS[-1])

    def goals(self) -> tuple[int, ...]:
        with _giving_up(BusTimeout, BusCorrupt):
            return tuple(self._bus.read(servo_id, GOAL) for servo_id in SERVO_IDS)

    def status(self) -> tuple[Block, int]:
        before = self._bus.statistics.retries
        with self._bus.in_loop(), _giving_up(BusTimeout, BusCorrupt):
            found = self._bus.sync_read(SERVO_IDS, RegisterBlock(*STATUS))
        block = {i: tuple(found[i][register.name] for register in STATUS) for i in SERVO_IDS}
        return block, self._bus.statistics.retries - before

    def set_goals(self, goals: dict[int, int]) -> None:
        self._bus.sync_write({i: (goal,) for i, goal in goals.items()}, RegisterBlock(GOAL))

    def close(self) -> None:
        self._bus.close()


class Sdk:
    """The plain dynamixel_sdk as its examples use it."""

    def __init__(self, port: str) -> None:
        self._port = PortHandler(port)
        self._port.setBaudRate(BAUD_RATE)
        self._handler = PacketHandler(2.0)
        self._reader = GroupSyncRead(self._port, self._handler, START, SIZE)
        self._writer = GroupSyncWrite(self._port, self._handler, GOAL.address, GOAL.size)
        for servo_id in SERVO_IDS:
            self._reader.addParam(servo_id)
            self._writer.addParam(servo_id, [0, 0])

    def read(self, servo_id: int) -> int:
        answer = self._handler.read4ByteTxRx(self._port, servo_id, STATUS[-1].address)
        return _signed(_value(answer), 4)

    def goals(self) -> tuple[int, ...]:
        answers = [self._handler.read2ByteTxRx(self._port, i, GOAL.address) for i in SERVO_IDS]
        return tuple(_signed(_value(answer), 2) for answer in answers)

    def status(self) -> tuple[Block, int]:
        if self._reader.txRxPacket() != COMM_SUCCESS:
            raise NoAnswerError
        block = {
            servo_id: tuple(
                _signed(self._reader.getData(servo_id, r.address, r.size), r.size) for r in STATUS
            )
            for servo_id in SERVO_IDS
        }
        return block, 0

    def set_goals(self, goals: dict[int, int]) -> None:
        for servo_id, raw in goals.items():
            self._writer.changeParam(servo_id, list(raw.to_bytes(2, "little", signed=True)))
        self._writer.txPacket()

    def close(self) -> None:
        self._port.closePort()


class Rusty:
    """rustypot: a host in Rust with Python bindings."""

    def __init__(self, port: str) -> None:
        self._host: Any = rustypot.Xl430PyController(port, BAUD_RATE, 0.05)

    def read(self, servo_id: int) -> int:
        with _giving_up(RuntimeError):
            data = self._host.read_raw_data(servo_id, STATUS[-1].address, STATUS[-1].size)
        return STATUS[-1].decode(bytes(data))

    def goals(self) -> tuple[int, ...]:
        with _giving_up(RuntimeError):
            data = self._host.sync_read_raw_data(list(SERVO_IDS), GOAL.address, GOAL.size)
        return tuple(GOAL.decode(bytes(one)) for one in data)

    def status(self) -> tuple[Block, int]:
        with _giving_up(RuntimeError):
            data = self._host.sync_read_raw_data(list(SERVO_IDS), START, SIZE)
        block = {
            servo_id: tuple(r.decode(bytes(one[r.address - START : r.end - START])) for r in STATUS)
            for servo_id, one in zip(SERVO_IDS, data, strict=True)
        }
        return block, 0

    def set_goals(self, goals: dict[int, int]) -> None:
        raws = [list(raw.to_bytes(2, "little", signed=True)) for raw in goals.values()]
        self._host.sync_write_raw_data(list(goals), GOAL.address, raws)

    def close(self) -> None:
        self._host.close()


class Servos(Child):
    """The simulated servos in a process of their own."""

    def set(self, *, paced: bool, drop_every: int = 0) -> None:
        """Choose whether answers take the time on the wire, and which are lost."""
        self.order(paced=paced, drop_every=drop_every)


def servos() -> AbstractContextManager[Servos]:
    """Run the simulated servos while the context lasts."""
    return running(Servos, "benchmarks.performance._servo_responder")


@contextmanager
def _giving_up(*errors: type[Exception]) -> Iterator[None]:
    try:
        yield
    except errors as error:
        raise NoAnswerError from error


def _value(answer: tuple[int, int, int]) -> int:
    value, result, error = answer
    if result != COMM_SUCCESS:
        raise NoAnswerError
    if error:
        raise RuntimeError(f"a servo refused a read with error {error}")
    return value


def _signed(value: int, size: int) -> int:
    return value - (1 << 8 * size) if value >> (8 * size - 1) else value

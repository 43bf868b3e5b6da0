"""Both lines of a hand: opened, reopened after a loss, closed at the end."""

from collections.abc import Callable, Sequence
from typing import NoReturn

from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from tactile.can.bus import CanBus, MissingBus, close_bus
from tactile.errors import BusNotOpened


class HandConnections:
    """Servo line and CAN bus of one hand; each can be missing, and be opened anew.

    Raises gripper.errors.PortLost or tactile.errors.BusNotOpened if a line cannot be opened; with
    ``partial`` if none can.

    Parameters
    ----------
    open_servos, open_can
        Open a line; raise PortLost or BusNotOpened if it cannot be opened.
    partial
        Whether one of both may be missing: each call of it then raises the reason.
    stream, can_bus
        Open lines that belong to the caller.
    open_boards
        Open the serial lines of the sensor's boards, by finger; the frame source does so.
    """

    def __init__(
        self,
        open_servos: Callable[[], ByteStream],
        open_can: Callable[[], CanBus],
        *,
        partial: bool = False,
        stream: ByteStream | None = None,
        can_bus: CanBus | None = None,
        open_boards: Sequence[Callable[[], ByteStream]] = (),
    ) -> None:
        self.open_boards = open_boards
        self._open_servos = open_servos
        self._open_can = open_can
        self._owned = stream is None or can_bus is None
        self._missing: dict[str, Exception] = {}
        self.can_bus = can_bus or self._can_or(BusNotOpened if partial else ())
        try:
            others = PortLost if partial and not self._missing else ()
            self.stream = stream or self._servos_or(others)
        except PortLost as error:
            close_bus(self.can_bus)
            both = [str(error), *(str(other) for other in self._missing.values())]
            raise PortLost("; ".join(both)) from error

    @property
    def missing(self) -> tuple[str, ...]:
        """Why each missing line could not be opened."""
        return tuple(map(str, self._missing.values()))

    def reopen_servos(self) -> ByteStream:
        """Reopen the servo line and return it. Raises PortLost if it cannot be opened."""
        if self._owned:
            self.stream.close()
        self.stream = self._servos_or(())
        return self.stream

    def reopen_can(self) -> CanBus:
        """Reopen the CAN bus and return it. Raises BusNotOpened if it cannot be opened."""
        if self._owned:
            close_bus(self.can_bus)
        self.can_bus = self._can_or(())
        return self.can_bus

    def close(self) -> None:
        """Close the lines that were opened here."""
        if self._owned:
            self.stream.close()
            close_bus(self.can_bus)

    def _servos_or(self, accepted: type[Exception] | tuple[()]) -> ByteStream:
        try:
            stream = self._open_servos()
        except accepted as error:
            self._missing["servos"] = error
            return MissingStream(error)
        self._missing.pop("servos", None)
        return stream

    def _can_or(self, accepted: type[Exception] | tuple[()]) -> CanBus:
        try:
            bus = self._open_can()
        except accepted as error:
            self._missing["can"] = error
            return MissingBus()
        self._missing.pop("can", None)
        return bus


class MissingStream:
    """Implements `ByteStream` for a port that could not be opened: it raises the reason."""

    def __init__(self, error: Exception) -> None:
        self._text = str(error)

    def write(self, _data: bytes, /) -> NoReturn:
        """Raise PortLost."""
        raise PortLost(self._text)

    def read(self, _size: int, _timeout_s: float, /) -> NoReturn:
        """Raise PortLost."""
        raise PortLost(self._text)

    def drop_input(self) -> NoReturn:
        """Raise PortLost."""
        raise PortLost(self._text)

    def close(self) -> None:
        """Do nothing: nothing is open."""

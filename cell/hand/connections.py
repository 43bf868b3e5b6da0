"""Both lines of a hand: opened, opened anew where one was lost, given back at the end."""

from collections.abc import Callable
from typing import NoReturn

from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from tactile.can.bus import CanBus, MissingBus, close_bus
from tactile.errors import BusNotOpened

MISSING = "this line is missing: "
"""Begin of the note on a line that could not be opened."""


class HandConnections:
    """Servo line and CAN bus of one hand; each can be missing, and be opened anew.

    Raises gripper.errors.PortLost or tactile.errors.BusNotOpened if a line cannot be opened; with
    ``partial`` if none can.

    Parameters
    ----------
    open_servos, open_can
        Open a line, with PortLost and BusNotOpened where it cannot be opened.
    partial
        Whether one of both may be missing: it then raises why, whatever is asked of it.
    stream, can_bus
        Ends that are open already and belong to somebody else.
    """

    def __init__(
        self,
        open_servos: Callable[[], ByteStream],
        open_can: Callable[[], CanBus],
        *,
        partial: bool = False,
        stream: ByteStream | None = None,
        can_bus: CanBus | None = None,
    ) -> None:
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
    def notes(self) -> tuple[str, ...]:
        """What cannot be reached, and why."""
        return tuple(MISSING + str(error) for error in self._missing.values())

    @property
    def servos_are_missing(self) -> bool:
        """Whether there was no servo line when it was opened last."""
        return "servos" in self._missing

    def reopen_servos(self) -> ByteStream:
        """Open the servo line anew and return it; PortLost where it cannot be opened."""
        if self._owned:
            self.stream.close()
        self.stream = self._servos_or(())
        return self.stream

    def reopen_can(self) -> CanBus:
        """Open the CAN bus anew and return it; BusNotOpened where it cannot be opened."""
        if self._owned:
            close_bus(self.can_bus)
        self.can_bus = self._can_or(())
        return self.can_bus

    def close(self) -> None:
        """Give the lines back that were opened here."""
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
    """Implements `ByteStream` for a port that could not be opened: it raises why."""

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
        """Nothing is open."""

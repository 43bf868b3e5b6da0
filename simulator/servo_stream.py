"""The host's end of the servo bus in memory, on an injected clock: no file, no thread."""

from collections.abc import Callable
from typing import Protocol

from simulator.errors import PortUnplugged
from simulator.servo_bus import ServoBusDevice


class Clock(Protocol):
    """A monotonic clock that can wait, such as `simulator.clock.VirtualClock`."""

    def monotonic(self) -> float:
        """Return the time in s since an arbitrary start; it never goes back."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait for ``seconds`` s."""
        ...


class MemoryServoStream:
    """A stream of bytes to and from simulated servos, with the time that the wire takes.

    Writing does not wait for the wire, as with a USB adapter; answers arrive whole when their last
    byte has passed.

    Parameters
    ----------
    device
        The servos.
    clock
        Waiting in `read` is done by its ``sleep``.
    lost_error
        Makes the exception raised while the cable is out or after `close`, from a text.
    """

    def __init__(
        self,
        device: ServoBusDevice,
        clock: Clock,
        *,
        lost_error: Callable[[str], Exception] = PortUnplugged,
    ) -> None:
        self._device = device
        self._clock = clock
        self._lost_error = lost_error
        self._input = bytearray()
        self._closed = False

    def write(self, data: bytes) -> None:
        """Send bytes to the servos; raises ``lost_error`` while the cable is out."""
        self._check()
        self._device.receive(data, self._clock.monotonic())

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to ``size`` bytes as soon as one is there, ``b""`` after ``timeout_s`` s."""
        self._check()
        deadline_s = self._clock.monotonic() + timeout_s
        while True:
            now_s = self._clock.monotonic()
            self._input += self._device.transmit(now_s)
            if self._input or now_s >= deadline_s:
                found = bytes(self._input[:size])
                del self._input[:size]
                return found
            due_s = self._device.next_event_s()
            until_s = deadline_s if due_s is None else min(due_s, deadline_s)
            self._clock.sleep(max(until_s - now_s, 1e-9))
            self._check()

    def drop_input(self) -> None:
        """Forget the bytes that have arrived and were not read."""
        self._check()
        self._device.transmit(self._clock.monotonic())
        self._input.clear()

    def close(self) -> None:
        """Close the stream; closing it again changes nothing."""
        self._closed = True

    def _check(self) -> None:
        if self._closed:
            raise self._lost_error("the servo stream is closed; open a new one")
        if self._device.faults.unplugged:
            raise self._lost_error(
                "the cable to the simulated servos is out (fault knob 'unplugged'); plug it in "
                "and open the port again"
            )

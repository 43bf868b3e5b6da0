"""The devices on the simulated CAN bus as one: the control unit, and who joins it."""

from collections.abc import Callable

from simulator.can_link import CanDevice
from simulator.control_unit import SendBurst
from simulator.errors import SimulatorStateError


class CanDevices:
    """Several devices behind one end of the bus; the first one is the cell's own.

    Parameters
    ----------
    unit
        The cell's control unit.
    """

    __slots__ = ("_devices", "_send")

    def __init__(self, unit: CanDevice) -> None:
        self._devices: list[CanDevice] = [unit]
        self._send: SendBurst | None = None

    def connect(self, send: SendBurst) -> None:
        """Plug all of them in."""
        self._send = send
        for device in self._devices:
            device.connect(send)

    def add(self, device: CanDevice) -> Callable[[], None]:
        """Let another device join; returns what takes it off the bus again."""
        if self._send is not None:
            device.connect(self._send)
        self._devices.append(device)
        return lambda: self._devices.remove(device)

    def send(self, ready_s: float, can_id: int, burst: list[bytes]) -> float:
        """Send messages that none of the devices would; returns when the last is through, in s.

        Raises
        ------
        SimulatorStateError
            If no bus is connected.
        """
        if self._send is None:
            raise SimulatorStateError("the devices are not connected to a bus: connect() first")
        return self._send(ready_s, can_id, burst)

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Let every device hear one message."""
        for device in tuple(self._devices):
            device.receive(can_id, data, now_s)

    def advance(self, now_s: float) -> None:
        """Let the time pass for all of them."""
        for device in self._devices:
            device.advance(now_s)

    def next_event_s(self) -> float:
        """Return when one of them says something by itself next, in s."""
        return min(device.next_event_s() for device in self._devices)

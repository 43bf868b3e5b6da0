"""What a canopen LocalNode needs of its network, in the time of the simulation."""

import math
from collections.abc import Callable, Sequence
from typing import Any


class PeriodicTask:
    """A message that is sent again and again; canopen's heartbeat producer holds one."""

    __slots__ = ("_stop", "can_id", "data", "due_s", "period_s")

    def __init__(
        self,
        can_id: int,
        data: bytes,
        period_s: float,
        due_s: float,
        stop: Callable[["PeriodicTask"], None],
    ) -> None:
        self.can_id = can_id
        self.data = data
        self.period_s = period_s
        self.due_s = due_s
        self._stop = stop

    def update(self, data: Sequence[int]) -> None:
        """Send other data from the next time on."""
        self.data = bytes(data)

    def stop(self) -> None:
        """Send no more."""
        self._stop(self)


class DeviceNetwork:
    """Takes the messages of one device and keeps its periodic ones.

    It has the methods of ``canopen.Network`` that a LocalNode calls; no bus, no thread.

    Parameters
    ----------
    send
        Takes time in s, identifier and data of each message.

    Attributes
    ----------
    now_s
        Present time in s; its owner keeps it.
    """

    __slots__ = ("_send", "_tasks", "now_s")

    def __init__(self, send: Callable[[float, int, bytes], None], now_s: float) -> None:
        self._send = send
        self._tasks: list[PeriodicTask] = []
        self.now_s = now_s

    def subscribe(self, can_id: int, callback: Callable[..., Any]) -> None:
        """Do nothing: the owner hands messages to the node itself, by the rules of NMT."""

    def unsubscribe(self, can_id: int, callback: Callable[..., Any] | None = None) -> None:
        """Do nothing, see `subscribe`."""

    def send_message(self, can_id: int, data: Sequence[int], remote: bool = False) -> None:
        """Send a message now; remote frames are not what this device sends."""
        if remote:
            raise ValueError(f"the control unit sends no remote frames (identifier 0x{can_id:03X})")
        self._send(self.now_s, can_id, bytes(data))

    def send_periodic(
        self, can_id: int, data: Sequence[int], period: float, remote: bool = False
    ) -> PeriodicTask:
        """Send a message every ``period`` s, for the first time after one period."""
        if remote:
            raise ValueError(f"the control unit sends no remote frames (identifier 0x{can_id:03X})")
        task = PeriodicTask(can_id, bytes(data), period, self.now_s + period, self._tasks.remove)
        self._tasks.append(task)
        return task

    def next_due_s(self) -> float:
        """Return when the next periodic message is due in s, infinity without any."""
        return min((task.due_s for task in self._tasks), default=math.inf)

    def run(self, now_s: float, *, mute: bool) -> None:
        """Send what is due until ``now_s`` s at its own times; ``mute`` skips the sending."""
        for task in self._tasks:
            while task.due_s <= now_s:
                if not mute:
                    self._send(task.due_s, task.can_id, task.data)
                task.due_s += task.period_s

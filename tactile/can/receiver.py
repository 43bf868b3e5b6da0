"""Sources of received CAN messages: a directly polled bus, or one supervised thread.

Some adapters also return the messages that the host sent; the sources drop them.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import islice

import can

from tactile.can.bus import MissingBus
from tactile.clock import Clock
from tactile.errors import BusOff, LinkFault, ReceiveLoopDead

Stamped = tuple[float, can.Message]
"""Monotonic time of reception in s, and the message."""
_POLL_S = 0.0005
"""Longest pause in s between two polls of a bus or a queue: four messages at 1 Mbit/s."""
_RECEIVE_S = 0.05
"""Longest wait in s of the thread for a message, which also limits the delay of its end."""
_HANG_S = 1.0
"""Longest time in s of one loop of the thread; a longer one counts as hung."""
_JOIN_S = 2.0
"""Longest wait in s for the end of the thread."""


def of_another_kind(message: can.Message) -> bool:
    """Return whether a message has a 29-bit identifier or is a request (RTR): of other devices."""
    return message.is_extended_id or message.is_remote_frame


def interface_failed(error: Exception) -> BusOff:
    """Return the fault for an error of a CAN interface."""
    return BusOff(
        f"the CAN interface failed: {str(error) or type(error).__name__}; "
        "check that the adapter is plugged in and its interface is up; the next start opens it anew"
    )


class PolledSource:
    """Source that polls the bus in the caller's thread: for buses in memory, in virtual time.

    A bus of this kind stamps its messages by the same clock. Without a stamp the time of the poll
    is used.

    Parameters
    ----------
    limit
        Most messages returned at once, so that a flooded bus does not block the caller.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, *, limit: int = 4096) -> None:
        self._bus = bus
        self.clock = clock
        """The real clock, or that of a simulated bus with its devices."""
        self._limit = limit
        # A bus in memory has a method for all arrived messages, which is faster than one by one.
        self._recv_all: Callable[[int], list[can.Message]] = getattr(
            bus, "recv_all", lambda most: list(islice(iter(partial(bus.recv, 0), None), most))
        )

    def start(self) -> None:
        """Discard earlier messages."""
        while self.drain():
            pass

    def drain(self) -> list[Stamped]:
        """Return all messages since the last call."""
        now_s = self.clock.monotonic()
        try:
            messages = self._recv_all(self._limit)
        except (can.CanError, OSError) as error:
            raise interface_failed(error) from error
        return [
            (m.timestamp if 0.0 < m.timestamp <= now_s else now_s, m) for m in messages if m.is_rx
        ]

    def wait(self, timeout_s: float) -> None:
        """Sleep for a short while, at most ``timeout_s``."""
        self.clock.sleep(min(timeout_s, _POLL_S))

    def close(self) -> None:
        """Nothing to stop."""


class ThreadedReceiver(PolledSource):
    """Source with one thread that stamps and queues messages; the end of the thread is a fault.

    Parameters
    ----------
    bus
        An open bus whose ``recv`` may block.
    limit
        Size of the queue; the receiver gives up when it is full.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, *, limit: int = 20_000) -> None:
        super().__init__(bus, clock, limit=limit)
        self._queue: deque[Stamped] = deque()
        self._stop = threading.Event()
        self._fault: BusOff | ReceiveLoopDead | None = None
        self._thread: threading.Thread | None = None
        self._alive_s = 0.0

    def start(self) -> None:
        """Start the thread; earlier messages of the bus are discarded."""
        PolledSource(self._bus, self.clock).start()
        self._queue.clear()
        self._stop.clear()
        self._fault = None
        self._alive_s = self.clock.monotonic()
        self._thread = threading.Thread(target=self._run, name="tactile-receive", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                message = self._bus.recv(_RECEIVE_S)
                self._alive_s = self.clock.monotonic()
                if message is None or not message.is_rx:
                    continue
                if len(self._queue) >= self._limit:
                    self._fault = ReceiveLoopDead(
                        f"{self._limit} CAN messages wait to be processed: the host is too slow "
                        "or the bus is flooded; start the link again"
                    )
                    return
                self._queue.append((self._alive_s, message))
        except (can.CanError, OSError) as error:
            self._fault = interface_failed(error)
        except Exception as error:
            self._fault = ReceiveLoopDead(
                f"the receive thread ended ({error!r}); start the link again"
            )
            self._fault.__cause__ = error

    def drain(self) -> list[Stamped]:
        """Return all messages since the last call."""
        if self._thread is None:
            raise ReceiveLoopDead("the receive thread is not running; start the link")
        if self._fault is not None:
            raise self._fault
        silent_s = self.clock.monotonic() - self._alive_s
        if silent_s > _HANG_S:
            raise ReceiveLoopDead(
                f"the receive thread did not come round for {silent_s:.2f} s, allowed are "
                f"{_HANG_S:g} s: the CAN driver hangs; unplug the adapter and start again"
            )
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]

    def close(self) -> None:
        """End the thread and wait for it, at most 2 s."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None


def reopened(
    bus: can.BusABC, fault: LinkFault | None, reopen: Callable[[], can.BusABC] | None
) -> can.BusABC:
    """Return the bus for a new start; one that is missing, or was lost by a fault, is reopened."""
    lost = isinstance(bus, MissingBus) or isinstance(fault, BusOff | ReceiveLoopDead)
    return reopen() if lost and reopen is not None else bus


def message_source(bus: can.BusABC) -> PolledSource:
    """Return what receives the messages of a bus.

    It is a thread in real time, and the caller who polls under the clock of a simulated bus.
    """
    clock: Clock = getattr(bus, "clock", time)
    return (ThreadedReceiver if clock is time else PolledSource)(bus, clock)

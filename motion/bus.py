"""Bus of the drives: dispatch of messages and waits, in the caller's thread."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import can
import canopen

from motion.errors import AxisSilent
from motion.object_dictionary import COB_HEARTBEAT
from tactile.can.receiver import PolledSource, of_another_kind
from tactile.clock import Clock
from tactile.errors import LinkFault


def unwatched() -> None:
    """Do nothing: the default supervision of a motion."""


class Watch:
    """Supervision during waits: called once a period while an axis moves or answers.

    Parameters
    ----------
    period_s
        Least time in s between two calls.
    """

    def __init__(self, clock: Clock, period_s: float) -> None:
        self.clock = clock
        self.supervise: Callable[[], None] = unwatched
        """The called function; its error ends the motion."""
        self._period_s = period_s
        self._due_s = clock.monotonic()

    def look(self) -> None:
        """Call the supervision if it is due."""
        now_s = self.clock.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self.supervise()

    def pause(self, seconds: float) -> None:
        """Wait for a time in s under supervision."""
        end_s = self.clock.monotonic() + seconds
        while (left_s := end_s - self.clock.monotonic()) > 0.0:
            self.clock.sleep(min(left_s, self._period_s))
            self.look()


HOST_NODE = 127
"""Node-ID of the host's own heartbeat: the last one, which no drive here has."""
HOST_HEARTBEAT_S = 0.05
"""Period in s of that heartbeat while an axis moves."""
_OPERATIONAL = b"\x05"
"""NMT state in it (CiA 301, 7.2.8.3.3)."""


class DriveBus(canopen.Network):
    """CAN bus of one to three drives, used by the thread that moves them; canopen dispatches.

    Parameters
    ----------
    loss_s
        Time in s without a heartbeat after which a drive is lost.
    """

    def __init__(self, bus: can.BusABC, watch: Watch, loss_s: float) -> None:
        super().__init__(bus)
        self.watch = watch
        self.loss_s = loss_s
        self.clock = watch.clock
        self._source = PolledSource(bus, watch.clock)
        self._beat_due_s = math.inf

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a message. Raises AxisSilent when the interface fails."""
        with _failures_named():
            super().send_message(can_id, data, remote)

    def beat(self) -> None:
        """Start the host's heartbeat, for drives that stop without it."""
        self._beat_due_s = self.clock.monotonic() + HOST_HEARTBEAT_S
        self.send_message(COB_HEARTBEAT + HOST_NODE, _OPERATIONAL)

    def service(self) -> None:
        """Pass on received messages, and send the heartbeat when it is due.

        Raises AxisSilent when the interface fails.
        """
        if self.clock.monotonic() >= self._beat_due_s:
            self.beat()
        with _failures_named():
            messages = self._source.drain()
        for _, message in messages:
            # Error frames are not used: a disturbed controller shows by missing heartbeats,
            # here within `loss_s`, and at the drives.
            unusable = message.is_error_frame or len(message.data) != message.dlc
            if unusable or of_another_kind(message):
                continue
            self.notify(message.arbitration_id, message.data, message.timestamp)

    def drop_old(self) -> None:
        """Drop messages from the time without polls."""
        with _failures_named():
            self._source.start()

    def wait(self, most_s: float) -> None:
        """Wait for at most ``most_s`` s under supervision."""
        self._source.wait(most_s)
        self.watch.look()


@contextmanager
def _failures_named() -> Iterator[None]:
    try:
        yield
    except (can.CanError, OSError, LinkFault) as error:
        raise AxisSilent(
            f"the CAN interface of the axes failed: {error}; the axes cannot be stopped over it. "
            "Check the adapter, use the emergency stop where an axis still moves"
        ) from error

"""The server of the hand: the process that owns both ports and runs the force loop.

Between commands it ticks by itself, so that watchdog and heartbeat are always served. It ignores
SIGINT. The end of the program freezes the grip, and the process ends as
`gripper.gripper.Gripper.close` does: a held part stays held. SIGTERM does the same a second later:
systemd sends it to both, and the program ends the cell in order meanwhile.
"""

import gc
import os
import select
import signal
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import inf
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from cell.errors import HandLost, HostSilent
from cell.hand.local import LocalHand, open_hand
from cell.hand.messages import (
    Boot,
    EndRamp,
    HandFault,
    HandMessage,
    HandPeriod,
    HandReply,
    HandRequest,
    LiveUpdate,
    Ready,
    packed,
)
from cell.hand.real_time import enter_real_time, stop_collecting
from gripper.errors import GraspStopped, GripperError, copy_fingers
from gripper.values.state import Cycle, GripperPhase
from tactile.source import TactileFrame


class Outbox:
    """Sends events in order, and queues them while the other end has no room.

    Its connection is a stream socket. Linux reports it as writable while three quarters of its
    buffer of at least 200 kB are free: a smaller message is then taken whole, and nothing blocks.
    Beyond ``limit`` waiting periods further periods are dropped and counted; other events are kept.
    """

    def __init__(self, connection: Connection, *, limit: int) -> None:
        self._connection = connection
        self._poller = select.poll()
        self._poller.register(connection.fileno(), select.POLLOUT)
        self._limit = limit
        self._waiting: deque[bytes] = deque()
        self.dropped = 0
        """Periods dropped so far."""
        self.broken = False
        """Whether the other end is gone."""

    @property
    def empty(self) -> bool:
        """Whether the other end has taken everything."""
        return not self._waiting

    def post(self, event: HandMessage) -> None:
        """Send now or later; drop a period beyond the limit."""
        if isinstance(event, HandPeriod) and len(self._waiting) >= self._limit:
            self.dropped += 1
            return
        self._waiting.append(packed(event))
        self.flush()

    def flush(self) -> None:
        """Send as much as the other end has room for; does not wait."""
        try:
            while self._waiting and self._writable():
                self._connection.send_bytes(self._waiting[0])
                self._waiting.popleft()
        except OSError:
            self._waiting.clear()
            self.broken = True

    def drain(self, timeout_s: float) -> None:
        """Send the rest at the end of the process; wait at most ``timeout_s`` s."""
        while self._waiting and not self.broken and self._writable(timeout_s):
            self.flush()

    def _writable(self, timeout_s: float = 0.0) -> bool:
        return bool(self._poller.poll(1e3 * timeout_s))


WAITING_PERIODS = 1000
"""Periods that may wait for the program before the grip is frozen."""
_LAST_WORDS_S = 0.5
"""Time in s for the other end to read the last messages."""
_PROGRAM_ENDS_S = 1.0
"""Time in s from SIGTERM to the freeze, in which the program can end the cell in order."""
_ALIVE_EVERY_S = 0.5
"""Period in s of `LiveUpdate` between commands: a tenth of the client's time-out."""
_SHOW_EVERY_S = 0.02
"""The same while the hand is supervised: the period of the tactile frames."""


def main(connection_fd: int, stop_fd: int, parent: int) -> None:
    """Run until the program, process ``parent``, closes the connection, ends, or SIGTERM comes.

    The descriptors are of the socket for requests and events, and of the pipe for stops.
    """
    connection = Connection(connection_fd)
    outbox = Outbox(connection, limit=WAITING_PERIODS)
    try:
        boot: Boot = connection.recv()
        notes = enter_real_time(boot.config.loop)
        hand = open_hand(boot.config, notes=notes, partial=boot.partial)
    except EOFError:
        return
    except Exception as error:
        outbox.post(HandFault(error=error, phase=GripperPhase.OFF))
        outbox.drain(_LAST_WORDS_S)
        return
    server = HandServer(hand, connection, outbox, parent=parent)
    threading.Thread(target=server.listen, args=(stop_fd,), name="stop", daemon=True).start()
    signal.signal(signal.SIGTERM, server.terminate)
    stop_collecting()
    try:
        outbox.post(Ready(notes=hand.notes, missing=hand.missing, statistics=hand.statistics))
        server.serve()
    finally:
        server.end()


class HandServer:
    """Carries out requests on a hand, and supervises it between them.

    Requests come from the connection, events go to the outbox. It ends with its parent.
    """

    def __init__(
        self, hand: LocalHand, connection: Connection, outbox: Outbox, *, parent: int
    ) -> None:
        self._hand = hand
        self._connection = connection
        self._outbox = outbox
        self._parent = parent
        self._poller = select.poll()
        self._poller.register(connection.fileno(), select.POLLIN)
        self._requests: deque[HandRequest] = deque()
        self._ramp = 0
        self._ending = ""
        self._asked_s = inf
        self._supervised = True
        self._alive_due_s = 0.0

    def terminate(self, _number: int, _frame: FrameType | None) -> None:
        """Handle SIGTERM: freeze and end if the program has not ended this process in a second."""
        self._asked_s = min(self._asked_s, time.monotonic())

    def listen(self, stop_fd: int) -> None:
        """Stop the running command at each byte, and everything when the pipe closes."""
        while os.read(stop_fd, 64):
            self._hand.request_stop()
        self._end_because("its program is gone")

    def serve(self) -> None:
        """Carry out requests and supervise until there is a reason to end."""
        due_s = time.monotonic()
        while not self._ending:
            try:
                if not self._requests:
                    self._receive(max(0.0, due_s - time.monotonic()))
            except (EOFError, OSError):
                return
            if self._requests:
                self._execute(self._requests.popleft())
            now_s = time.monotonic()
            if now_s >= due_s:
                self._supervise()
                due_s = max(due_s + self._hand.period_s, now_s)

    def end(self) -> None:
        """Close the ports, keep a held part held, and send why the process ends."""
        self._hand.shutdown()
        self._hand.close()
        if self._ending:
            lost = HandLost(
                f"the process of the force loop has ended: {self._ending}; a held part stays held"
            )
            self._outbox.post(HandFault(error=lost, phase=self._hand.phase))
            self._outbox.drain(_LAST_WORDS_S)

    def _end_because(self, reason: str) -> None:
        self._ending = self._ending or reason
        self._hand.request_stop()

    def _receive(self, wait_s: float) -> None:
        """Receive the next message, if it comes in time; each message is small and arrives whole.

        Raises EOFError or OSError if the program is gone.
        """
        if not self._poller.poll(1e3 * wait_s):
            return
        message = self._connection.recv()
        if isinstance(message, HandRequest):
            self._requests.append(message)
        elif isinstance(message, EndRamp) and message.number == self._ramp:
            self._hand.end_ramp()

    def _execute(self, request: HandRequest) -> None:
        value: Any = None
        failure: BaseException | None = None
        dropped = self._outbox.dropped
        self._ramp = request.number if request.method in ("grasp", "press_pads_together") else 0
        try:
            value = request.run(self._hand, self._watch)
        except GraspStopped as stop:
            failure = stop
            if self._outbox.dropped > dropped:
                failure = HostSilent(
                    f"the program read nothing from its force loop for {WAITING_PERIODS} periods: "
                    f"the goals are frozen; {self._outbox.dropped - dropped} periods are lost"
                )
                copy_fingers(stop, failure)
        except Exception as error:
            failure = error
            self._stand_by()
        else:
            self._supervised = self._supervised or request.method == "start"
        self._outbox.post(
            HandReply(
                number=request.number,
                value=value,
                error=failure,
                phase=self._hand.phase,
                statistics=replace(self._hand.statistics, undelivered=self._outbox.dropped),
            )
        )
        # Nothing waits now.
        gc.collect()

    def _watch(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        dropped = self._outbox.dropped
        self._outbox.post(HandPeriod(cycle=cycle, frames=tuple(frames)))
        # The end of the program is detected below, and by the pipe for stops.
        with suppress(EOFError, OSError):
            self._receive(0.0)
        self._look_for_parent()
        if self._ending or self._outbox.dropped > dropped:
            self._hand.request_stop()

    def _supervise(self) -> None:
        self._outbox.flush()
        self._look_for_parent()
        if self._supervised:
            try:
                self._hand.tick()
            except Exception as error:
                self._stand_by()
                self._outbox.post(HandFault(error=error, phase=self._hand.phase))
        now_s = time.monotonic()
        if now_s >= self._alive_due_s and self._outbox.empty:
            self._alive_due_s = now_s + (_SHOW_EVERY_S if self._supervised else _ALIVE_EVERY_S)
            self._outbox.post(LiveUpdate(latest=self._hand.latest))

    def _look_for_parent(self) -> None:
        if self._outbox.broken or os.getppid() != self._parent:
            self._end_because("its program is gone")
        elif time.monotonic() - self._asked_s > _PROGRAM_ENDS_S:
            self._end_because("it was asked to end (SIGTERM)")

    def _stand_by(self) -> None:
        """Keep the grip without supervision, as a fault leaves it, until the next start."""
        self._supervised = False
        # The fault is sent already; another failure of the bus adds nothing.
        with suppress(GripperError):
            self._hand.keep_grip()

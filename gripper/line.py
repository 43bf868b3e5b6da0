"""One line to the servos: requests, answers and what to do when an answer does not come.

An answer that comes too late is the danger of a bus without sequence numbers: it would pass for
the answer to the next request. Answers of one servo come in the order of the requests, so a ping
that is answered shows that nothing older is still on its way.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from gripper.clock import Clock
from gripper.errors import BusBusy, PortLost
from gripper.packet_handler import CheckedPacketHandler, Instruction
from gripper.packets import STATUS_OVERHEAD, StatusPacket
from gripper.port import ByteStream, SdkPort


@dataclass(frozen=True, slots=True, kw_only=True)
class BusStatistics:
    """Counts since the bus was opened.

    Attributes
    ----------
    transactions
        Transactions asked for.
    retries
        Requests sent a second time.
    timeouts
        Answers that did not come in time.
    corrupt
        Answers that came damaged, or behind bytes that are none.
    late
        Answers to an earlier request, or of another servo; dropped.
    """

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    corrupt: int = 0
    late: int = 0


class NoAnswerError(Exception):
    """No right answer within the time-out; the bus turns it into a typed error.

    Attributes
    ----------
    damaged
        True when something came that was no answer to the request.
    """

    def __init__(self, damaged: bool) -> None:
        super().__init__(damaged)
        self.damaged = damaged


class ServoLine:
    """Sends requests and receives checked answers; one transaction at a time.

    Parameters
    ----------
    stream, baudrate, clock
        The line, its rate in bit/s and the source of time.
    return_delay_s, allowance_s
        Parts of the time-out of a packet in s, see `SdkPort`.
    late_guard_s
        Quiet time in s after which nothing late is expected any more.
    lock_timeout_s
        Longest wait in s for another thread's transaction.
    """

    def __init__(
        self,
        stream: ByteStream,
        *,
        baudrate: int,
        clock: Clock,
        return_delay_s: float,
        allowance_s: float,
        late_guard_s: float,
        lock_timeout_s: float,
    ) -> None:
        self.clock = clock
        self.port = SdkPort(
            stream,
            clock,
            baudrate=baudrate,
            return_delay_s=return_delay_s,
            allowance_s=allowance_s,
        )
        self._counts = dict.fromkeys(BusStatistics.__slots__, 0)
        self.alerts: set[int] = set()
        self.misses: dict[int, int] = {}
        self.suspect = False
        self._suspect_since_s = 0.0
        self._handler = CheckedPacketHandler()
        self._late_guard_s = late_guard_s
        self._lock_timeout_s = lock_timeout_s
        self._lock = threading.RLock()
        self._owed = 0
        self._closed = False

    @contextmanager
    def transaction(self, *, quiet: bool = True) -> Iterator[None]:
        """Hold the line for one exchange; BusBusy, PortLost when it cannot be had.

        With ``quiet`` the line falls silent first where an old answer may still be on its way;
        without it whoever asks must tell an old answer by its length or content.
        """
        if not self._lock.acquire(timeout=self._lock_timeout_s):
            raise BusBusy(
                f"another thread holds the servo bus for more than {self._lock_timeout_s} s"
            )
        try:
            if self._closed:
                raise PortLost("the servo bus is closed: open it again")
            self.count(transactions=1)
            if self.suspect and quiet:
                self._wait_until_quiet()
            elif self.suspect and self._suspicion_lapsed():
                self.suspect = False
                self._owed = 0
            yield
        finally:
            self.port.is_using = False
            self._lock.release()

    def send(self, servo_id: int, instruction: Instruction, params: bytes) -> None:
        """Drop what has arrived and send one request."""
        self.port.is_using = False
        self._handler.send(self.port, servo_id, instruction, params)

    def request(
        self,
        servo_id: int,
        instruction: Instruction,
        params: bytes,
        size: int,
        *,
        patient: bool = False,
    ) -> StatusPacket:
        """Send a request to one servo and return its answer with ``size`` bytes of data.

        With ``patient`` the answer may take as long as anything late is expected.
        """
        self.send(servo_id, instruction, params)
        return self.receive(servo_id, size, patience_s=self._late_guard_s if patient else 0.0)

    def receive(self, servo_id: int, size: int, *, patience_s: float = 0.0) -> StatusPacket:
        """Wait for one answer; what is damaged, late or of another servo is dropped."""
        if patience_s > 0.0:
            self.port.setPacketTimeoutMillis(1000.0 * patience_s)
        else:
            self.port.setPacketTimeout(STATUS_OVERHEAD + size)
        damaged = False
        while True:
            status = self._handler.receive(self.port)
            if status is None:
                self._owed += 1
                self.misses[servo_id] = self.misses.get(servo_id, 0) + 1
                damaged |= self._handler.dropped_bytes > 0
                self.count(**{"corrupt" if damaged else "timeouts": 1})
                raise NoAnswerError(damaged)
            if status.servo_id != servo_id:
                self.count(late=1)
            elif status.error == 0 and len(status.data) != size:
                # A servo that refuses answers without data; any other length answers another
                # request.
                damaged = True
                self._owed = max(0, self._owed - 1)
                self.count(late=1)
            else:
                if self._handler.dropped_bytes:
                    self.count(corrupt=1)
                self.misses[servo_id] = 0
                (self.alerts.add if status.alert else self.alerts.discard)(servo_id)
                return status

    def distrust(self) -> None:
        """Take it that an answer is still on its way."""
        self.give_up()
        self._owed += 1

    def give_up(self) -> None:
        """Note that an answer that was asked for did not come: it may come later."""
        self.suspect = True
        self._suspect_since_s = self.clock.monotonic()

    def _suspicion_lapsed(self) -> bool:
        return self.clock.monotonic() - self._suspect_since_s > self._late_guard_s

    def clear(self, servo_id: int, deadline_s: float | None, *, patient: bool = False) -> None:
        """Ping a servo: its answers come in order, so after this one nothing old should arrive.

        With ``patient`` the line is watched for what did not come before it.
        """
        if deadline_s is not None and self.clock.monotonic() >= deadline_s:
            raise NoAnswerError(damaged=False)
        self.request(servo_id, Instruction.PING, b"", 3, patient=patient)
        if patient and self._owed > 0:
            # The ping may have overtaken what is owed: where there is time, wait for that too.
            self._wait_until_quiet()
        self._owed = 0

    def _wait_until_quiet(self) -> None:
        """Drop late answers until all owed ones came or the line was quiet for long enough."""
        quiet_since_s = self.clock.monotonic()
        while self._owed > 0:
            left_s = quiet_since_s + self._late_guard_s - self.clock.monotonic()
            if left_s <= 0.0:
                break
            self.port.setPacketTimeoutMillis(1000.0 * left_s)
            status = self._handler.receive(self.port)
            if status is not None or self._handler.dropped_bytes:
                quiet_since_s = self.clock.monotonic()
            if status is not None:
                self._owed -= 1
                self.count(late=1)
        self._owed = 0
        self.suspect = False

    @property
    def statistics(self) -> BusStatistics:
        """Counts since the bus was opened."""
        return BusStatistics(**self._counts)

    def count(self, **more: int) -> None:
        """Add to the statistics."""
        for name, n in more.items():
            self._counts[name] += n

    def close(self) -> None:
        """Close the stream; every later transaction raises PortLost."""
        with self._lock:
            self._closed = True
            self.port.closePort()

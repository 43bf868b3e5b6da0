"""What the process of the force loop sends: it never waits for whoever reads."""

import pickle
import select
from collections import deque
from multiprocessing.connection import Connection

from cell.hand_wire import Event, Progress


class Outbox:
    """Sends events in order, and keeps those that the other end has no room for yet.

    Parameters
    ----------
    connection
        A stream socket. Linux calls it writable while three quarters of its buffer of at least
        200 kB are free: a message of less is then taken whole, and nothing blocks.
    limit
        Periods that may wait; from then on they are dropped and counted, with all else kept.

    Attributes
    ----------
    dropped
        Periods dropped so far.
    broken
        Whether the other end is gone.
    """

    def __init__(self, connection: Connection, *, limit: int) -> None:
        self._connection = connection
        self._poller = select.poll()
        self._poller.register(connection.fileno(), select.POLLOUT)
        self._limit = limit
        self._waiting: deque[bytes] = deque()
        self.dropped = 0
        self.broken = False

    @property
    def full(self) -> bool:
        """Whether the next period would be dropped."""
        return len(self._waiting) >= self._limit

    @property
    def empty(self) -> bool:
        """Whether the other end has taken everything."""
        return not self._waiting

    def post(self, event: Event) -> None:
        """Send now or later; a period that finds no room is dropped."""
        if isinstance(event, Progress) and self.full:
            self.dropped += 1
            return
        self._waiting.append(pickle.dumps(event, protocol=pickle.HIGHEST_PROTOCOL))
        self.flush()

    def flush(self) -> None:
        """Send what the other end has room for; does not wait."""
        try:
            while self._waiting and self._writable():
                self._connection.send_bytes(self._waiting[0])
                self._waiting.popleft()
        except OSError:
            self._waiting.clear()
            self.broken = True

    def drain(self, timeout_s: float) -> None:
        """Send what is left, waiting at most so long: the last words of a process that ends."""
        while self._waiting and not self.broken and self._writable(timeout_s):
            self.flush()

    def _writable(self, timeout_s: float = 0.0) -> bool:
        return bool(self._poller.poll(1e3 * timeout_s))

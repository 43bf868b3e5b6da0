"""The stream of force messages: each is returned once, none after a newer one. Pure."""

from collections import deque
from math import inf
from operator import itemgetter

from tactile.errors import FrameError
from tactile.frames.force_message import COUNTERS, decode_force_message
from tactile.source import ForceMessage, ForceStatistics, ForceStatus

_USUAL_MESSAGES = 250
"""Number of messages after which their least delay is discarded, once or twice: a unit's clock may
have an error of a few thousandths."""
_BEHIND_S, _LEAST_BEHIND = 0.1, 3
"""Time in s, and least number of messages, that must all come later than usual."""


class ForceStream:
    """The order of force messages: each is returned once, and none after a newer one.

    Parameters
    ----------
    period_s
        Time between two messages in s: after a longer silence the counter alone is ambiguous.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_counter, self._last_data = 0, b""
        self._came_s = 0.0
        self.counts = ForceStatistics()
        """Counts so far; they are updated."""
        self._sent = 0
        self._delays: deque[tuple[float, float]] = deque()
        self._least_s = self._least_before_s = inf

    def push(self, data: bytes | bytearray, t_s: float) -> ForceMessage | None:
        """Add a message received at ``t_s`` s and return it if it is valid and newer."""
        try:
            message = decode_force_message(data, t_s)
        except FrameError:
            self.counts.damaged += 1
            return None
        silence_s, self._came_s = t_s - self._came_s, t_s
        if self._last_data and not self._follows(message.counter, data, silence_s):
            return None
        self._note_delay(message)
        self._last_counter, self._last_data = message.counter, bytes(data)
        self.counts.received += 1
        return message

    @property
    def behind_s(self) -> float:
        """Additional delay in s of all messages of the last 0.1 s, compared with the usual one.

        It follows from their counters. Messages that are sent less often also get a delay, and so
        do messages after a loss of sixteen at once.
        """
        if len(self._delays) < _LEAST_BEHIND:
            return 0.0
        usual_s = min(self._least_s, self._least_before_s)
        return min(self._delays, key=itemgetter(1))[1] - usual_s

    def _note_delay(self, message: ForceMessage) -> None:
        """Add the delay of a message after the time at which its counter was due."""
        step = (message.counter - self._last_counter) % COUNTERS if self._last_data else 1
        self._sent += step + bool(message.status & ForceStatus.OVERRUN)
        delay_s = message.t_s - self._sent * self._period_s
        self._delays.append((message.t_s, delay_s))
        while message.t_s - self._delays[0][0] > _BEHIND_S and len(self._delays) > _LEAST_BEHIND:
            # The usual delay excludes the messages that may be late.
            self._least_s = min(self._least_s, self._delays.popleft()[1])
        if self.counts.received % _USUAL_MESSAGES == 0:
            self._least_before_s, self._least_s = self._least_s, inf

    def _follows(self, counter: int, data: bytes | bytearray, silence_s: float) -> bool:
        step = (counter - self._last_counter) % COUNTERS
        # Silence since any message: a repeated message never counts as a new one.
        if round(silence_s / self._period_s) < COUNTERS // 2:
            if data == self._last_data:
                self.counts.repeated += 1
                return False
            if step == 0 or step >= COUNTERS // 2:
                self.counts.late += 1
                # It was counted as lost when the newer one came.
                self.counts.lost = max(0, self.counts.lost - 1)
                return False
        # After a silence at least this number is missing; the host may only have polled late.
        self.counts.lost += (step - 1) % COUNTERS
        return True

"""The stream of force messages: each is handed out once, none after a newer one. Pure."""

from collections import deque
from math import inf
from operator import itemgetter

from tactile.errors import FrameError
from tactile.frames.force_message import COUNTERS, decode_force_message
from tactile.source import ForceMessage, ForceStatistics, ForceStatus

_USUAL_MESSAGES = 250
"""Messages after which their least delay is forgotten, once or twice: a unit's clock may be wrong
by a few thousandths."""
_BEHIND_S, _LEAST_BEHIND = 0.1, 3
"""Time in s, and least number of messages, that must all come later than usual."""


class ForceStream:
    """The order of force messages: each is handed out once, and none after a newer one.

    Parameters
    ----------
    period_s
        Time between two messages in s: after a longer silence the counter alone says nothing.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_counter, self._last_data = 0, b""
        self._came_s = 0.0
        self.counts = ForceStatistics()
        """Counts so far; they go on."""
        self._sent = 0
        self._delays: deque[tuple[float, float]] = deque()
        self._least_s = self._least_before_s = inf

    def push(self, data: bytes | bytearray, t_s: float) -> ForceMessage | None:
        """Take a message received at ``t_s`` s and return it if it is whole and newer."""
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
        """Time in s by which all messages of the last 0.1 s came later than was usual before.

        By their counters: messages that are sent more seldom fall behind too, and so do messages
        of which sixteen were lost at once.
        """
        if len(self._delays) < _LEAST_BEHIND:
            return 0.0
        usual_s = min(self._least_s, self._least_before_s)
        return min(self._delays, key=itemgetter(1))[1] - usual_s

    def _note_delay(self, message: ForceMessage) -> None:
        """Add how late a message comes after the time at which its counter was due."""
        step = (message.counter - self._last_counter) % COUNTERS if self._last_data else 1
        self._sent += step + bool(message.status & ForceStatus.OVERRUN)
        delay_s = message.t_s - self._sent * self._period_s
        self._delays.append((message.t_s, delay_s))
        while message.t_s - self._delays[0][0] > _BEHIND_S and len(self._delays) > _LEAST_BEHIND:
            # What was usual ends where the messages that may be late begin.
            self._least_s = min(self._least_s, self._delays.popleft()[1])
        if self.counts.received % _USUAL_MESSAGES == 0:
            self._least_before_s, self._least_s = self._least_s, inf

    def _follows(self, counter: int, data: bytes | bytearray, silence_s: float) -> bool:
        step = (counter - self._last_counter) % COUNTERS
        # Since any message came: one that comes again and again never becomes a new one.
        if round(silence_s / self._period_s) < COUNTERS // 2:
            if data == self._last_data:
                self.counts.repeated += 1
                return False
            if step == 0 or step >= COUNTERS // 2:
                self.counts.late += 1
                # It was missed when the newer one came.
                self.counts.lost = max(0, self.counts.lost - 1)
                return False
        # After a silence so many are missing at least; the host may only have looked late.
        self.counts.lost += (step - 1) % COUNTERS
        return True

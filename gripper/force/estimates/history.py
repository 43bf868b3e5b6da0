"""Values of the last periods by time."""

from collections import deque

_LENGTH = 128
"""Periods kept of a value: 0.64 s at 200 Hz, several times the delay of a sensor. [chosen]"""


class History:
    """Values of the last periods by time."""

    def __init__(self) -> None:
        self._entries: deque[tuple[float, float]] = deque(maxlen=_LENGTH)
        self._shift = 0.0

    def add(self, now_s: float, value: float) -> None:
        """Add the value of now."""
        self._entries.append((now_s, value - self._shift))

    @property
    def newest(self) -> float:
        """The value that was added last."""
        return self._entries[-1][1] + self._shift

    def at(self, t_s: float) -> float:
        """Return the value at a time in s; the oldest one where the time is before it."""
        for then_s, value in reversed(self._entries):
            if then_s <= t_s:
                return value + self._shift
        return self._entries[0][1] + self._shift

    def shift(self, by: float) -> None:
        """Add ``by`` to all values."""
        self._shift += by

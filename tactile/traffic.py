"""How much of what is of no use may come over the bus. Pure: time is an argument."""

from tactile.errors import BusDisturbed


class TrafficLimit:
    """A leaky bucket: messages fill it one by one, time empties it at the allowed rate.

    Parameters
    ----------
    what
        The messages, in the plural, for the error.
    advice
        What to do about them.
    rate_hz
        So many a second may come for ever.
    burst
        So many may come at once.
    """

    def __init__(self, what: str, advice: str, *, rate_hz: float, burst: float) -> None:
        self._what = what
        self._advice = advice
        self._rate_hz = rate_hz
        self._burst = burst
        self._level = 0.0
        self._since_s: float | None = None
        self._at_s = 0.0
        self._n = 0

    def add(self, t_s: float, n: int = 1) -> None:
        """Take ``n`` messages that came at ``t_s`` s; BusDisturbed if they are too many."""
        self._level = max(0.0, self._level - self._rate_hz * max(0.0, t_s - self._at_s))
        if self._level == 0.0 or self._since_s is None:
            self._since_s, self._n = t_s, 0
        self._at_s = t_s
        self._level += n
        self._n += n
        if self._level > self._burst:
            raise BusDisturbed(
                f"{self._n} {self._what} came within {1e3 * (t_s - self._since_s):.0f} ms, "
                f"allowed are {self._rate_hz:g} a second: {self._advice}, then start the link again"
            )

"""The clock of virtual time, with one thread and repeatable runs, and its pace for real time."""

import math
from collections.abc import Callable

from gripper.clock import Clock

STEP_S = 1e-3
"""Longest piece in s by which a virtual clock moves at once."""
ROUNDING_S = 1e-9
"""Allowance in s for sums of times that should be equal."""
_ROUNDING_SHARE = 1e-6
"""A rest below this share of a step is added to the last piece."""
_LEAD_S = 0.01
"""Lead of virtual over real time in s at which the clock waits: half the period of a frame."""
_BACKLOG_S = 0.2
"""Largest lag behind real time in s that is made up; the rest of a longer lag is dropped."""


class VirtualClock:
    """A monotonic clock that moves only by its `sleep` and `advance_to`.

    It has ``monotonic`` and ``sleep`` like the standard module ``time``, so it can replace that
    module as an injected clock. Waiting advances the time in pieces of at most 1 ms and calls
    ``on_advance`` after each piece, which advances the simulated world.
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = float(start_s)
        self._advancing = False
        self.on_advance: list[Callable[[float], None]] = []
        """Called in this order with the new time in s after each piece; a callback must not advance
        the clock."""

    def monotonic(self) -> float:
        """Return the time in s."""
        return self._now_s

    def sleep(self, seconds: float, /) -> None:
        """Advance the time by ``seconds`` s; like ``time.sleep`` it refuses a negative time."""
        if not (math.isfinite(seconds) and seconds >= 0.0):
            raise ValueError(f"sleep takes a finite time of at least 0 s, got {seconds}")
        self.advance_to(self._now_s + seconds)

    def advance_to(self, t_s: float) -> None:
        """Advance the time to ``t_s`` s; a time in the past has no effect.

        Raises
        ------
        ValueError
            If ``t_s`` is not finite.
        RuntimeError
            If a callback of ``on_advance`` tries to advance the clock.
        """
        if not math.isfinite(t_s):
            raise ValueError(f"a clock moves to a finite time, got t_s={t_s}")
        if t_s <= self._now_s:
            return
        if self._advancing:
            raise RuntimeError("a callback of on_advance must not move the clock that calls it")
        self._advancing = True
        try:
            last_s = t_s - _ROUNDING_SHARE * STEP_S
            while self._now_s < t_s:
                now_s = self._now_s + STEP_S
                self._now_s = t_s if now_s > last_s else now_s
                for callback in self.on_advance:
                    callback(self._now_s)
        finally:
            self._advancing = False


class Pace:
    """The pace of a virtual clock: it keeps the clock from running ahead of real time.

    On a slow machine virtual time runs late; a lag above 0.2 s is not made up.

    Parameters
    ----------
    clock
        The virtual clock; it waits when it leads by 10 ms.
    real
        A clock that moves by itself, as the standard module ``time``.
    speed
        Virtual seconds per real second.
    """

    def __init__(self, clock: VirtualClock, real: Clock, *, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise ValueError(f"a pace has a positive speed, got speed={speed}")
        self._clock = clock
        self._real = real
        self._speed = speed
        self._origin_s = clock.monotonic() - speed * real.monotonic()
        clock.on_advance.append(self._wait)

    def end(self) -> None:
        """Remove the pace: the clock runs freely again."""
        self._clock.on_advance.remove(self._wait)

    def lag_s(self) -> float:
        """Return the lag of virtual time in s, at most 0.2 s times the speed; negative: lead."""
        lag_s = self._origin_s + self._speed * self._real.monotonic() - self._clock.monotonic()
        left_out_s = max(0.0, lag_s - self._speed * _BACKLOG_S)
        self._origin_s -= left_out_s
        return lag_s - left_out_s

    def _wait(self, _now_s: float) -> None:
        lead_s = -self.lag_s() / self._speed
        if lead_s >= _LEAD_S:
            self._real.sleep(lead_s)

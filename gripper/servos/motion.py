"""Speed of a servo by its positions and its own clock.

Present Velocity (register 128) is a mean of 64 ms behind a low-pass of 16 ms on the X series, 48 ms
late. Present Position and Realtime Tick have no delay, so the speed is the slope of a line through
the newest positions (least squares). The line is as long as the positions allow: longer lines have
less noise, shorter ones less delay (Janabi-Sharifi, Hayward and Chen 2000, adaptive windowing).
"""

from collections import deque
from math import sqrt

import numpy as np

from gripper.dynamixel.control_table import TICK_MODULO
from gripper.dynamixel.models import ServoModel

_WINDOWS_MS = (80, 40, 20)
"""Lengths in ms of a line, the longest first. At rest the longest resolves a speed as exactly as
Present Velocity does; the shortest has four positions of a loop of 200 Hz. [resolution]"""
_PAUSE_MS = 60
"""Time in ms between two positions that are not compared: less than the longest line. [chosen]"""
_NEWEST, _FEWEST = 2, 5
"""Newest positions that earlier ones must foretell, and fewest positions for this. [chosen]"""
UNSURE_COUNTS = 1.5
"""Counts by which a position may be off a line: half of one by rounding, and a dither of one."""


def still_rad(model: ServoModel) -> float:
    """Return the way in rad below which a servo may stand: its count differs by one."""
    return UNSURE_COUNTS * model.rad_per_pulse


def slow_rad_s(model: ServoModel) -> float:
    """Return the largest speed in rad/s of a servo at rest, whose count changes by one."""
    return 1.5e3 * model.rad_per_pulse / _WINDOWS_MS[0]


def position_sd_rad(model: ServoModel) -> float:
    """Return the standard deviation in rad of a position: its rounding, and a dither of a count."""
    return model.rad_per_pulse * sqrt(1.0 / 12.0 + 0.25)


class ServoMotion:
    """Newest positions of one servo, and the speed that they show.

    A speed is that of 40 ms ago, the middle of the longest line, with a noise of 0.006 rad/s. A
    change by ``dv`` rad/s shortens the line once it has moved the servo by 1.5 counts from where
    the earlier positions lead: after 2.3e-3 / ``dv`` s. The shortest line is 10 ms late. Below 200
    Hz it has too few positions. There a parabola shows the speed at the next reading while the
    longest line does not hold, with a noise of 0.13 rad/s.
    """

    def __init__(self, model: ServoModel) -> None:
        self._unsure_rad = still_rad(model)
        self._tick_ms = 0
        self._positions: deque[tuple[int, float]] = deque()
        self.next_rad_s = 0.0
        """Speed in rad/s, below 200 Hz at the next reading if the acceleration lasts."""

    def forget(self) -> None:
        """Compare the next position with no earlier one."""
        self._positions.clear()

    def withdraw(self) -> None:
        """Remove the newest position: it was wrong."""
        newest_ms, _ = self._positions.pop()
        if newest_ms == 0:
            self._positions.clear()
        else:
            self._tick_ms -= newest_ms - self._positions[-1][0]

    def speed_rad_s(self, tick_ms: int, angle_rad: float) -> float:
        """Add a position and return the speed in rad/s; before the first one the servo stood.

        ``tick_ms``: Realtime Tick of its answer, modulo 32768.
        """
        positions, passed_ms = self._positions, (tick_ms - self._tick_ms) % TICK_MODULO
        self._tick_ms = tick_ms
        if not positions or passed_ms > _PAUSE_MS:
            longest_ms, *_, shortest_ms = _WINDOWS_MS
            positions.clear()
            positions.extend((t_ms, angle_rad) for t_ms in range(-longest_ms, 1, shortest_ms))
            self.next_rad_s = 0.0
            return 0.0
        now_ms = positions[-1][0] + passed_ms
        if passed_ms == 0:
            positions.pop()
        positions.append((now_ms, angle_rad))
        while now_ms - positions[0][0] > _WINDOWS_MS[0]:
            positions.popleft()
        line = list(positions)
        for shorter_ms in _WINDOWS_MS[1:]:
            if len(line) < _FEWEST or self._foretold(line):
                break
            line = [point for point in line[:-2] if now_ms - point[0] <= shorter_ms] + line[-2:]
        rate = 1e3 * _fit(line)[2]
        # The shortest line is prompt enough where it has its positions.
        prompt = len(positions) < _FEWEST or now_ms - positions[-_FEWEST][0] <= _WINDOWS_MS[-1]
        steady = prompt or now_ms - line[0][0] > _WINDOWS_MS[1]
        self.next_rad_s = rate if steady else 1e3 * self._next_rate(now_ms + passed_ms)
        return rate

    def _next_rate(self, next_ms: int) -> float:
        """Return the slope in rad/ms at a later time of a parabola through the newest positions."""
        t_ms, rad = zip(*list(self._positions)[-_FEWEST:], strict=True)
        return float(np.polyfit(np.subtract(t_ms, next_ms), rad, 2)[1])

    def _foretold(self, line: list[tuple[int, float]]) -> bool:
        """Return whether a line through all but the newest positions leads to these."""
        middle_ms, middle_rad, rate = _fit(line[:-_NEWEST])
        unsure_rad = self._unsure_rad
        for t_ms, rad in line:
            if not -unsure_rad <= rad - middle_rad - rate * (t_ms - middle_ms) <= unsure_rad:
                return False
        return True


def _fit(line: list[tuple[int, float]]) -> tuple[float, float, float]:
    """Return the means of time in ms and angle in rad, and the slope in rad/ms."""
    n, middle_ms, middle_rad, spread_ms2, rate = len(line), 0.0, 0.0, 0.0, 0.0
    for t_ms, rad in line:
        middle_ms += t_ms
        middle_rad += rad
    middle_ms /= n
    middle_rad /= n
    for t_ms, rad in line:
        off_ms = t_ms - middle_ms
        spread_ms2 += off_ms * off_ms
        rate += off_ms * rad
    return middle_ms, middle_rad, rate / spread_ms2

"""What a simulated servo measures: velocity by the counts of its encoder, and noise.

Present Velocity is the difference of positions over a window, and a low-pass after it: on four
XM430-W350 it follows the position 48 to 50 ms late, on an XL330-M288 20 to 21 ms. Windows and
rounding are fits to logs of these servos (smorales2405/open_manipulator_x_torque_control,
Rhoban/bam): the XM430 drops the fraction of a count, the XL330 rounds.
"""

import itertools
import math
import random
from collections import deque
from functools import lru_cache
from typing import Any

from gripper.dynamixel.models import ServoModel
from simulator.servo.control_table import is_x330

_WINDOW_S, _LOW_PASS_S = 0.064, 0.016
_WINDOW_X330_S, _LOW_PASS_X330_S = 0.032, 0.004
"""Length of the mean and time constant of the low-pass in s: X430 and alike, 330 size."""
_DITHER_SD = 0.25
"""Standard deviation of the encoder in counts: at rest a count changes in a quarter of the samples
of an XM430-W350 (16 to 41 %)."""
_N_DITHERS = 4099
"""Number of values of the dither before they repeat."""
_CURRENT_SD_A = ((0.1, 3.4e-3), (0.5, 7.2e-3), (math.inf, 13e-3))
"""Speed in rad/s up to which Present Current of an XM430-W350 has a standard deviation in A."""
_SUPPLY_SD = 0.8
"""Standard deviation of the supply of an XL330-M288 that holds, over supply and d² (1 - d) with its
duty d: 0.55 to 0.8 V of 7.3 V at a duty of 0.34 to 0.8, and nearly none at 0 and 1."""
_ROUNDING_S = 1e-9
"""Allowance for rounding in times."""


class VelocityRegister:
    """Velocity by the positions of the last moments, as the firmware of a model computes it."""

    def __init__(self, model: ServoModel, count: int) -> None:
        x330 = is_x330(model)
        self._window_s = _WINDOW_X330_S if x330 else _WINDOW_S
        self._low_pass_s = _LOW_PASS_X330_S if x330 else _LOW_PASS_S
        self._to_raw = round if x330 else math.trunc
        self._rad_per_pulse, self._unit_rad_s = model.rad_per_pulse, model.velocity_unit_rad_s
        self._time_s = 0.0
        self._count = count
        # Count at the begin of the window, and later changes: time and new count.
        self._first = count
        self._changes: deque[tuple[float, int]] = deque()
        self._step_s = self._share = 0.0
        self._velocity_rad_s = 0.0

    @property
    def raw(self) -> int:
        """Content of the register."""
        return self._to_raw(self._velocity_rad_s / self._unit_rad_s)

    def step(self, count: int, dt_s: float) -> None:
        """Take the count of the encoder ``dt_s`` s after the count before."""
        if dt_s != self._step_s:
            self._step_s, self._share = dt_s, 1.0 - math.exp(-dt_s / self._low_pass_s)
        changes = self._changes
        now_s = self._time_s = self._time_s + dt_s
        if count != self._count:
            self._count = count
            changes.append((now_s, count))
        first_s = now_s - self._window_s + _ROUNDING_S
        while changes and changes[0][0] <= first_s:
            _, self._first = changes.popleft()
        mean_rad_s = (count - self._first) * self._rad_per_pulse / self._window_s
        self._velocity_rad_s += (mean_rad_s - self._velocity_rad_s) * self._share


@lru_cache(maxsize=16)
def _dithers(seed: str) -> tuple[list[float], tuple[Any, ...]]:
    """Return deviations of the encoder in counts, and the state of the generator after them."""
    generator = random.Random(seed)
    return [generator.gauss(0.0, _DITHER_SD) for _ in range(_N_DITHERS)], generator.getstate()


class ServoNoise:
    """Noise of one servo's measurements, the same for the same seed and order of reads.

    Sizes are from logs: Present Current less Goal Current, counts at rest, and the supply of a
    servo that holds (see the module).
    """

    def __init__(self, seed: str) -> None:
        dithers, state = _dithers(seed)
        self._random = random.Random()
        self._random.setstate(state)
        self.dither = itertools.cycle(dithers).__next__
        """Returns the next deviation of the encoder in counts."""

    def current_a(self, velocity_rad_s: float) -> float:
        """Return the next deviation of an X430's current in A."""
        speed = abs(velocity_rad_s)
        return self._random.gauss(0.0, next(sd for most, sd in _CURRENT_SD_A if speed <= most))

    def voltage_v(self, supply_v: float, duty: float) -> float:
        """Return the next deviation of a 330 size's supply in V, at a duty of 0 to 1."""
        return self._random.gauss(0.0, _SUPPLY_SD * supply_v * duty * duty * (1.0 - duty))

"""Values of a servo from the readings of the bench: registers, currents and weights.

Pure functions on arrays; times in s, angles in rad, currents in A, torques in N m.
"""

from collections.abc import Sequence
from math import exp, inf, log

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Floats = NDArray[np.float64]
_GRID_S = 1e-3
"""Step in s at which positions are interpolated: the resolution of Realtime Tick."""
_WINDOWS_S = tuple(1e-3 * ms for ms in (4, 8, 16, 24, 32, 48, 64, 96, 128))
_LOW_PASSES_S = tuple(1e-3 * ms for ms in (0, 2, 4, 8, 12, 16, 24, 32))
"""Mean and low-pass of Present Velocity that are compared, in s."""
_FEWEST = 3
"""Points of a line and of a check of it."""


def late_velocity(position_rad: Floats, window_s: float, low_pass_s: float) -> Floats:
    """Return mean and low-pass of the velocity in rad/s, of positions each `_GRID_S`."""
    n = max(1, round(window_s / _GRID_S))
    earlier = np.concatenate((np.full(n, position_rad[0]), position_rad[:-n]))
    mean: Floats = (position_rad - earlier) / (n * _GRID_S)
    if low_pass_s <= 0.0:
        return mean
    share = 1.0 - exp(-_GRID_S / low_pass_s)
    late: Floats = lfilter([share], [1.0, share - 1.0], mean)
    return late


def velocity_filter(
    t_s: Floats, position_rad: Floats, velocity_rad_s: Floats
) -> tuple[float, float, float]:
    """Return mean in s, low-pass in s and rms in rad/s of the filter that fits Present Velocity.

    Parameters
    ----------
    t_s, position_rad, velocity_rad_s
        (n,) float64: readings in the order of time, at least 100 a second.
    """
    grid_s = np.arange(t_s[0], t_s[-1], _GRID_S)
    position = np.interp(grid_s, t_s, position_rad)
    best = (0.0, 0.0, inf)
    for window_s in _WINDOWS_S:
        for low_pass_s in _LOW_PASSES_S:
            late = np.interp(t_s, grid_s, late_velocity(position, window_s, low_pass_s))
            rms = float(np.sqrt(np.mean((late - velocity_rad_s) ** 2)))
            if rms < best[2]:
                best = (window_s, low_pass_s, rms)
    return best


def error_gain(error_pulses: Floats, output_raw: Floats, p_gain: float) -> float | None:
    """Return K of output = P error / K, from readings with some output; None without them."""
    asked = error_pulses * p_gain
    used = np.abs(output_raw) >= 10.0
    if not used.any():
        return None
    return float(asked[used] @ asked[used] / (asked[used] @ output_raw[used]))


def line(x: Floats, y: Floats) -> tuple[float, float]:
    """Return slope and value at 0 of the straight line through points."""
    slope, offset = np.polyfit(x, y, 1)
    return float(slope), float(offset)


def slope(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return the slope of the straight line through points; None with fewer than 3 different x."""
    if len(set(x)) < _FEWEST:
        return None
    return line(np.array(x), np.array(y))[0]


def exponent(current_a: Sequence[float], pwm_share: Sequence[float]) -> float | None:
    """Return n of PWM ~ current**n at rest; None with fewer than 3 points.

    V d = R I gives 1 for the current I of the winding, and 1/2 for that of the supply, d I.
    """
    return slope([log(a) for a in current_a], [log(share) for share in pwm_share])


def friction(speed_rad_s: Floats, current_a: Floats) -> tuple[float, float, float]:
    """Return Coulomb friction in A, viscous friction in A s/rad and offset in A of free motion.

    ``speed_rad_s``, ``current_a``: (n,) float64, in both directions.
    """
    columns = np.stack((np.sign(speed_rad_s), speed_rad_s, np.ones_like(speed_rad_s)), axis=1)
    (coulomb, viscous, offset), *_ = np.linalg.lstsq(columns, current_a, rcond=None)
    return float(coulomb), float(viscous), float(offset)

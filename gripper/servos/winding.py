"""Current of a servo's winding, the voltage of its supply, and the heat that the current makes.

The 330 size measures and limits the current of the supply: duty times winding current. Near
0 A a count of it is many counts of the winding's current. So the winding's comes from the duty:
(duty V - k_e w) / R. Present Current over the duty is a second measurement.

The register of the temperature lags by minutes, so the heat is I²t: the square of the current above
that of hours, over time. A second at the model's peak current is allowed, and no current between
both for longer: servos switch their torque off after some seconds, and the part drops.
"""

from collections import deque
from math import copysign, exp, inf
from statistics import fmean

from gripper.dynamixel.models import ServoModel

_LEAST_READINGS, _MOST_READINGS = 20, 40
"""Readings of the voltage for a mean, and those that are kept: single ones are off by 0.5 to 0.8 V
while a servo holds, and a median jumps between two peaks (logs of Rhoban/bam, revision af22604)."""
_LEAST_DUTY = 0.2
"""Duty below which Present Current over the duty is too inexact."""
_PEAK_S = 1.0
"""Longest time in s above the current for hours. The rule by which servos trip is unpublished; the
shortest times that users report are some seconds."""
_COOL_SHARE = 0.5
"""Share of the current for hours below which a winding counts as cooling: else the force of a held
part would swing. [chosen]"""
LOWERING_S = 0.5
"""Time constant in s with which a hot winding's current falls, so that no part is thrown. [chosen]
"""


class Supply:
    """Voltage of the supply of one servo, without the noise of single readings."""

    def __init__(self) -> None:
        self._readings_v: deque[float] = deque(maxlen=_MOST_READINGS)

    def steady_v(self, voltage_v: float, *, under_torque: bool) -> float:
        """Add a reading in V and return the voltage; without torque a reading is exact.

        Until there are enough readings it is the highest one, which makes the goal currents small.
        """
        if not under_torque:
            self._readings_v.extend([voltage_v] * _MOST_READINGS)
        self._readings_v.append(voltage_v)
        few = len(self._readings_v) < _LEAST_READINGS
        return max(self._readings_v) if few else fmean(self._readings_v)


def winding_a(
    model: ServoModel, present_a: float, duty: float, supply_v: float, speed_rad_s: float
) -> tuple[float, float | None]:
    """Return the current in A of a winding, and the same by Present Current alone.

    The second one is None where the duty is too small for it. All signs are in one direction.

    Parameters
    ----------
    present_a
        Present Current in A.
    duty
        Present PWM as a share of the whole supply.
    supply_v, speed_rad_s
        Voltage of the supply in V, and speed of the output in rad/s.
    """
    if not model.supply_current:
        return present_a, present_a
    # A servo without torque has no duty, and no current either.
    motor_v = duty * supply_v - model.back_emf_v_s * speed_rad_s if duty else 0.0
    by_register = abs(duty) > _LEAST_DUTY
    return motor_v / model.winding_ohm, copysign(present_a / duty, duty) if by_register else None


class WindingHeat:
    """Heat of the winding of one servo, and the current that it allows.

    Once the heat is reached, the current falls to the holding current. It stays there until the
    winding has cooled and little current is asked.
    """

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        self._heat_s = 0.0
        self.hot = False
        """Whether only the holding current is allowed."""
        self.limit_a = model.stall_current_a
        """Largest allowed current in A."""
        self._last: tuple[float, float] | None = None

    def add(self, now_s: float, current_a: float) -> None:
        """Add a measured current in A at a monotonic time in s; it lasts until the next one."""
        if self._last is not None:
            dt_s, last_a = now_s - self._last[0], self._last[1]
            heat_s = self._heat_s + dt_s * _heating(self._model, last_a)
            self._heat_s = min(max(0.0, heat_s), _PEAK_S)
            if self.hot:
                above_a = self.limit_a - self._model.holding_a
                self.limit_a -= above_a * (1.0 - exp(-dt_s / LOWERING_S))
        self._last = now_s, current_a
        if self._heat_s == _PEAK_S and not self.hot:
            self.hot, self.limit_a = True, max(abs(current_a), self._model.holding_a)
        elif not self._heat_s:
            self.hot, self.limit_a = False, self._model.stall_current_a


def longest_s(model: ServoModel, current_a: float) -> float:
    """Return the time in s for which a servo without heat may have a current in A."""
    heating = _heating(model, current_a)
    return _PEAK_S / heating if heating > 0.0 else inf


def _heating(model: ServoModel, current_a: float) -> float:
    """Return what a current in A adds to the heat in 1 s: 1 s or more, none, or less than none."""
    hours_a2, square_a2 = model.holding_a**2, current_a**2
    heating = (square_a2 - hours_a2) / (model.peak_a**2 - hours_a2)
    if heating > 0.0:
        return max(1.0, heating)
    return heating if square_a2 < _COOL_SHARE**2 * hours_a2 else 0.0
